"""Check that poses and depths of two views fit, and recognise other conventions and units."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.data.pose_conventions import EXPECTED, READINGS
from emgs_jax.data.readable import ReadableFrames

MAX_MISFIT = 0.02  # median, relative; below, no other convention is tried
MIN_GAIN, GOOD_MISFIT = 3.0, 0.05  # factor by which another convention must fit better, and its largest misfit
MIN_SHARED = 100  # points
STEP = 4  # between compared pixels
FACTORS = np.geomspace(1e-3, 1e3, 241)  # of depths in another unit: 6 % apart
MIN_FACTOR = 2.0  # smaller factors are errors of the prediction
KNOWN_SCALES = 256.0, 1000.0, 4000.0, 5000.0, 6553.5  # raw units a metre, of KITTI, most sensors, L515, TUM, Replica
NUM_PAIRS, GAP = 4, 4  # of frames, and frames between them


class Sight(NamedTuple):
    """A view, or some pixels of it: camera-frame points, usable pixels and pose."""

    points: Float[np.ndarray, "*pixels 3"]
    mask: Bool[np.ndarray, "*pixels"]
    T_world_camera: Float[np.ndarray, "4 4"]


Read = Callable[[Sight], Sight]  # converts each pixel by itself, and the pose


def as_it_is(sight: Sight) -> Sight:
    return sight


def check_conventions(
    pairs: Iterable[tuple[Sight, Sight]], intrinsics: Sequence[float], source: str, max_misfit: float
) -> str:
    """Describe by how much the depths of pairs of views differ, as the median of |log of the ratio|.

    Raises:
        ValueError: they differ by more than `max_misfit`, or fit much better in another convention or unit.
    """
    pairs = [*pairs]
    own = median_misfit(pairs, intrinsics)
    words = f"the depths of two views differ by {100 * own:.1f} %{' (they share nothing)' if np.isinf(own) else ''}"
    if not own > MAX_MISFIT:
        return words
    found = {words: median_misfit(pairs, intrinsics, read) for words, read in _readings().items()}
    turned = [(_mirrored(a), _mirrored(b)) for a, b in pairs]
    found["the depths are mirrored, left for right"] = median_misfit(turned, intrinsics)
    best = min(found, key=lambda words: found[words])
    closest = f"by {100 * found[best]:.1f} % where {best}"
    expected = f"expected are {EXPECTED}, depths along z, and one unit for poses and depths"
    if found[best] < min(own / MIN_GAIN, GOOD_MISFIT):
        raise ValueError(f"{source}: {words}, and {closest}: {expected}")
    rest = median_misfit(pairs, intrinsics, has_own_scales=True)
    rest = f"by {100 * rest:.1f} % where each view has a scale of its own"
    if own > max_misfit:
        raise ValueError(
            f"{source}: {words}, {rest}, {closest}: {expected}. Depths of a network that sees one image at a time have "
            "a scale, and often a shift, of their own in each: align them with the poses, or predict all images "
            f"together. prior.max_misfit={own:.2g} maps them as they are"
        )
    return f"{words}, {rest}"


def median_misfit(
    pairs: Sequence[tuple[Sight, Sight]],
    intrinsics: Sequence[float],
    read: Read = as_it_is,
    has_own_scales: bool = False,
) -> float:
    """Median `misfit` of the pairs after `read`; 0 without any."""
    found = [misfit(a, b, intrinsics, read, has_own_scales) for a, b in pairs]
    return float(np.median(found)) if found else 0.0


def misfit(
    a: Sight, b: Sight, intrinsics: Sequence[float], read: Read = as_it_is, has_own_scales: bool = False
) -> float:
    """Median of |log of the ratio| of the depths of b's points in a and a's own, after `read`; inf for too few.

    With `has_own_scales` the median of the log is subtracted first.
    """
    fx, fy, cx, cy = intrinsics
    b = read(_chosen(b, (slice(None, None, STEP), slice(None, None, STEP))))
    T_a_b = np.linalg.inv(read(_chosen(a, (slice(0), slice(0)))).T_world_camera) @ b.T_world_camera
    points = b.points @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    points = points[points[:, 2] > 0]
    u = np.rint(fx * points[:, 0] / points[:, 2] + cx)
    v = np.rint(fy * points[:, 1] / points[:, 2] + cy)
    height, width = a.mask.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    rows, columns = v[inside].astype(int), u[inside].astype(int)
    known = a.mask[rows, columns]
    if known.sum() < MIN_SHARED:
        return np.inf
    ratios = points[inside, 2][known] / read(_chosen(a, (rows, columns))).points[:, 2]
    logs = np.log(ratios[ratios > 0])  # a reading may have put points behind the camera
    if len(logs) < MIN_SHARED:
        return np.inf
    return float(np.median(np.abs(logs - np.median(logs) if has_own_scales else logs)))


def _chosen(sight: Sight, pixels: tuple) -> Sight:
    """The usable ones of some pixels of a view."""
    mask = sight.mask[pixels]
    return Sight(sight.points[pixels][mask], mask[mask], sight.T_world_camera)


def _readings() -> dict[str, Read]:
    """Functions that convert a sight to other conventions, by description."""
    found: dict[str, Read] = {
        f"the poses are taken as {words}": partial(_posed, change=change) for words, change in READINGS.items()
    }
    found["the depths are taken as lengths of the rays"] = lambda sight: times(sight, 1 / _stretch(sight.points))
    found["the points are taken as those of the world"] = _in_camera
    for factor in FACTORS:
        if abs(np.log(factor)) > np.log(MIN_FACTOR):
            found[f"the depths are multiplied by about {factor:.4g}, or the positions by {1 / factor:.4g}"] = partial(
                times, factor=factor
            )
        found[f"the depths are taken as {factor:.4g} / depth"] = partial(_inverse, factor=factor)
    return found


def _posed(sight: Sight, change: Callable[[np.ndarray], np.ndarray]) -> Sight:
    return sight._replace(T_world_camera=change(sight.T_world_camera))


def _in_camera(sight: Sight) -> Sight:
    T = sight.T_world_camera
    return sight._replace(points=(sight.points - T[:3, 3]) @ T[:3, :3])


def _mirrored(sight: Sight) -> Sight:
    """Mirror the depths, left for right."""
    depth = sight.points[..., 2]
    with np.errstate(invalid="ignore"):  # where there is no depth
        points = sight.points / np.where(depth > 0, depth, 1)[..., None] * depth[:, ::-1, None]
    return Sight(points, sight.mask & sight.mask[:, ::-1], sight.T_world_camera)


def times(sight: Sight, factor: float | Float[np.ndarray, "*pixels"]) -> Sight:
    """Multiply the depths by a factor, for all or for each pixel."""
    return sight._replace(points=sight.points * np.asarray(factor)[..., None])


def _inverse(sight: Sight, factor: float) -> Sight:
    """Replace the depths by factor / depth."""
    return times(sight, factor / np.square(sight.points[..., 2]))


def _stretch(points: Float[np.ndarray, "*pixels 3"]) -> Float[np.ndarray, "*pixels"]:
    """Length of the ray to each point over its depth."""
    return np.linalg.norm(points, axis=-1) / points[..., 2]


def check_truth(dataset: ReadableFrames, depth_scale: float | None) -> None:
    """Raise ValueError if true depths and poses fit much better in another unit or convention.

    `depth_scale` is raw units a metre by which depths were read, for which the `KNOWN_SCALES` are tried first, or None.
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
    """Pairs of frames with depth and pose, evenly spread; unreadable ones are reported later."""
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
