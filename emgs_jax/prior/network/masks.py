"""Mask the usable pixels of a network's output by MapAnything's criteria, on the network's grid.

A pixel is left out if the network calls it ambiguous, if its confidence is among its view's lowest, and on edges.
Upstream's functions miss edges where rounding makes a cosine larger than 1.
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
    """Which pixels are left out. Depth edges are left out if they are normal edges too; inf in either keeps all."""

    drop_ambiguous: float = number(1.0, low=0, high=1)  # 1: leave out what the network calls ambiguous (sky, mirrors)
    confidence_percentile: float = number(0.0, low=0, high=100)  # of a view's pixels, those of the lowest confidence
    max_edge_step: float = number(0.03, low=0, high=math.inf)  # range of depth over 3 × 3 pixels, relative
    max_edge_degrees: float = number(5.0, low=0, high=math.inf)  # between neighbouring normals


def usable(
    points: Float[np.ndarray, "h w 3"],
    confidence: Float[np.ndarray, "h w"],
    is_clear: Bool[np.ndarray, "h w"],
    config: MaskConfig,
) -> Bool[np.ndarray, "h w"]:
    """The usable pixels of one view, from points of its camera and the network's confidence and `is_clear`."""
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
    """The image shifted by these rows and columns, which are at most 1."""
    height, width = image.shape[:2]
    padded = np.pad(image, [(1, 1), (1, 1)] + [(0, 0)] * (image.ndim - 2), mode=mode)
    return [padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dy, dx in shifts]


def grid_normals(
    points: Float[np.ndarray, "h w 3"], valid: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Mean of the unit normals of a pixel's four corners with its direct neighbours, and whether there is any corner.

    Unit normals in the points' frame, towards the camera; zero without a corner.
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
    """Mark pixels with an angle above `max_degrees` between neighbours' normals, or a missing one, within 3 × 3."""
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
    """Mark valid pixels whose valid 3 × 3 neighbours have a range of depth above `max_step` times the pixel's."""
    highest, lowest = (sign * cv2.dilate(np.where(valid, sign * depth, -np.inf), SQUARE) for sign in (1, -1))
    return valid & (np.subtract(highest, lowest, out=np.zeros_like(highest), where=valid) > max_step * depth)
