"""Provenance of a run, and its metrics.json."""

import contextlib
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from emgs_jax.data.base import Dataset
from emgs_jax.io.files import flat, write_json
from emgs_jax.prior.base import Provenance

RESULT_FORMAT = 1  # of metrics.json; results of another format are refused
OWN_UNITS = ("colmap", "nerfstudio")  # data sets whose true poses have their own unit
PLACED_PERCENT = "trajectory/placed_percent"  # frames with a true pose that the path has
RAW_PRIOR = "raw_prior/"  # prefix of the same metrics for the raw prior
ROWS = {  # prefix of the metrics of an estimate -> what it is
    "": "ours",
    RAW_PRIOR: "raw prior",
    "baseline_voxel_raw/": "voxel, raw poses",
    "baseline_voxel_ours/": "voxel, our poses",
    "baseline_tsdf_raw/": "TSDF, raw poses",
    "baseline_tsdf_ours/": "TSDF, our poses",
}
_GROUPS = ("trajectory/", "reconstruction/", "segmentation/", "map/", "time/")
_PACKAGES = {name: (name,) for name in ("jax", "jaxlib", "numpy", "optimistix", "equinox")} | {
    "open3d": ("open3d-cpu", "open3d"),
    "cv2": ("opencv-python-headless", "opencv-python"),
    "emgs_jax": ("emgs_jax",),
}


def provenance(config: Mapping[str, Any], dataset: Dataset, prior: Provenance) -> dict[str, Any]:
    """Describe the origin of a result: the block in every result file."""
    device = jax.devices()[0]
    return {
        "format": RESULT_FORMAT,
        "protocol": config.get("evaluation", {}).get("protocol"),
        "simulated": prior.is_simulated,
        "prior": {"name": prior.name, "settings": prior.settings},
        "data": described(dataset),
        "seed": prior.settings.get("seed", 0),
        "git": git_now(),
        "versions": {"python": platform.python_version()} | {k: _version(names) for k, names in _PACKAGES.items()},
        "device": {"kind": device.device_kind, "backend": device.platform, "cpu_count": os.cpu_count()},
        "platform": platform.platform(),
        "config": config,
    }


def described(dataset: Dataset) -> dict[str, Any]:
    """Describe the frames of a data set, of a camera's those so far."""
    return {
        "name": dataset.name,
        "sequence": dataset.sequence,
        "fingerprint": dataset.fingerprint(),
        "camera": dict(dataset.calibration),  # of the images on disk
        "frames": {"size": [*dataset.size], "intrinsics": [*map(float, dataset.intrinsics)]},
    }


def signature(block: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a provenance that determines the bits of a result: no caches, checkpoints or views."""
    ignored = ("compilation_cache", "checkpoint", "view")
    return {**block, "config": {key: value for key, value in block["config"].items() if key not in ignored}}


def git_now() -> dict[str, Any] | None:
    """Return the `git_revision` of this code."""
    return git_revision(Path(__file__).resolve().parents[2])


def code_of(block: Mapping[str, Any]) -> tuple[dict[str, Any] | None, str | None]:
    """Return commit and version of a provenance; uncommitted changes do not show."""
    return block["git"], block.get("versions", {}).get("emgs_jax")


def code_now() -> tuple[dict[str, Any] | None, str | None]:
    """Return `code_of` for this code."""
    return git_now(), _version(_PACKAGES["emgs_jax"])


def git_revision(folder: Path) -> dict[str, Any] | None:
    """Return revision and changes of tracked files of the checkout whose top is `folder`; None elsewhere."""
    top = _git(folder, "rev-parse", "--show-toplevel")
    # An installed package may lie somewhere inside another project's checkout, which says nothing about this code.
    if top is None or Path(top).resolve() != folder.resolve():
        return None
    revision = _git(folder, "rev-parse", "HEAD")
    status = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return None if revision is None else {"revision": revision, "dirty": None if status is None else bool(status)}


def prefixed(metrics: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Put metrics under a prefix, for example RAW_PRIOR."""
    return {prefix + key: value for key, value in metrics.items()}


def write_metrics(path: str | os.PathLike, metrics: Mapping[str, Any]) -> None:
    """Write metrics.json in order: ours, the raw prior's, baselines', the rest; NaN and infinities become null."""
    write_json(path, {key: metrics[key] for key in sorted(metrics, key=_rank)})


def is_metric(settings: Mapping[str, Any]) -> bool:
    """Test whether a prior with these settings predicts in metres."""
    said = flat(settings)  # including the settings that made a recording
    if any(value == "m" for key, value in said.items() if key.split(".")[-1] == "unit"):
        return True
    has_unit = not any(key.endswith("median_depth") for key in said)
    return has_unit and all(value != "arbitrary" for key, value in said.items() if key.endswith("scale"))


def is_in_metres(block: Mapping[str, Any]) -> bool:
    """Test whether the map of a run is in metres: a saved one that was continued keeps its unit."""
    return block.get("is_metric", is_metric(block["prior"]["settings"]))


def has_metric_truth(block: Mapping[str, Any]) -> bool:
    """Test whether the true poses of a result are in metres."""
    return (block.get("data") or {}).get("name") not in OWN_UNITS


def length_words(length: float, block: Mapping[str, Any]) -> str:
    """Write a length of the truth in centimetres, or in units of its own."""
    return f"{100 * length:.1f} cm" if has_metric_truth(block) else f"{length:.3g} units of the reference"


def prefix_of(key: str) -> str:
    """Return the prefix in `ROWS` of a metric's key."""
    return next((prefix for prefix in ROWS if prefix and key.startswith(prefix)), "")


def _rank(key: str) -> tuple[int, int]:
    name = key.removeprefix(prefix_of(key))
    group = next((rank for rank, prefix in enumerate(_GROUPS) if name.startswith(prefix)), len(_GROUPS))
    return (list(ROWS).index(prefix_of(key)) if "/" in key else len(ROWS)), group


def _version(names: tuple[str, ...]) -> str | None:
    """Return the version of the first of these packages that is installed."""
    for name in names:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            return importlib.metadata.version(name)
    return None


def _git(folder: Path, *arguments: str) -> str | None:
    command, how = ["git", "-C", str(folder), *arguments], {"encoding": "utf-8", "errors": "replace", "timeout": 10}
    try:
        return subprocess.run(command, capture_output=True, check=True, **how).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
