"""Factors of the pose graph that a frame adds: its pose relative to earlier frames, and to the map."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.device.arrays import to_se3
from emgs_jax.geometry import scale_pose
from emgs_jax.loop_closure.place_recognition import Keyframe
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.ops.ranges import number
from emgs_jax.pose_graph.factors import Factors
from emgs_jax.pose_graph.problem import bucket
from emgs_jax.registration.pose_noise import LEAST_NOISE

SAME = 1e-6  # by which a predicted pose may differ from itself: rounding


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations of pose factors, as multiples of the relative depth noise ν of a frame's points.

    A rotation has the standard deviation k ν, a translation k ν z with the median depth z. So the factors k have no
    unit, and a prior that is twice as noisy gets half the weight. With these values χ² is one per measured row on walks
    of the simulated prior.

    Args:
        pair: of the relative pose of two consecutive frames; √n times that for frames n apart.
        map: of a frame relative to the frame whose Gaussians it was registered to.
        log_scale: of the log-ratio of two consecutive frames' scales, like `pair`.
        depth: ν of a frame that was not registered to the map, such as the first.
    """

    pair: float = number(0.18, low=1e-9, high=1000)
    map: float = number(0.5, low=1e-9, high=1000)
    log_scale: float = number(0.08, low=1e-9, high=1000)  # the map holds its scale: 1.5 % over hundreds of frames
    depth: float = number(0.03, low=1e-9, high=1000)


@dataclass(frozen=True)
class FrameData:
    """Input of the back end from one frame, besides its pose.

    Args:
        index: in the data set.
        image: RGB, uint8 (h, w, 3).
        points: camera frame, m of its inference, (h, w, 3).
        mask: of these, (h, w).
        T_anchor_views: by frame index, the poses (4, 4) that its inference predicts; some may not be finite.
        covariance: (6, 6) of its pose, see `FrameRecord`; None without one.
        world: of `T_anchor_views`, see `PriorPrediction`.
        depth_noise: ν, the points' difference from the map; None if the frame was not tracked, because a few points
            near the map by chance do not count.
    """

    index: int
    image: np.ndarray
    points: np.ndarray
    mask: np.ndarray
    T_anchor_views: Mapping[int, np.ndarray]
    depth_noise: float | None = None
    covariance: np.ndarray | None = None
    world: int = 0

    @property
    def predicted(self) -> np.ndarray | None:
        """Its own predicted pose, in the prior's first world; None without one."""
        return self.T_anchor_views.get(self.index) if self.world == 0 else None

    @property
    def depth(self) -> float:
        """Median z of the points, m of its inference; 1 without points."""
        return float(np.median(self.points[self.mask][:, 2])) if self.mask.any() else 1.0


class Factor(NamedTuple):
    """One row of `Factors`, on the host: Z (4, 4), sqrt_info (7, 7).

    Args:
        is_predicted: Z is the prior's own prediction, not the difference of two estimated poses.
    """

    a: int
    b: int
    Z_a_b: np.ndarray
    log_ratio: float
    sqrt_info: np.ndarray
    is_loop: bool
    is_predicted: bool = False


def _weights(frame: FrameData, noise: NoiseConfig, angle: float, log_scale: float = np.inf) -> np.ndarray:
    """Compute the root (7, 7) of the information of independent errors, in multiples of ν; infinite ones get 0."""
    depth_noise = noise.depth if frame.depth_noise is None else max(frame.depth_noise, LEAST_NOISE)
    return _root(depth_noise, frame.depth, angle, log_scale)


def _root(depth_noise: float, depth: float, angle: float, log_scale: float) -> np.ndarray:
    return np.diag(1.0 / (depth_noise * np.array([angle * depth] * 3 + [angle] * 3 + [log_scale])))


