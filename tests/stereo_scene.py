"""Scenes with known geometry for the classical prior: textured planes, and the built-in room as COLMAP takes it."""

from functools import cache

import hydra
import jax.numpy as jnp
import jaxlie
import numpy as np
from scene import compose

from emgs_jax.config.configure import build
from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.multiview.depth import DepthConfig
from emgs_jax.prior.multiview.planar import PlanarConfig
from emgs_jax.prior.sources import Sources
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.shots import Shots

FOCAL, CENTER, SIZE = (55.0, 53.0), (30.5, 24.25), (64, 48)
SMALL = ("prior.dense.depth.sweep.num_planes=24",)


@cache
def depth_config(*overrides: str) -> DepthConfig:
    """`prior.dense.depth` of conf/ with few planes."""
    return hydra.utils.instantiate(compose("prior=multiview_stereo", *SMALL, *overrides).prior.dense.depth)


@cache
def planar_config(*overrides: str) -> PlanarConfig:
    """`prior.dense.planar` of conf/ for small regions."""
    small = ("prior.dense.planar.min_area=150", "prior.dense.planar.min_matches=40")
    return hydra.utils.instantiate(compose("prior=multiview_stereo", *small, *overrides).prior.dense.planar)


@cache
def structure_config(*overrides: str) -> StructureConfig:
    """`prior.structure` of conf/, on one thread."""
    words = ("prior.structure.num_threads=1", *overrides)
    return build(compose("prior=multiview_stereo", *words), "prior.structure", _convert_="all")


@cache
def room() -> list[Frame]:
    """Eight frames of the built-in room, large enough for SIFT."""
    drawn = Synthetic(num_frames=40, stop=8, size=(160, 120))
    return [drawn[index] for index in range(len(drawn))]


def shots(images, is_calibrated: bool = True, names=None) -> Shots:
    """Images of the room's camera; None is one that cannot be read."""

    def read(index):
        if images[index] is None:
            raise BadFrameError("unreadable")
        return images[index]

    camera = ("SIMPLE_RADIAL", (131.2, 80.0, 60.0, 0.0)[: 4 * is_calibrated])
    return Shots(names or [f"{row:03d}" for row in range(len(images))], read, (160, 120), camera, is_calibrated)


@cache
def small_camera() -> Camera:
    return Camera(FOCAL, CENTER, *SIZE)


def matrix(rotation=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> np.ndarray:
    """(4, 4) from a rotation vector (rad) and a translation (m)."""
    import cv2

    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array(rotation, float))[0], translation
    return T


AROUND = [matrix(translation=t) for t in ((0.2, 0, 0), (-0.2, 0, 0), (0, 0.2, 0), (0, -0.2, 0))]


def sources(views, poses=AROUND, is_used=None) -> Sources:
    """What cameras with these poses show, beside a view at the origin; without `is_used` all count."""
    T = jaxlie.SE3.from_matrix(jnp.asarray(np.linalg.inv(np.stack(poses)), jnp.float32))
    shown = None if views is None else jnp.asarray(np.stack(views))
    return Sources(shown, T, jnp.asarray([True] * len(poses) if is_used is None else is_used))


def calibration() -> np.ndarray:
    return np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])


def plane_image(
    T_world_camera: np.ndarray, slope: float, seed: int = 0, blank: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Grey image and depth of the plane z = 2 m + slope x, painted with waves of 8 to 25 cm, ray by ray.

    Less than `blank` metres beside and above the middle it is not painted.
    """
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(calibration()).T @ T_world_camera[:3, :3].T
    normal = np.array([-slope, 0.0, 1.0])
    depth = (2.0 - normal @ T_world_camera[:3, 3]) / (rays @ normal)
    points = T_world_camera[:3, 3] + depth[..., None] * rays
    rng = np.random.default_rng(seed)
    gray = np.full(depth.shape, 0.5)
    for _ in range(24):
        wave, angle, phase = rng.uniform(0.08, 0.25), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        along = points[..., 0] * np.cos(angle) + points[..., 1] * np.sin(angle)
        gray += 0.05 * np.cos(2 * np.pi * along / wave + phase)
    gray[(np.abs(points[..., :2]) < blank).all(axis=-1)] = 0.5
    return np.float32(np.clip(gray, 0, 1)), np.float32(depth)


def painted(slope: float = 0.0, **options) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Image and depth of the plane as seen from the origin, and its images from `AROUND`."""
    return *plane_image(np.eye(4), slope, **options), [plane_image(T, slope, **options)[0] for T in AROUND]


def similarity_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance (n, 3) after the best Sim(3) (Umeyama 1991)."""
    a, b = estimate - estimate.mean(0), truth - truth.mean(0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.linalg.det(U @ Vt)])
    scale = (S * sign).sum() / (a**2).sum()
    return float(np.sqrt(((scale * a @ (U * sign @ Vt).T - b) ** 2).sum(1).mean()))
