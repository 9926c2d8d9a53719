"""Factors of the pose graph that a frame adds: its pose relative to an earlier frame, and to the map."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from emgs_jax.graph.measurements import LOOP, ODOMETRY, Edges
from emgs_jax.graph.problem import bucket
from emgs_jax.loops.two_views import rescaled
from emgs_jax.loops.verification import LoopMeasurement
from emgs_jax.ops.ranges import number
from emgs_jax.registration.pose_noise import LEAST_NOISE
from emgs_jax.running.convert import to_se3


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations of what is measured, as multiples of ν, by how much of their depth a frame's points err.

    Those of a pose that such points hold are so many ν as an angle, and so many ν z as a length, with z the median
    depth: no unit is in them, and a prior that errs twice as much is believed half as much.

    Args:
        pair: of the relative pose of two neighbours; those k apart: √k times.
        map: of a frame placed in the map, relative to the frame of whose Gaussians it was placed by.
        log_scale: of the ratio of two neighbours' scales, as `pair`.
        depth: ν of a frame that was not placed in the map, as the first is.
    """

    pair: float = number(low=1e-9, high=1000)
    map: float = number(low=1e-9, high=1000)
    log_scale: float = number(low=1e-9, high=1000)
    depth: float = number(low=1e-9, high=1000)


@dataclass(frozen=True)
class Look:
    """Frame as the back end needs it, beside its pose.

    Args:
        frame: index in the data set.
        image: RGB, uint8 (h, w, 3).
        points: camera frame, m of its inference, (h, w, 3).
        mask: of these, (h, w).
        T_anchor_views: by frame index, the poses (4, 4) that its inference predicts; some may not be finite.
        depth_noise: ν of the points, as they differ from the map; None where the frame was not tracked: the few points
            that are near the map by chance do not count.
    """

    frame: int
    image: np.ndarray
    points: np.ndarray
    mask: np.ndarray
    T_anchor_views: Mapping[int, np.ndarray]
    depth_noise: float | None = None

    @property
    def depth(self) -> float:
        """The points' median z, m of its inference; 1 where there are none."""
        return float(np.median(self.points[self.mask][:, 2])) if self.mask.any() else 1.0


class Edge(NamedTuple):
    """One row of `Edges`, on the host: Z (4, 4), sqrt_info (7, 7)."""

    a: int
    b: int
    Z_a_b: np.ndarray
    log_ratio: float
    sqrt_info: np.ndarray
    kind: int


def _weights(look: Look, noise: NoiseConfig, angle: float, log_scale: float = np.inf) -> np.ndarray:
    """(7, 7) square root of the information of independent errors, given in ν; an infinite one is not measured."""
    depth_noise = noise.depth if look.depth_noise is None else max(look.depth_noise, LEAST_NOISE)
    return np.diag(1.0 / (depth_noise * np.array([angle * look.depth] * 3 + [angle] * 3 + [log_scale])))


def chain_edge(
    look: Look,
    poses: Sequence[np.ndarray],
    log_scales: Sequence[float],
    has_place: Callable[[int], bool],
    noise: NoiseConfig,
) -> Edge | None:
    """Build the last frame's sequential factor to the nearest earlier frame in its window; None without one.

    The measurement is the estimated pose, not the predicted one. The map was made at these poses: a prediction that
    differs from them by its noise would move every frame by that, each with the Gaussians of its birth, and roughen all
    surfaces.

    Args:
        look: of the frame.
        poses: T_world_camera (4, 4) of all nodes, the last one its own; that of a frame k before it is k before.
        log_scales: σ of all nodes, likewise.
        has_place: whether a factor may join a node: not if its pose only stands in.
        noise: of the measurements.
    """
    time = len(poses) - 1
    known = {frame for frame, pose in look.T_anchor_views.items() if np.isfinite(pose).all()}
    nearest = sorted(look.frame - frame for frame in known)
    offset = next((offset for offset in nearest if 0 < offset <= time and has_place(time - offset)), None)
    if look.frame not in known or offset is None:
        return None
    row, spread = time - offset, np.sqrt(offset)
    weights = _weights(look, noise, spread * noise.pair, spread * noise.log_scale)
    return Edge(time, row, _as_placed(poses, log_scales, row), log_scales[row] - log_scales[time], weights, ODOMETRY)


def map_edge(
    look: Look, poses: Sequence[np.ndarray], log_scales: Sequence[float], origin: int, noise: NoiseConfig
) -> Edge:
    """Build the map factor: the last frame's pose relative to the frame `origin` whose Gaussians it was fitted to."""
    measured = _as_placed(poses, log_scales, origin)
    return Edge(len(poses) - 1, origin, measured, 0.0, _weights(look, noise, noise.map), ODOMETRY)


def _as_placed(poses: Sequence[np.ndarray], log_scales: Sequence[float], row: int) -> np.ndarray:
    """Node `row` relative to the last one, in the unit of the last one's inference."""
    return rescaled(np.linalg.inv(poses[-1]) @ poses[row], np.exp(-log_scales[-1]))


def loop_edge(loop: LoopMeasurement) -> Edge:
    """A loop's measurement."""
    return Edge(loop.a, loop.b, loop.Z_a_b, loop.log_ratio, loop.sqrt_info, LOOP)


def stacked(edges: Sequence[Edge]) -> Edges:
    """Rows of the graph, float32, with free ones up to a power of two: what is compiled is so rarely."""
    count = len(edges)
    room = bucket(count)
    a, b, Z, ratios, weights, kinds = zip(*edges, *[edges[0]] * (room - count), strict=True)
    return Edges(
        a=jnp.asarray(a, jnp.int32),
        b=jnp.asarray(b, jnp.int32),
        Z_a_b=to_se3(np.stack(Z)),
        log_ratio=jnp.asarray(ratios, jnp.float32),
        sqrt_info=jnp.asarray(np.stack(weights), jnp.float32),
        kind=jnp.asarray(kinds, jnp.int32),
        valid=jnp.asarray(np.arange(room) < count),
    )
