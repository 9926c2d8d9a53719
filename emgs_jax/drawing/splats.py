"""Splats of `emgs polish` for viewers: read from splats.ply, packed for a page."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.drawing.colors import to_bytes
from emgs_jax.drawing.layers import fitted, packed_covariances, thinned
from emgs_jax.evaluation.clouds import NearestPoints
from emgs_jax.io.ply import SH_C0
from emgs_jax.io.ply_reader import read_vertices

_STEPS = 65535  # of a coordinate along the side of the box around all splats


class Splats(NamedTuple):
    """Splats in the map's frame and lengths."""

    means: np.ndarray  # (n, 3)
    covs: np.ndarray  # (n, 3, 3)
    normals: np.ndarray  # (n, 3), towards the side that they were seen from
    colors: np.ndarray  # (n, 4), RGB and the opacity at the centre, in [0, 1]


def read_splats(path: Path) -> Splats | None:
    """Read a 3DGS PLY; None if there is no file, ValueError if it is no such PLY."""
    if not path.is_file():
        return None
    vertices = read_vertices(path)

    def columns(*names: str) -> np.ndarray:
        missing = [name for name in names if name not in vertices]
        if missing:
            raise ValueError(f"{path} has no {', '.join(missing)}: it holds no splats; run emgs polish again")
        return np.stack([vertices[name] for name in names], axis=1).astype(np.float64)

    stds, turns = np.exp(columns(*(f"scale_{i}" for i in range(3)))), columns(*(f"rot_{i}" for i in range(4)))
    axes = (
        Rotation.from_quat(turns, scalar_first=True).as_matrix() * stds[:, None] if len(stds) else np.zeros((0, 3, 3))
    )
    colors = 0.5 + SH_C0 * columns(*(f"f_dc_{i}" for i in range(3)))
    opacity = 1.0 / (1.0 + np.exp(-columns("opacity")))
    return Splats(
        means=columns("x", "y", "z"),
        covs=axes @ axes.swapaxes(1, 2),
        normals=columns("nx", "ny", "nz"),
        colors=np.concatenate([colors.clip(0.0, 1.0), opacity], axis=1),
    )


def owners(splats: np.ndarray, gaussians: np.ndarray) -> np.ndarray:
    """Find for each splat's mean (n, 3) the nearest Gaussian (m, 3), whose class and certainty it takes."""
    if len(splats) and not len(gaussians):
        raise ValueError("the map has no Gaussian that splats could belong to: run emgs polish again")
    return NearestPoints(gaussians).query(splats)[1].reshape(len(splats)).astype(np.int32)


def splats_for_page(splats: Splats, limit: int) -> tuple[dict[str, Any], str, str, np.ndarray]:
    """Pack splats into at most `limit` characters; if they are too many, those that cover most.

    Returns:
        What the page's program needs (`arrays`, see `fitted`, and the box of the means), the packed arrays, a note on
        what was left out, and the means of the kept splats.
    """
    low, high = splats.means.min(0), splats.means.max(0)
    step = np.maximum(high - low, 1e-9) / _STEPS
    arrays = {
        "mean": np.rint((splats.means - low) / step).astype(np.uint16),
        "cov": packed_covariances(splats.covs),
        "normal": np.rint(127 * splats.normals).astype(np.int8),
        "color": to_bytes(splats.colors),
    }
    covered = splats.colors[:, 3] * np.linalg.eigvalsh(splats.covs)[:, 1:].prod(1)
    about, text, shown = fitted(arrays, {}, covered, limit)
    whole = len(splats.means)
    note = f"The page shows the {shown:,} of {whole:,} splats that cover most; splats.ply has all of them."
    box = {"low": low.tolist(), "step": step.tolist()}
    means = thinned({"mean": splats.means}, covered, shown)["mean"]
    return {"arrays": about, **box}, text, note if shown < whole else "", means
