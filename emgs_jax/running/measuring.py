"""What a frame measures, as edges of the graph: its window's poses, and the Gaussians that it was placed by."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from emgs_jax.graph.measurements import LOOP, WINDOW, Edges
from emgs_jax.graph.problem import bucket
from emgs_jax.loops.verification import LoopMeasurement
from emgs_jax.ops.ranges import number
from emgs_jax.running.convert import to_se3


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations of what is measured, m, degrees and log-scale.

    Args:
        pair, pair_deg: of the relative pose of two neighbours in a window; those k apart: √k times.
        anchor, anchor_deg: of the pose relative to the anchor, times 1 + the distance to it in metres. Its errors last
            for many windows, so one window counts as less than its own error would say.
        map, map_deg: of a frame placed in the map, relative to the frame of whose Gaussians it was placed by.
        log_scale: of the ratio of two neighbours' scales.
    """

    pair: float = number(low=1e-9, high=1000)
    pair_deg: float = number(low=1e-9, high=1000)
    anchor: float = number(low=1e-9, high=1000)
    anchor_deg: float = number(low=1e-9, high=1000)
    map: float = number(low=1e-9, high=1000)
    map_deg: float = number(low=1e-9, high=1000)
    log_scale: float = number(low=1e-9, high=1000)


@dataclass(frozen=True)
class Look:
    """What the back end takes of a frame, beside its pose.

    Args:
        frame: index in the data set.
        image: RGB, uint8 (h, w, 3).
        points: camera frame, m of its inference, (h, w, 3).
        mask: of these, (h, w).
        T_anchor_views: by frame index, the poses (4, 4) that its inference says; some may not be finite.
    """

    frame: int
    image: np.ndarray
    points: np.ndarray
    mask: np.ndarray
    T_anchor_views: Mapping[int, np.ndarray]


class Edge(NamedTuple):
    """One row of `Edges`, on the host: Z (4, 4), sqrt_info (7, 7)."""

    a: int
    b: int
    Z_a_b: np.ndarray
    log_ratio: float
    sqrt_info: np.ndarray
    kind: int


def _weights(distance: float, turn_deg: float, log_scale: float = np.inf) -> np.ndarray:
    """(7, 7) square root of the information of independent errors; an infinite one is not measured."""
    return np.diag(1.0 / np.array([distance] * 3 + [np.radians(turn_deg)] * 3 + [log_scale]))


def window_edges(
    look: Look,
    time: int,
    log_scales: Sequence[float],
    since: int,
    has_anchor: bool,
    offsets: Sequence[int],
    noise: NoiseConfig,
) -> list[Edge]:
    """What an inference says of its current frame and earlier ones of its window, and of the anchor.

    Args:
        look: of the frame.
        time: its node; that of a frame k before it is k less.
        log_scales: of all nodes, this one's included.
        since: the first node that it may be measured to: before it the camera was lost.
        has_anchor: that node is the anchor.
        offsets: of the earlier frames.
        noise: of the measurements.
    """
    poses = look.T_anchor_views
    here = poses.get(look.frame)
    if here is None or not np.isfinite(here).all():
        return []
    edges = []
    for offset in offsets:
        there, row = poses.get(look.frame - offset), time - offset
        if there is None or row < since or not np.isfinite(there).all():
            continue
        spread, is_next = np.sqrt(offset), offset == 1
        weights = _weights(spread * noise.pair, spread * noise.pair_deg, noise.log_scale if is_next else np.inf)
        ratio = log_scales[row] - log_scales[time]
        edges.append(Edge(time, row, np.linalg.inv(here) @ there, ratio, weights, WINDOW))
    anchor = poses.get(0)
    if has_anchor and anchor is not None and np.isfinite(anchor).all() and look.frame > max(offsets):
        measured = np.linalg.inv(here) @ anchor
        reach = 1.0 + np.linalg.norm(measured[:3, 3])
        edges.append(Edge(time, since, measured, 0.0, _weights(reach * noise.anchor, reach * noise.anchor_deg), WINDOW))
    return edges


def map_edge(time: int, origin: int, T_time_origin: np.ndarray, noise: NoiseConfig) -> Edge:
    """Where a frame was placed, relative to the frame `origin` of whose Gaussians it was placed by."""
    return Edge(time, origin, T_time_origin, 0.0, _weights(noise.map, noise.map_deg), WINDOW)


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
