"""Masks of the usable pixels of a network's output: MapAnything's masks as pure functions on its own grid.

A pixel is left out where the network calls it ambiguous, where its confidence is among the lowest of its view, on
edges, and where other views of the window contradict its depth. Every part has a neutral value that turns it off.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.camera import NEAREST_DEPTH
from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import traced


class MaskConfig(eqx.Module):
    """Criteria by which a pixel is left out. Upstream's defaults are in conf/prior/mapanything.yaml.

    Args:
        drop_ambiguous: 1 leaves out what the network itself calls ambiguous (sky, mirrors), 0 keeps it.
        confidence_percentile: share of a view's pixels, in percent, with the lowest confidence; 0 = none.
        max_edge_step: depth range over 3 × 3 pixels, relative to the depth, above which there is a depth edge.
        max_edge_degrees: angle between neighbouring normals above which there is a normal edge. A pixel is left out
            where both edges are; inf in either keeps all.
        min_consistent_share: of the views that see the point, share that must have its depth; 0 = not tested.
        consistent_depth_m: two depths agree within this and
        consistent_depth_share: this fraction of the depth.
    """

    drop_ambiguous: Float[Array, "*b"] = traced(low=0, high=1)
    confidence_percentile: Float[Array, "*b"] = traced(low=0, high=100)
    max_edge_step: Float[Array, "*b"] = traced(low=0, high=math.inf)
    max_edge_degrees: Float[Array, "*b"] = traced(low=0, high=math.inf)
    min_consistent_share: Float[Array, "*b"] = traced(low=0, high=1)
    consistent_depth_m: Float[Array, "*b"] = traced(low=0, high=math.inf)
    consistent_depth_share: Float[Array, "*b"] = traced(low=0, high=math.inf)


def _around(image: Array, fill: float | bool | None) -> list[Array]:
    """The 3 × 3 neighbours of every pixel, row by row; `fill` beyond the border, the border's own value for None."""
    height, width = image.shape[:2]
    padding = [(1, 1), (1, 1)] + [(0, 0)] * (image.ndim - 2)
    padded = jnp.pad(image, padding, mode="edge") if fill is None else jnp.pad(image, padding, constant_values=fill)
    return [padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)]


def grid_normals(
    points: Float[Array, "h w 3"], valid: Bool[Array, "h w"]
) -> tuple[Float[Array, "h w 3"], Bool[Array, "h w"]]:
    """Mean of the unit normals of the four corners that a pixel makes with its direct neighbours.

    Returns:
        Unit normals in the frame of the points, towards the camera, zero without a corner; whether there is one.
    """
    points = jnp.where(valid[..., None], points, 0.0)
    _, up, _, left, _, right, _, down, _ = (other - points for other in _around(points, 0.0))
    _, has_up, _, has_left, _, has_right, _, has_down, _ = _around(valid, False)
    total, has_any = jnp.zeros_like(points), jnp.zeros_like(valid)
    for a, b, has_a, has_b in (
        (up, left, has_up, has_left),
        (left, down, has_left, has_down),
        (down, right, has_down, has_right),
        (right, up, has_right, has_up),
    ):
        has_corner = valid & has_a & has_b
        total += jnp.where(has_corner[..., None], safe_normalize(jnp.cross(a, b)), 0.0)
        has_any |= has_corner
    return jnp.where(has_any[..., None], safe_normalize(total), 0.0), has_any


def normal_edges(
    normals: Float[Array, "h w 3"], has_normal: Bool[Array, "h w"], max_degrees: Float[Array, ""]
) -> Bool[Array, "h w"]:
    """Mark pixels with a normal edge in their 3 × 3 surroundings: an angle above `max_degrees` to a neighbour's normal.

    A pixel without a normal differs from any neighbour that has one.
    """
    cosines = [jnp.sum(normals * other, axis=-1) for other in _around(normals, None)]
    smallest = jnp.ones_like(normals[..., 0])
    for cosine, is_there in zip(cosines, _around(has_normal, None), strict=True):
        smallest = jnp.minimum(smallest, jnp.where(is_there, cosine, 1.0))
    is_edge = smallest < jnp.cos(jnp.deg2rad(jnp.minimum(max_degrees, 180.0)))
    return jnp.any(jnp.stack(_around(is_edge, False)), axis=0)