def sequential_factor(
    frame: FrameData,
    poses: Sequence[np.ndarray],
    log_scales: Sequence[float],
    is_connected: Callable[[int], bool],
    noise: NoiseConfig,
) -> Factor | None:
    """Build the last frame's sequential factor to the nearest earlier frame in its window; None without one.

    The measurement is the estimated pose, not the predicted one, because the map was made at the estimated poses. Noisy
    predictions would move every frame together with the Gaussians that it made, and roughen all surfaces.

    Args:
        poses: T_world_camera (4, 4) of all nodes, in order of time; the last one is this frame's.
        log_scales: σ of all nodes, likewise.
        is_connected: tells whether a factor may join a node: its pose is an estimate, not a placeholder.
    """
    time = len(poses) - 1
    offset = next(_offsets(frame, time, is_connected), None)
    if offset is None:
        return None
    row, spread = time - offset, np.sqrt(offset)
    weights = _weights(frame, noise, spread * noise.pair, spread * noise.log_scale)
    measured = _relative_pose(poses, log_scales, time, row)
    return Factor(time, row, measured, log_scales[row] - log_scales[time], weights, is_loop=False)


def window_factor(
    frame: FrameData,
    poses: Sequence[np.ndarray],
    log_scales: Sequence[float],
    is_connected: Callable[[int], bool],
    noise: NoiseConfig,
    limits: tuple[float, float],
) -> Factor | None:
    """Build the window factor of a last frame that comes back: its predicted pose relative to the earliest view.

    A frame that comes back is registered to what an earlier visit made, so its estimated pose repeats the errors of
    that visit's path. What its inference predicts of the present path does not: it is a second measurement of a path
    that was walked twice. Over the whole window it bends the path smoothly and roughens no surface. Its errors are
    those of `noise.pair` over so many frames; the inference does not measure how scales change.

    Args:
        limits: largest number of nodes to that view, which an anchor of the earlier visit exceeds; and largest χ² at
            the estimated poses, beyond which one of the two is no measurement of this path.

    Returns:
        The factor; None without one within the limits.
    """
    time, (max_gap, max_chi2) = len(poses) - 1, limits
    offset = max((offset for offset in _offsets(frame, time, is_connected) if offset <= max_gap), default=None)
    if offset is None:
        return None
    measured = np.linalg.inv(frame.T_anchor_views[frame.index]) @ frame.T_anchor_views[frame.index - offset]
    weights = _weights(frame, noise, np.sqrt(offset) * noise.pair)
    factor = Factor(time, time - offset, measured, 0.0, weights, is_loop=False, is_predicted=True)
    return factor if chi2(factor, poses, log_scales) <= max_chi2 else None


def _offsets(frame: FrameData, time: int, is_connected: Callable[[int], bool]) -> Iterator[int]:
    """Yield how many frames before the last one its views are whose nodes a factor may join, the nearest first."""
    known = {index for index, pose in frame.T_anchor_views.items() if np.isfinite(pose).all()}
    for offset in sorted(frame.index - index for index in known if frame.index in known):
        if 0 < offset <= time and is_connected(time - offset):
            yield offset


def is_repeated(frame: FrameData, before: int, predicted: np.ndarray | None) -> bool:
    """Test whether the inference of a registered frame repeats what another one predicted of the frame before.

    The anchor's own pose, and frames from which a map was made together, show no repetition.

    Args:
        before: index of that frame.
        predicted: its pose as predicted then.
    """
    again = frame.T_anchor_views.get(before)
    if frame.depth_noise is None or frame.world != 0 or predicted is None or again is None:
        return False
    return bool(np.allclose(again, predicted, rtol=0, atol=SAME) and not np.array_equal(again, np.eye(4)))


def with_disagreement(factor: Factor, T_a_b: np.ndarray, predicted: np.ndarray, depths: tuple[float, float]) -> Factor:
    """Add to a factor's variances the mean square by which the estimated and the predicted relative pose differ.

    A prior that has one pose for each frame repeats it, so the repetition does not show how accurate it is. Its path
    and that of the map measure one motion, and by as much as they differ, one of them is wrong, whatever the depths'
    noise. The mean is over the six axes, translations in median depths, because points at that depth tell a turn from
    a shift only badly.

    Args:
        T_a_b: relative pose of the nodes (4, 4) as estimated, m of the map.
        predicted: likewise, by the prior.
        depths: the median depth that a sees, in units of its inference, and in m of the map.
    """
    if not np.isfinite(predicted).all():
        return factor
    error, (depth, depth_in_map) = np.linalg.inv(predicted) @ T_a_b, depths
    turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
    mean_square = np.mean(np.square([error[:3, 3] / depth_in_map, turn]))
    added, weights = mean_square * np.square([depth] * 3 + [1.0] * 3 + [0.0]), np.diag(factor.sqrt_info)
    return factor._replace(sqrt_info=np.diag(weights / np.sqrt(1.0 + weights**2 * added)))


