"""What holds for every data set: its YAML, its errors, and what damaged files lead to."""

import inspect
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.data.base import Frame
from emgs_jax.data.bonn import Bonn
from emgs_jax.data.images import Images
from emgs_jax.data.replica import Replica
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.tum import Tum

CONF = Path(__file__).resolve().parents[2] / "conf" / "dataset"
ON_DISK = {
    "seven_scenes": (SevenScenes, "kitchen/seq-01", {"register_depth": False}),
    "tum": (Tum, "rgbd_dataset_freiburg3_plane", {}),
    "bonn": (Bonn, "rgbd_dataset_freiburg3_plane", {}),
    "replica": (Replica, "office9", {}),
    "images": (Images, ".", {"intrinsics": (128, 128, 79.5, 59.5)}),
}
DAMAGED = [
    ("seven_scenes", "kitchen/seq-01/frame-000000.color.png"),
    ("seven_scenes", "kitchen/seq-01/frame-000001.color.jpg"),
    ("seven_scenes", "kitchen/seq-01/frame-000001.depth.png"),
    ("seven_scenes", "kitchen/seq-01/frame-000001.pose.txt"),
    ("tum", "rgbd_dataset_freiburg3_plane/rgb.txt"),
    ("tum", "rgbd_dataset_freiburg3_plane/depth.txt"),
    ("tum", "rgbd_dataset_freiburg3_plane/groundtruth.txt"),
    ("replica", "cam_params.json"),
    ("replica", "office9/traj.txt"),
    ("replica", "office9/results/frame000001.jpg"),
    ("images", "img10.JPG"),
]


def load(name, root, **options):
    build, sequence, more = ON_DISK[name]
    return build(str(root), **{"sequence": sequence, "stride": 1, **more, **options})


@pytest.mark.parametrize("path", sorted(CONF.glob("[a-z]*.yaml")), ids=lambda p: p.stem)
def test_yaml_keys_and_values_are_the_constructors_parameters_and_defaults(path):
    values = OmegaConf.to_container(compose(f"dataset={path.stem}").dataset)
    target = get_class(values.pop("_target_"))
    parameters = inspect.signature(target).parameters
    defaults = {k: list(p.default) if isinstance(p.default, tuple) else p.default for k, p in parameters.items()}
    assert values == defaults
    assert target.name == path.stem


@pytest.mark.parametrize("name", ON_DISK)
def test_the_fingerprint_follows_the_options(name, request):
    root = request.getfixturevalue(f"{name}_root")
    found = [load(name, root, **options).fingerprint() for options in ({}, {"stride": 2}, {"size": (64, 48)})]
    assert len({*found}) == 3 and load(name, root).fingerprint() == found[0]


@pytest.mark.parametrize("name, file", DAMAGED)
def test_damaged_files_give_a_clear_error_or_a_sound_frame(name, file, request):
    """A PNG has checksums, a JPEG an end; in a text another digit cannot be told, but most damage is no digit."""
    root = request.getfixturevalue(f"{name}_root")
    whole, rng, is_noticed = (root / file).read_bytes(), np.random.default_rng(0), np.zeros(20, bool)
    for attempt in range(20):
        data = bytearray(whole[: rng.integers(0, len(whole))] if attempt % 2 else whole)
        for place in rng.integers(0, len(data), rng.integers(1, 12)) if len(data) and attempt % 4 != 1 else ():
            data[place] ^= 1 << int(rng.integers(8))
        (root / file).write_bytes(data)
        try:
            dataset = load(name, root, size=(64, 48))
            for index in range(min(len(dataset), 2)):
                check_frame(dataset[index])
            dataset.fingerprint()
        except (ValueError, FileNotFoundError) as error:
            is_noticed[attempt] = True
            assert str(root) in str(error) or "dataset." in str(error), f"{error} names no file"
    suffix = Path(file).suffix.lower()
    if suffix == ".png":
        assert is_noticed.all()
    elif suffix in (".jpg", ".jpeg"):
        assert is_noticed[1::2].all(), "all that are cut off"
    else:
        assert is_noticed.sum() >= 14


def check_frame(frame: Frame) -> None:
    assert frame.image.shape == (48, 64, 3) and frame.image.dtype == np.uint8
    if frame.depth is not None:
        assert frame.depth.shape == (48, 64) and np.isfinite(frame.depth).all() and (frame.depth >= 0).all()
    if frame.T_world_camera is not None:
        rotation = frame.T_world_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.isfinite(frame.T_world_camera).all()
