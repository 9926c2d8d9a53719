"""Fit scale and shift of a monocular or video network's depths to landmarks of known depth.

    log y = s + log(u + c (m - u)) + e,   u = a v + b

v is the network's value at a pixel, y the depth z or, if the network predicts inverse depth, 1/z. Slope a, intercept b
and median m belong to the whole sequence. Every frame has a log scale s and, if the kind has a shift, a shift c, which
shrinks y's differences from m. Both are random walks. e is the network's error, shared by the landmarks of a cell of
the image, plus the landmark's own. Errors and steps follow Student's t, so outliers and jumps count little: iteratively
reweighted least squares (EM for the t, Lange, Little and Taylor, JASA 1989) around a linear smoother, which also
estimates the variances.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.landmarks import Landmarks

KINDS = ("metric", "up_to_scale", "affine", "affine_inverse")
LEAST_RATIO = 0.02  # of predicted to true y; smaller ones count as this
MAX_SHIFT = 0.95  # at 1 all depths would be equal


@dataclass(frozen=True)
class LandmarkFitConfig:
    """Prior assumptions about scale, shift and errors."""

    std: float = number(0.05, low=1e-4, high=10)  # of log y, the network's error
    step_std: float = number(0.01, low=1e-6, high=10)  # of the log scale and of the shift, from a frame to the next
    shift_std: float = number(1.0, low=1e-3, high=100)  # of the shift itself
    dof: float = number(4.0, low=1, high=1000)  # degrees of freedom of Student's t
    weight: float = number(3.0, low=0, high=1000)  # of these assumptions, in frames
    min_landmarks: int = number(12, low=3, high=10000)  # of a frame that starts at its own fit
    min_correlation: float = number(0.3, low=0, high=1)  # rank correlation of v and y; less contradicts the kind
    num_steps: int = number(20, low=1, high=1000)  # of the iteration


class LandmarkFit(NamedTuple):
    """Scale and shift of the frames of a sequence."""

    is_inverse: bool  # y is 1/z
    base: tuple[float, float, float]  # slope a, intercept b and median m
    parameters: np.ndarray  # (n, 2) log scale s and shift c
    covariance: np.ndarray  # (n, 2, 2) of the parameters
    std: np.ndarray  # (n,) of the network's log y
    step_std: np.ndarray  # of log scale and shift, from a frame to the next


class _Sample(NamedTuple):
    """Landmarks of one frame: u, y, variance of log y, weight."""

    u: np.ndarray
    y: np.ndarray
    variance: np.ndarray
    weight: np.ndarray


def to_depth(
    values: Float[np.ndarray, "h w"], fit: LandmarkFit, row: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Depth z of a network's values v (NaN = none), in the landmarks' unit, and standard deviation of log z.

    Depth is 0 and the standard deviation inf without a value, or where the point would lie behind the camera.
    """
    slope, intercept, median = fit.base
    y, by_shift = _predicted(slope * np.float64(values) + intercept, median, fit.parameters[row])
    is_known = np.isfinite(y) & (y > 0)
    y, by_shift = np.where(is_known, y, 1.0), np.where(is_known, by_shift, 0.0)
    (scale, mixed), (_, shift) = fit.covariance[row]
    variance = fit.std[row] ** 2 + scale + 2 * mixed * by_shift + shift * by_shift**2
    depth = 1.0 / y if fit.is_inverse else y
    return np.float32(np.where(is_known, depth, 0.0)), np.float32(np.where(is_known, np.sqrt(variance), np.inf))


def fit_to_landmarks(
    values: Sequence[Float[np.ndarray, "k"]],
    landmarks: Sequence[Landmarks],
    frames: Sequence[int],
    kind: str,
    config: LandmarkFitConfig,
) -> LandmarkFit:
    """Fit scale and shift of every frame.

    Args:
        values: the network's values at each frame's landmarks; NaN where it has none.
        frames: ascending numbers of the frames.
        kind: of `KINDS`; `metric` and `up_to_scale` depths have a scale, `affine` and `affine_inverse` (1/z) also a
            shift.

    Raises:
        ValueError: no frame has enough landmarks, or they contradict the kind.
    """
    is_inverse, has_shift = kind == "affine_inverse", kind.startswith("affine")
    samples = [_sample(v, found, is_inverse) for v, found in zip(values, landmarks, strict=True)]
    is_enough = np.array([len(sample.y) >= config.min_landmarks for sample in samples])
    if not is_enough.any():
        most = max((len(sample.y) for sample in samples), default=0)
        raise ValueError(
            f"no frame has {config.min_landmarks} landmarks where the network predicts a depth (at most {most}): the "
            "scale of its depths cannot be found; give more frames, or prior/dense=sweep"
        )
    _check_kind([sample for sample, is_one in zip(samples, is_enough, strict=True) if is_one], kind, config)
    base = _base(samples, has_shift)
    samples = [sample._replace(u=base[0] * sample.u + base[1]) for sample in samples]
    start = np.full((len(samples), 2), np.nan)
    for row in np.flatnonzero(is_enough):
        start[row] = _own_fit(samples[row], base[2], has_shift)
    rows = np.arange(len(samples))
    start = np.stack([np.interp(rows, rows[is_enough], start[is_enough, part]) for part in (0, 1)], axis=1)
    return _smoothed(samples, start, base, np.diff(frames), is_inverse, has_shift, config)