def chi2(measured: Factor | LoopMeasurement, poses: Sequence[np.ndarray], log_scales: Sequence[float]) -> float:
    """Compute χ² of a measurement at the poses and scales of all nodes."""
    a, b = measured.a, measured.b
    error = np.linalg.inv(measured.Z_a_b) @ _relative_pose(poses, log_scales, a, b)
    turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
    residual = [*error[:3, 3], *turn, log_scales[b] - log_scales[a] - measured.log_ratio]
    return float(np.sum((measured.sqrt_info @ residual) ** 2))


def map_factor(
    frame: FrameData, poses: Sequence[np.ndarray], log_scales: Sequence[float], origin: int, noise: NoiseConfig
) -> Factor:
    """Build the map factor: the last frame's pose relative to frame `origin`, whose Gaussians it was registered to."""
    measured = _relative_pose(poses, log_scales, -1, origin)
    return Factor(len(poses) - 1, origin, measured, 0.0, _weights(frame, noise, noise.map), is_loop=False)


def shared_factor(a: Keyframe, b: Keyframe, depth_noise: float | None, noise: NoiseConfig) -> Factor | None:
    """Build the factor of an image that is a node of two maps: one pose, and units in the ratio of the depths.

    It holds both nodes together as firmly as consecutive frames of one map; None if no pixel has a depth in both.

    Args:
        depth_noise: ν of b, in its own map; None if it was not registered.
    """
    is_known = (a.depths > 0) & (b.depths > 0)
    if not is_known.any():
        return None
    ratio = float(np.median(np.log(a.depths[is_known] / b.depths[is_known])))
    nu = noise.depth if depth_noise is None else max(depth_noise, LEAST_NOISE)
    weights = _root(nu, float(np.median(a.depths[is_known])), noise.pair, noise.log_scale)
    return Factor(a.frame, b.frame, np.eye(4), ratio, weights, is_loop=False)


def measured_again(
    factor: Factor,
    poses: Sequence[np.ndarray],
    log_scales: Sequence[float],
    predicted: Sequence[np.ndarray | None],
) -> Factor:
    """Return a factor with what its measurement is now: a loop's stays, a window factor's is the prior's prediction.

    Any other has the relative pose of its nodes.

    Args:
        predicted: T_anchor_camera (4, 4) of all nodes, as the prior predicts them now; None without one.
    """
    a, b = predicted[factor.a], predicted[factor.b]
    if factor.is_loop or (factor.is_predicted and (a is None or b is None)):
        return factor
    if factor.is_predicted:
        return factor._replace(Z_a_b=np.linalg.inv(a) @ b)
    return factor._replace(Z_a_b=_relative_pose(poses, log_scales, factor.a, factor.b))


def _relative_pose(poses: Sequence[np.ndarray], log_scales: Sequence[float], a: int, b: int) -> np.ndarray:
    """Compute the pose of node b relative to node a, in the unit of a's inference."""
    return scale_pose(np.linalg.inv(poses[a]) @ poses[b], np.exp(-log_scales[a]))


def loop_factor(loop: LoopMeasurement) -> Factor:
    """Build the loop factor of a verified loop."""
    return Factor(loop.a, loop.b, loop.Z_a_b, loop.log_ratio, loop.sqrt_info, is_loop=True)


def stack_factors(factors: Sequence[Factor]) -> Factors:
    """Stack factors as float32 arrays, padded to a power of two so that a growing graph compiles rarely."""
    count = len(factors)
    size = bucket(count)
    a, b, Z, ratios, weights, is_loop, _ = zip(*factors, *[factors[0]] * (size - count), strict=True)
    return Factors(
        a=jnp.asarray(a, jnp.int32),
        b=jnp.asarray(b, jnp.int32),
        Z_a_b=to_se3(np.stack(Z)),
        log_ratio=jnp.asarray(ratios, jnp.float32),
        sqrt_info=jnp.asarray(np.stack(weights), jnp.float32),
        is_loop=jnp.asarray(is_loop, bool),
        valid=jnp.asarray(np.arange(size) < count),
    )
