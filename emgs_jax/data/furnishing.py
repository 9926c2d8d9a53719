"""Place furniture at random along walls, clear of doorways, other pieces and the camera's routes."""

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.data.furniture import Part, moved
from emgs_jax.data.plan import DOOR_HEIGHT, DOOR_WIDTH, EAST, NORTH, Area

TRIES = 60  # random places for a piece before the room goes without it
GAP = 0.08  # metres between pieces
DOORSTEP = 0.7  # metres before a doorway that stay free
LANE = 0.45  # metres on either side of a route that stay free

Piece = Callable[[np.random.Generator], list[Part]]  # with its back to y = 0, or with the origin inside
Bounds = Float[np.ndarray, "2 3"]  # lowest and highest corner in the world


def furnish(
    area: Area, pieces: Iterable[Piece], middle: list[Part], lanes: Float[np.ndarray, "p 2"], rng: np.random.Generator
) -> list[Part]:
    """Place pieces along the walls in this order, clear of the middle and of routes (x, y); return all parts.

    A piece without a free place after TRIES draws is left out.
    """
    low, high = np.array(area.low) - 1e-6, np.array(area.high) + 1e-6
    parts, taken = [*middle], [*([bounds(middle)] if middle else []), *_doorsteps(area)]
    for build in pieces:
        piece = _with_back(build(rng))
        for _ in range(TRIES):
            placed = at_wall(piece, area, int(rng.choice(area.walls)), rng.uniform())
            box = bounds(placed)
            is_inside = (box[0, :2] > low).all() and (box[1, :2] < high).all()
            if is_inside and not _meets(box, taken, GAP).any() and _distance(lanes, box) > LANE:
                parts, taken = parts + placed, [*taken, box]
                break
    return parts


def at_wall(parts: list[Part], area: Area, wall: int, share: float) -> list[Part]:
    """Move furniture with its back at y = 0 to a wall, at a share of the wall's length."""
    low, high = np.array(area.low), np.array(area.high)
    place = low + share * (high - low)
    place[wall % 2] = (high if wall in (EAST, NORTH) else low)[wall % 2]
    return moved(parts, np.array([*place, 0.0]), (wall + 1) * np.pi / 2)


def bounds(parts: list[Part]) -> Bounds:
    each = np.array([mesh.bounds for _, mesh in parts])
    return np.stack([each[:, 0].min(axis=0), each[:, 1].max(axis=0)])


def _with_back(parts: list[Part]) -> list[Part]:
    """Move parts built around the origin until they begin at y = 0.05 m; parts that lie at y ≥ 0 stay."""
    back = bounds(parts)[0, 1]
    return parts if back > -1e-6 else moved(parts, np.array([0.0, 0.05 - back, 0.0]))


def _doorsteps(area: Area) -> list[Bounds]:
    boxes = []
    for wall, middle in area.doors:
        across = (area.high if wall in (EAST, NORTH) else area.low)[wall % 2]
        center, half = np.full(2, middle), np.full(2, DOOR_WIDTH / 2)
        center[wall % 2], half[wall % 2] = across, DOORSTEP
        boxes.append(np.array([[*(center - half), 0.0], [*(center + half), DOOR_HEIGHT]]))
    return boxes


def _meets(box: Bounds, others: list[Bounds], gap: float) -> Bool[np.ndarray, " n"]:
    """Test which other boxes are nearer than `gap` along every axis: a picture may hang above a sofa."""
    low, high = np.array([other[0] for other in others]), np.array([other[1] for other in others])
    return ((box[0] - gap < high) & (low < box[1] + gap)).all(axis=-1) if others else np.zeros(0, bool)


def _distance(points: Float[np.ndarray, "p 2"], box: Bounds) -> float:
    """Horizontal distance of the nearest point from the box; 0 inside."""
    outside = np.maximum(np.maximum(box[0, :2] - points, points - box[1, :2]), 0.0)
    return float(np.linalg.norm(outside, axis=-1).min())