def _sample(values: np.ndarray, landmarks: Landmarks, is_inverse: bool) -> _Sample:
    is_known = np.isfinite(values) & (landmarks.depth > 0) & (is_inverse | (values > 0))
    _, depth, std, weight = (part[is_known] for part in landmarks)
    return _Sample(np.float64(values[is_known]), np.float64(1.0 / depth if is_inverse else depth), std**2, weight)


def _check_kind(samples: Sequence[_Sample], kind: str, config: LandmarkFitConfig) -> None:
    """Raise ValueError unless the values' ranks grow with those of y (median over the frames)."""
    found = float(np.median([np.corrcoef(rankdata(s.u), rankdata(s.y))[0, 1] for s in samples]))
    if np.isfinite(found) and found >= config.min_correlation:
        return
    quantities = ["depths (affine, up_to_scale, metric)", "inverse depths (affine_inverse)"]
    said, other = quantities[::-1] if kind == "affine_inverse" else quantities
    hint = "are they of these frames, in their order, and of the whole image?"
    if found <= -config.min_correlation:
        hint = f"they are {other}, or the structure is inside out, as one of images from nearly one place (give more)"
    raise ValueError(
        f"prior.dense.kind={kind}: the rank correlation of values and landmarks' {said} is {found:.2f}: {hint}"
    )


def _base(samples: Sequence[_Sample], has_shift: bool) -> tuple[float, float, float]:
    """Slope a, intercept b and median m of the sequence: a robust fit to all landmarks."""
    u, y, _, weight = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    slope, intercept = _least_absolute(u, y, weight, has_shift)
    if slope <= 0:  # frames differ by more than the depths of one frame
        slope, intercept = _least_absolute(u, y, weight, has_shift=False)
    return slope, intercept, float(np.median(y))


def _least_absolute(u: np.ndarray, y: np.ndarray, weight: np.ndarray, has_shift: bool) -> tuple[float, float]:
    """Slope and intercept with the least absolute relative error |(a u + b) / y - 1|, by reweighting."""
    inputs = np.stack([u, np.ones_like(u)] if has_shift else [u], axis=1) / y[:, None]
    size = np.sqrt(np.mean(inputs**2, axis=0))
    inputs, found, w = inputs / size, np.zeros(inputs.shape[1]), weight
    for _ in range(30):
        weighted = inputs * w[:, None]
        found = np.linalg.solve(inputs.T @ weighted + 1e-9 * w.sum() * np.eye(len(size)), weighted.sum(axis=0))
        w = weight / np.maximum(np.abs(inputs @ found - 1.0), 1e-3)
    slope, *intercept = found / size
    return float(slope), float(intercept[0]) if intercept else 0.0


def _own_fit(sample: _Sample, median: float, has_shift: bool) -> tuple[float, float]:
    """Log scale and shift of a frame by itself; shift 0 where its depths do not determine one."""
    slope, intercept = _least_absolute(sample.u, sample.y, sample.weight, has_shift)
    level = slope * median + intercept
    if slope <= (1 - MAX_SHIFT) * level / median or level <= 0:
        slope, intercept = _least_absolute(sample.u, sample.y, sample.weight, has_shift=False)
        level = slope * median
    return np.log(level / median), 1.0 - slope * median / level


