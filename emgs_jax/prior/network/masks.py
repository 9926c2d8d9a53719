"""Masks of the usable pixels of a network's output: MapAnything's criteria, on the network's grid.

A pixel is left out where the network calls it ambiguous, where its confidence is among the lowest of its view, and on
edges. Every part has a neutral value that turns it off.
Upstream's own functions miss edges where rounding makes a cosine larger than 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.ops.ranges import number

SQUARE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class MaskConfig:
    """Criteria by which a pixel is left out. Upstream's defaults are in conf/prior/mapanything.yaml."""

    # 1 leaves out what the network itself calls ambiguous (sky, mirrors), 0 keeps it
    drop_ambiguous: float = number(1.0, low=0, high=1)
    # share of a view's pixels, in percent, with the lowest confidence; 0 = none
    confidence_percentile: float = number(0.0, low=0, high=100)
    # depth range over 3 × 3 pixels, relative to the depth, above which there is a depth edge
    max_edge_step: float = number(0.03, low=0, high=math.inf)
    # angle between neighbouring normals above which there is a normal edge. A pixel is left out where both edges are;
    # inf in either keeps all
    max_edge_degrees: float = number(5.0, low=0, high=math.inf)


def usable(
    points: Float[np.ndarray, "h w 3"],
    confidence: Float[np.ndarray, "h w"],
    is_clear: Bool[np.ndarray, "h w"],
    config: MaskConfig,
) -> Bool[np.ndarray, "h w"]:
    """The mask of one view by itself.

    Args:
        points: camera frame, metres.
        confidence: higher is better; one that is the same everywhere is never low.
        is_clear: what the network does not call ambiguous.
    """
    is_known = np.isfinite(confidence)
    valid = np.isfinite(points).all(axis=-1) & (points[..., 2] > 0) & is_known
    valid &= is_clear | (config.drop_ambiguous <= 0)
    if config.confidence_percentile > 0:
        confidence = np.where(is_known, confidence, 0)
        least = np.percentile(confidence, config.confidence_percentile)
        valid &= (confidence > least) | (confidence == confidence.max())
    points = np.where(valid[..., None], points, 0)
    is_edge = normal_edges(points, valid, config.max_edge_degrees)
    return valid & ~(is_edge & depth_edges(points[..., 2], valid, config.max_edge_step))


def _shifted(image: np.ndarray, shifts: Sequence[tuple[int, int]], mode: str) -> list[np.ndarray]:
    """What lies so many rows and columns beside every pixel."""
    height, width = image.shape[:2]
    padded = np.pad(image, [(1, 1), (1, 1)] + [(0, 0)] * (image.ndim - 2), mode=mode)
    return [padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dy, dx in shifts]


def grid_normals(
    points: Float[np.ndarray, "h w 3"], valid: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Mean of the unit normals of the four corners that a pixel makes with its direct neighbours.

    Returns:
        Unit normals in the frame of the points, towards the camera, zero without a corner; whether there is one.
    """
    beside = (-1, 0), (0, -1), (1, 0), (0, 1), (-1, 0)
    sides = [other - points for other in _shifted(points, beside, "constant")]
    is_there = _shifted(valid, beside, "constant")
    total, has_any = np.zeros_like(points), np.zeros_like(valid)
    for a, b, has_a, has_b in zip(sides, sides[1:], is_there, is_there[1:], strict=False):
        has_corner = valid & has_a & has_b
        total += np.where(has_corner[..., None], _unit(np.cross(a, b)), 0)
        has_any |= has_corner
    return _unit(total), has_any


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


def normal_edges(
    points: Float[np.ndarray, "h w 3"], valid: Bool[np.ndarray, "h w"], max_degrees: float
) -> Bool[np.ndarray, "h w"]:
    """Mark pixels with a normal edge in their 3 × 3 surroundings: an angle above `max_degrees` to a neighbour's normal.

    A pixel without a normal differs from any neighbour that has one.
    """
    normals, has_normal = grid_normals(points, valid)
    around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    smallest = np.ones(valid.shape)
    for other, is_there in zip(*(_shifted(of, around, "edge") for of in (normals, has_normal)), strict=True):
        smallest = np.where(is_there, np.minimum(smallest, np.sum(normals * other, axis=-1)), smallest)
    is_edge = smallest < math.cos(math.radians(min(max_degrees, 180)))
    return cv2.dilate(is_edge.astype(np.uint8), SQUARE) > 0


def depth_edges(
    depth: Float[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"], max_step: float
) -> Bool[np.ndarray, "h w"]:
    """Mark valid pixels whose valid 3 × 3 neighbours range in depth over more than `max_step` of the pixel's own."""
    highest, lowest = (sign * cv2.dilate(np.where(valid, sign * depth, -np.inf), SQUARE) for sign in (1, -1))
    return valid & (np.subtract(highest, lowest, out=np.zeros_like(highest), where=valid) > max_step * depth)
