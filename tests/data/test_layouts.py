"""What holds for every data set: its YAML and its fingerprint; tests/test_damaged_files.py damages its files."""

import inspect
from pathlib import Path

import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
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


def load(name, root, **options):
    build, sequence, more = ON_DISK[name]
    return build(str(root), **{"sequence": sequence, "stride": 1, **more, **options})


@pytest.mark.parametrize("path", sorted(CONF.glob("[a-z]*.yaml")), ids=lambda p: p.stem)
def test_yaml_keys_and_values_are_the_constructors_parameters_and_defaults(path):
    values = OmegaConf.to_container(compose(f"dataset={path.stem}").dataset)
    target = get_class(values.pop("_target_"))
    parameters = inspect.signature(target).parameters
    # A camera has no images to choose from, and the folder is its run's.
    unused = {"camera": {"root", "sequence", "start", "stop", "stride", "folder"}}.get(path.stem, set())
    defaults = {
        k: list(p.default) if isinstance(p.default, tuple) else p.default
        for k, p in parameters.items()
        if k not in unused
    }
    assert values == defaults
    assert target.name == path.stem


@pytest.mark.parametrize("name", ON_DISK)
def test_the_fingerprint_follows_the_options(name, request):
    root = request.getfixturevalue(f"{name}_root")
    found = [load(name, root, **options).fingerprint() for options in ({}, {"stride": 2}, {"size": (64, 48)})]
    assert len({*found}) == 3 and load(name, root).fingerprint() == found[0]