def _predicted(u: np.ndarray, median: float, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """y, and the derivative of log y by the shift, which is meaningless where y ≤ 0."""
    log_scale, shift = parameters
    mixed = u + shift * (median - u)
    return np.exp(log_scale) * mixed, (median - u) / np.where(mixed > 0, mixed, 1.0)


def _smoothed(
    samples: Sequence[_Sample],
    start: np.ndarray,
    base: tuple[float, float, float],
    gaps: np.ndarray,
    is_inverse: bool,
    has_shift: bool,
    config: LandmarkFitConfig,
) -> LandmarkFit:
    """Refine the fits of all frames together."""
    count, dof = len(samples), config.dof
    found, variance = start, np.full(count, config.std**2)
    step_variance = np.full(2, config.step_std**2)
    step_weight = np.ones((max(count - 1, 0), 2))
    # Information before any landmark; without a shift it is held at 0.
    prior = np.diag([1e-6, config.shift_std**-2 if has_shift else 1e12])
    for _ in range(config.num_steps):
        evidence = [_evidence(s, base[2], at, v, dof) for s, at, v in zip(samples, found, variance, strict=True)]
        information = np.stack([matrix for matrix, _, _, _ in evidence]) + prior
        vector = np.stack([vector for _, vector, _, _ in evidence])
        found, covariance, of_step = smooth(information, vector, step_weight / (gaps[:, None] * step_variance))
        found[:, 1] = np.minimum(found[:, 1], MAX_SHIFT)
        squares, weights = (np.array([found[part] for found in evidence]) for part in (2, 3))
        common = (squares.sum() + config.weight * config.std**2) / (weights.sum() + config.weight)
        variance = (squares + config.weight * common) / (weights + config.weight)
        squared = (np.diff(found, axis=0) ** 2 + of_step) / gaps[:, None]
        step_weight = (dof + 1) / (dof + squared / step_variance)
        total = (step_weight * squared).sum(axis=0) + config.weight * config.step_std**2
        step_variance = np.maximum(total / (count - 1 + config.weight), 1e-10)
    return LandmarkFit(is_inverse, base, found, covariance, np.sqrt(variance), np.sqrt(step_variance))


def _evidence(
    sample: _Sample, median: float, parameters: np.ndarray, variance: float, dof: float
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Information matrix and vector of a frame's landmarks, and weighted sum of squares and number of its errors."""
    y, by_shift = _predicted(sample.u, median, parameters)
    ratio = np.maximum(y / sample.y, LEAST_RATIO)
    residual, inputs = -np.log(ratio), np.stack([np.ones_like(ratio), by_shift * (y > 0)], axis=1)
    total = variance + sample.variance
    heavy = (dof + 1) / (dof + residual**2 / total)
    weighted = inputs * (sample.weight * heavy / total)[:, None]
    share = variance / total  # of the network in a residual
    squares = heavy * (share * residual) ** 2 + share * sample.variance
    vector = weighted.T @ (residual + inputs @ parameters)
    return weighted.T @ inputs, vector, float(sample.weight @ squares), float(sample.weight.sum())


def smooth(
    information: Float[np.ndarray, "n d d"], vector: Float[np.ndarray, "n d"], step: Float[np.ndarray, "n1 d"]
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d d"], Float[np.ndarray, "n1 d"]]:
    """Means and covariances of a measured random walk, and the variances of its steps.

    A two-filter smoother (Fraser and Potter, IEEE TAC 1969) in information form: a state may be measured in some
    directions only. `vector` is information times measurement, `step` the information of each step's coordinates.
    """
    count, size = vector.shape
    walk = step[:, :, None] * np.eye(size)

    def passed(order: range) -> tuple[np.ndarray, np.ndarray]:
        """The messages to each state from the side where `order` begins."""
        matrices, vectors = np.zeros_like(information), np.zeros_like(vector)
        before = None
        for row in order:
            if before is not None:
                known, told = matrices[before] + information[before], vectors[before] + vector[before]
                link = walk[min(before, row)]
                gain = link @ np.linalg.inv(known + link)
                matrices[row], vectors[row] = gain @ known, gain @ told
            before = row
        return matrices, vectors

    ahead, behind = passed(range(count)), passed(range(count - 1, -1, -1))
    covariance = np.linalg.inv(information + ahead[0] + behind[0])
    means = np.einsum("nij,nj->ni", covariance, vector + ahead[1] + behind[1])
    left, right = (information + ahead[0])[:-1] + walk, (information + behind[0])[1:] + walk
    joint = np.linalg.inv(np.concatenate([np.concatenate([left, -walk], 2), np.concatenate([-walk, right], 2)], 1))
    difference = np.concatenate([-np.eye(size), np.eye(size)], axis=1)
    steps = np.einsum("ij,njk,ik->ni", difference, joint, difference)
    return means, covariance, steps