def depth_edges(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], max_step: Float[Array, ""]
) -> Bool[Array, "h w"]:
    """Mark valid pixels whose valid 3 × 3 neighbours range in depth over more than `max_step` of the pixel's own."""
    highest = jnp.max(jnp.stack(_around(jnp.where(valid, depth, -jnp.inf), -jnp.inf)), axis=0)
    lowest = jnp.min(jnp.stack(_around(jnp.where(valid, depth, jnp.inf), jnp.inf)), axis=0)
    return valid & ((highest - lowest) / jnp.where(valid, depth, 1.0) > max_step)


def above_percentile(confidence: Float[Array, "h w"], percentile: Float[Array, ""]) -> Bool[Array, "h w"]:
    """Mark pixels with a confidence above a percentile of their view, or the highest: a constant one is never low.

    All pixels for percentile 0.
    """
    is_above = confidence > jnp.quantile(confidence, percentile / 100.0)
    return is_above | (confidence >= jnp.max(confidence)) | (percentile <= 0)


@full_precision
def usable(
    points: Float[Array, "h w 3"],
    confidence: Float[Array, "h w"],
    is_clear: Bool[Array, "h w"],
    config: MaskConfig,
) -> Bool[Array, "h w"]:
    """The mask of one view by itself.

    Args:
        points: camera frame, metres.
        confidence: higher is better.
        is_clear: what the network does not call ambiguous.
    """
    valid = jnp.all(jnp.isfinite(points), axis=-1) & (points[..., 2] > 0) & jnp.isfinite(confidence)
    confidence = jnp.where(jnp.isfinite(confidence), confidence, 0.0)
    valid &= is_clear | (config.drop_ambiguous <= 0)
    valid &= above_percentile(confidence, config.confidence_percentile)
    points = jnp.where(valid[..., None], points, 0.0)
    is_edge = normal_edges(*grid_normals(points, valid), config.max_edge_degrees)
    return valid & ~(is_edge & depth_edges(points[..., 2], valid, config.max_edge_step))


def consistent_share(
    row: Int[Array, ""],
    depths: Float[Array, "v h w"],
    intrinsics: Float[Array, "v 3 3"],
    T_anchor_view: Float[Array, "v 4 4"],
    config: MaskConfig,
) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """Compute the share of the other views seeing a point of view `row` that have its depth at the nearest pixel.

    Args:
        row: the view whose points are tested.
        depths: camera-space z in metres of all views; 0 where there is none.
        intrinsics: of all views, pixel centres at integers.
        T_anchor_view: camera -> any common frame.

    Returns:
        The share, 0 where no view sees the point; and how many views see it and have a depth there.
    """
    _, height, width = depths.shape
    y, x = jnp.meshgrid(jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32), indexing="ij")
    pixels = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    points = depths[row][..., None] * (pixels @ jnp.linalg.inv(intrinsics[row]).T)
    T_view_row = jnp.linalg.inv(T_anchor_view) @ T_anchor_view[row]
    moved = jnp.einsum("vij,hwj->vhwi", T_view_row[:, :3, :3], points) + T_view_row[:, None, None, :3, 3]
    expected = moved[..., 2]
    is_before = expected > NEAREST_DEPTH
    projected = jnp.einsum("vij,vhwj->vhwi", intrinsics, moved / jnp.where(is_before, expected, 1.0)[..., None])
    u, v = projected[..., 0], projected[..., 1]
    sees = is_before & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1) & (depths[row] > 0)
    sees &= (jnp.arange(len(depths)) != row)[:, None, None]
    column, line = (jnp.round(jnp.where(sees, c, 0.0)).astype(jnp.int32) for c in (u, v))
    found = depths[jnp.arange(len(depths))[:, None, None], line, column]
    sees &= found > 0
    tolerance = config.consistent_depth_m + config.consistent_depth_share * expected
    agrees = sees & (jnp.abs(expected - found) < tolerance)
    num_seen = jnp.sum(sees, axis=0)
    return jnp.sum(agrees, axis=0) / jnp.maximum(num_seen, 1).astype(jnp.float32), num_seen


@full_precision
def consistent(
    row: Int[Array, ""],
    depths: Float[Array, "v h w"],
    intrinsics: Float[Array, "v 3 3"],
    T_anchor_view: Float[Array, "v 4 4"],
    config: MaskConfig,
) -> Bool[Array, "h w"]:
    """Mark the pixels of view `row` that enough views agree with; one that no other view sees is not contradicted."""
    share, num_seen = consistent_share(row, depths, intrinsics, T_anchor_view, config)
    return (num_seen == 0) | (share >= config.min_consistent_share)
