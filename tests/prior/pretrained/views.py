"""Images of a view and others, where these are, and what lies beside this clone."""

from pathlib import Path

import cv2
import jax
import jaxlie
import numpy as np
import pytest
from scene import device, on_host
from scipy.spatial.transform import Rotation

from emgs_jax.ops.camera import Camera
from emgs_jax.prior.sources import Sources

BESIDE = Path(__file__).resolve().parents[3].parent
SIZE, RANGE = (64, 96), (0.8, 5.0)  # rows and columns; nearest and farthest


def camera(size=SIZE):
    height, width = size
    return Camera([0.82 * width, 1.09 * height], [0.5 * width - 0.5, 0.5 * height - 0.5], width, height)


def asked(module, config):
    """`found(network, images, T_source_view, …)`: depth and confidence of the first image, by a network's module."""
    extract = on_host(lambda network, images: jax.vmap(lambda image: module.extract(network, image))(images))
    estimate = on_host(module.estimate)

    def found(network, images, T_source_view, depth_range=RANGE, is_used=None):
        kept = extract(network, images)
        view, others = (jax.tree.map(lambda leaf, rows=rows: leaf[rows], kept) for rows in (0, slice(1, None)))
        used = np.ones(len(T_source_view), bool) if is_used is None else np.asarray(is_used)
        sources = Sources(others, on_host(jaxlie.SE3.from_matrix)(device(T_source_view)), used)
        return estimate(network, view, sources, device(depth_range), camera(images.shape[1:3]), config)

    return found


def random_views(size=SIZE, seed=0, count=4):
    """Images of a view and `count` others, and where these are."""
    rng = np.random.default_rng(seed)
    images = [cv2.GaussianBlur(rng.uniform(size=(*size, 3)), (0, 0), 1.5) for _ in range(count + 1)]
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(0.05 * rng.normal(size=(count, 3))).as_matrix()
    T[:, :3, 3] = 0.2 * rng.normal(size=(count, 3))
    return np.float32(images), np.float32(T)


def real_views(size):
    """Redkitchen at the poses of its release, whose rotations are rounded to seven digits."""
    folder = BESIDE / "shared/data/7scenes/redkitchen/seq-01"
    if not folder.is_dir():
        pytest.skip(f"redkitchen of 7-Scenes is not at {folder}")
    stems = [folder / f"frame-{number:06d}" for number in (100, 80, 90, 110, 120)]
    images = [cv2.cvtColor(cv2.imread(f"{stem}.color.jpg"), cv2.COLOR_BGR2RGB) for stem in stems]
    images = [cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA) / np.float32(255) for image in images]
    T = np.stack([np.linalg.inv(np.loadtxt(f"{stem}.pose.txt")) for stem in stems])
    T = T[1:] @ np.linalg.inv(T[0])
    T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    return np.float32(images), np.float32(T)
