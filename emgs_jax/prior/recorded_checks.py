"""Checks of a recording's contents: a file that fits its checksum may still be forged, or come from a faulty prior."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from emgs_jax.data.reading import is_rigid

COMPLETE = "`python -m experiments.predict`, called as for the others, makes what is missing or damaged"
REMEDY = "record into another folder with `python -m experiments.predict`"
FIELDS = {  # array -> dtype and the axes that it has; d, v, h, w, i, j, c, k, l have one length each, y, x, f are free
    "T_anchor_view": (np.float64, "vij"),
    "points": (np.float32, "dhwc"),
    "confidence": (np.float32, "dhw"),
    "mask": (np.bool_, "dhw"),
    "features": (np.float16, "dyxf"),
}
OPTIONAL = {"pose_covariance": (np.float64, "vkl"), "scale_std": (np.float64, ""), "world": (np.int64, "")}
MAX_LENGTH = 1e6  # of positions, in the prior's unit: more is no room
MANIFEST = {
    "dataset": dict,
    "window_size": int,
    "provenance": dict,
    "feature_names": list,
    "num_inferences": int,
    "complete": bool,
    "files": dict,
}
DATASET = {"name": str, "sequence": str, "num_frames": int, "size": list, "intrinsics": list, "fingerprint": str}
PROVENANCE = {"name": str, "settings": dict, "is_simulated": bool}


def check_manifest(path: object, manifest: Mapping[str, Any]) -> None:
    """Raise ValueError where a manifest lacks a key or one has another type."""
    parts = manifest.get("dataset"), manifest.get("provenance")
    for block, keys in zip((manifest, *parts), (MANIFEST, DATASET, PROVENANCE), strict=True):
        for key, kind in keys.items():
            if not isinstance(block, dict) or type(block.get(key)) is not kind:
                raise ValueError(f"{path} is no manifest: {key} must be there as {kind.__name__}: {REMEDY}")
    unknown = manifest["provenance"].keys() - PROVENANCE.keys()
    if unknown:
        raise ValueError(f"{path} is no manifest: provenance has {', '.join(sorted(unknown))}: {REMEDY}")


def check_text(path: object, vectors: np.ndarray, names: Sequence[str]) -> None:
    """Raise ValueError where text features are not a finite vector for each name."""
    fits = vectors.ndim == 2 and len(vectors) == len(names) and vectors.dtype.kind == "f"
    if not fits or not np.isfinite(vectors).all():
        raise ValueError(
            f"{path} must hold a finite vector for each of {len(names)} names, got {vectors.shape}: {REMEDY}"
        )


def check_arrays(path: object, arrays: Mapping[str, np.ndarray], sizes: Mapping[str, int]) -> None:
    """Raise ValueError where an array has not the dtype and shape of the format."""
    sizes = {**sizes, "i": 4, "j": 4, "c": 3, "k": 6, "l": 6}
    for key, (dtype, axes) in (FIELDS | {key: OPTIONAL[key] for key in OPTIONAL if key in arrays}).items():
        got = arrays[key]
        expected = tuple(sizes.get(axis, got.shape[k] if k < got.ndim else 0) for k, axis in enumerate(axes))
        if got.dtype != dtype or got.shape != expected:
            raise ValueError(
                f"{path}: {key} must be {np.dtype(dtype)} {expected}, got {got.dtype} {got.shape}: {REMEDY}"
            )


def check_numbers(path: object, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError where numbers that the mask lets through, or the poses, mean nothing.

    A pose that is not finite is allowed: there the prior has none.
    """
    points, confident = arrays["points"][arrays["mask"]], arrays["confidence"][arrays["mask"]]
    poses = arrays["T_anchor_view"]
    poses = poses[np.isfinite(poses).all((1, 2))]
    faults = {
        "points under the mask are not finite": not np.isfinite(points).all(),
        f"points under the mask are farther than {MAX_LENGTH:g}": not (np.abs(points) <= MAX_LENGTH).all(),
        "a confidence under the mask is negative or not finite": not ((confident >= 0) & np.isfinite(confident)).all(),
        "features are not finite": not np.isfinite(arrays["features"]).all(),
        "a pose is no rigid motion": not is_rigid(poses),
        f"a pose is farther than {MAX_LENGTH:g}": not (np.abs(poses[:, :3, 3]) <= MAX_LENGTH).all(),
    }
    for what, is_there in faults.items():
        if is_there:
            raise ValueError(f"{path}: {what}: the recording is forged or its prior has a fault; {REMEDY}")
