"""Do true depths and true poses of a data set fit each other? A wrong unit or convention is found by two frames."""

import contextlib
from collections.abc import Iterator
from functools import partial

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.prior.files.conventions import (
    GOOD_MISFIT,
    MAX_MISFIT,
    MIN_GAIN,
    Sight,
    check_conventions,
    median_misfit,
    times,
)

KNOWN_SCALES = 256.0, 1000.0, 4000.0, 5000.0, 6553.5  # raw units a metre, of KITTI, most sensors, L515, TUM, Replica
NUM_PAIRS, GAP = 4, 4  # of frames, and how far apart they are


def check_truth(dataset: ReadableFrames, depth_scale: float | None) -> None:
    """Raise ValueError where true depths and poses fit each other much better in another unit or convention.

    Args:
        dataset: with ground truth, else nothing is looked at.
        depth_scale: raw units a metre by which its depths were read, for which the `KNOWN_SCALES` are tried first;
            None: it is not known.
    """
    if not dataset.has_ground_truth:
        return
    pairs, name = [*_pairs(dataset)], f"{dataset.name} {dataset.sequence}"
    if depth_scale is not None:
        _check_depth_unit(pairs, depth_scale, dataset.intrinsics, name)
    check_conventions(pairs, dataset.intrinsics, f"{name}, true poses and depths", np.inf)


def _check_depth_unit(
    pairs: list[tuple[Sight, Sight]], depth_scale: float, intrinsics: tuple[float, ...], name: str
) -> None:
    fits = {
        scale: median_misfit(pairs, intrinsics, partial(times, factor=depth_scale / scale))
        for scale in (depth_scale, *KNOWN_SCALES)
    }
    own, best = fits[depth_scale], min(fits, key=lambda scale: fits[scale])
    if own > MAX_MISFIT and fits[best] < min(own / MIN_GAIN, GOOD_MISFIT):
        raise ValueError(
            f"{name}: with dataset.depth_scale={depth_scale:g} the depths of two frames "
            f"differ by {100 * own:.1f} % (inf: they share nothing), and by {100 * fits[best]:.1f} % with {best:g} raw "
            f"units a metre: give dataset.depth_scale={best:g}, or poses in metres"
        )


def _pairs(dataset: ReadableFrames) -> Iterator[tuple[Sight, Sight]]:
    """Frames with depth and pose, evenly spread; one that cannot be read says so when it is its turn."""
    for first in np.unique(np.linspace(0, max(len(dataset) - 1 - GAP, 0), NUM_PAIRS).astype(int)).tolist():
        with contextlib.suppress(BadFrameError):
            a, b = (dataset[row] for row in (first, min(first + GAP, len(dataset) - 1)))
            sights = _sight(a, dataset.intrinsics), _sight(b, dataset.intrinsics)
            if sights[0] is not None and sights[1] is not None:
                yield sights[0], sights[1]


def _sight(frame: Frame, intrinsics: tuple[float, ...]) -> Sight | None:
    if frame.depth is None or frame.T_world_camera is None:
        return None
    return Sight(backproject(frame.depth, intrinsics), frame.depth > 0, frame.T_world_camera)
