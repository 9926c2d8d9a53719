"""The floor plan of the apartment: rectangles with doorways in their walls. Metres; x goes along the hall, z is up.

    living │ dining │ twin │ twin │ ║ gallery, along y
    ───d───┴───d────┴──d───┴──d───┘ ║
    hall                            ║
    ───d────┬───d─────┬─────────────┘
     study  │ bedroom │

Doorways join living and dining room, and study and bedroom, so that one can walk round. The hall passes two equal rooms
`APART` metres from each other, with equal pieces of hall before them, and ends in the gallery of equal bays.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from emgs_jax.data.furniture import Part, box, join, moved

WALL = 0.06  # thickness; adjacent rooms have a wall each, so that every side has its own look
HEIGHT = 2.6
DOOR_WIDTH, DOOR_HEIGHT = 1.3, 2.1
HALF_HALL = 0.9
APART = 6.0  # from one twin room to the other
BAY, NUM_BAYS = 3.0, 7  # of the gallery

EAST, NORTH, WEST, SOUTH = range(4)  # walls +x, +y, -x, -y, as `furniture.against` counts them
Point = tuple[float, float]


@dataclass(frozen=True)
class Area:
    """A rectangle of floor from `low` to `high`."""

    low: Point
    high: Point
    walls: tuple[int, ...] = (EAST, NORTH, WEST, SOUTH)  # the other sides are open
    doors: tuple[tuple[int, float], ...] = ()  # (wall, x or y of the middle) of the doorways


@dataclass(frozen=True)
class Plan:
    """The areas and the points that walks go through."""

    living: Area  # this and the next three are the rooms at the hall's west end
    dining: Area
    study: Area
    bedroom: Area
    twin: Area  # the western of the two equal rooms
    twin_bay: Area  # the piece of hall before it
    hall: Area  # the rest of the hall
    corner: Area  # joins the hall to the gallery
    bay: Area  # the first of the gallery
    end: Area  # closes the gallery
    north_door: Point  # middle of the doorway living–dining
    south_door: Point  # of study–bedroom
    west: float  # x of the doorways from the hall to living and study
    east: float  # to dining and bedroom

    @property
    def twin_door(self) -> float:
        """x of the doorway from the hall to the western twin room."""
        return APART / 2


def draw_plan(rng: np.random.Generator) -> Plan:
    near = HALF_HALL + 2 * WALL  # |y| at which rooms begin
    (living_w, dining_w, study_w, bedroom_w, twin_w), (living_d, dining_d, study_d, bedroom_d, twin_d) = rng.uniform(
        ((5.6, 5.2, 4.4, 5.3, 5.0), (4.4, 4.8, 3.6, 4.0, 4.5)), ((6.0, 5.6, 4.9, 5.7, 5.4), (4.7, 5.1, 3.9, 4.3, 4.8))
    )
    edge = -0.1  # where dining room and bedroom end in the east
    x_north, x_south = edge - dining_w - WALL, edge - bedroom_w - WALL  # between the rooms of either side
    y_north, y_south = near + rng.uniform(2.0, 2.2), -near - rng.uniform(1.8, 2.0)
    west, east = x_north - rng.uniform(1.6, 1.9), x_north + rng.uniform(1.6, 1.9)
    x_west, half, mid = x_north - WALL - living_w, HALF_HALL, APART / 2
    to_gallery, last = 2 * APART, half + WALL + BAY * NUM_BAYS
    hall_doors = ((NORTH, west), (NORTH, east), (SOUTH, west), (SOUTH, east))
    return Plan(
        living=Area((x_west, near), (x_north - WALL, near + living_d), doors=((EAST, y_north), (SOUTH, west))),
        dining=Area((x_north + WALL, near), (edge, near + dining_d), doors=((WEST, y_north), (SOUTH, east))),
        study=Area(
            (x_south - WALL - study_w, -near - study_d), (x_south - WALL, -near), doors=((EAST, y_south), (NORTH, west))
        ),
        bedroom=Area((x_south + WALL, -near - bedroom_d), (edge, -near), doors=((WEST, y_south), (NORTH, east))),
        twin=Area((mid - twin_w / 2, near), (mid + twin_w / 2, near + twin_d), doors=((SOUTH, mid),)),
        twin_bay=Area((0.0, -half), (APART, half), (NORTH, SOUTH), ((NORTH, mid),)),
        hall=Area((x_west, -half), (0.0, half), (NORTH, WEST, SOUTH), hall_doors),
        corner=Area((to_gallery, -half), (to_gallery + 2 * half, half + WALL), (EAST, SOUTH)),
        bay=Area((to_gallery, half + WALL), (to_gallery + 2 * half, half + WALL + BAY), (EAST, WEST)),
        end=Area((to_gallery, last), (to_gallery + 2 * half, last + 1.0), (EAST, NORTH, WEST)),
        north_door=(x_north, y_north),
        south_door=(x_south, y_south),
        west=west,
        east=east,
    )


def shell(area: Area) -> list[Part]:
    """Floor, ceiling and two-sided walls with doorways around an area."""
    low = [end - WALL * (wall in area.walls) for end, wall in zip(area.low, (WEST, SOUTH), strict=True)]
    high = [end + WALL * (wall in area.walls) for end, wall in zip(area.high, (EAST, NORTH), strict=True)]
    parts = join("floor", _slab((*low, -WALL), (*high, 0.0)))
    parts += join("ceiling", _slab((*low, HEIGHT), (*high, HEIGHT + WALL)))
    for wall in area.walls:
        along = 1 - wall % 2  # the axis that the wall goes along
        near = (area.low if wall in (WEST, SOUTH) else area.high)[wall % 2]
        across = sorted((near, near + WALL * (-1 if wall in (WEST, SOUTH) else 1)))
        pieces = _pieces((low[along], high[along]), sorted(middle for side, middle in area.doors if side == wall))
        parts += join("wall", *(_slab(*_corners(piece, across, along)) for piece in pieces))
    return parts


def lining(wall: int, at: Point) -> list[Part]:
    """Frame of the doorway with middle `at` between two walls; it projects 2 cm on both sides."""
    depth = 2 * WALL + 0.04
    jambs = [box((0.09, depth, DOOR_HEIGHT + 0.06), (s * (DOOR_WIDTH / 2 + 0.015), 0, 0)) for s in (-1, 1)]
    head = box((DOOR_WIDTH - 0.06, depth, 0.09), (0, 0, DOOR_HEIGHT - 0.03))
    return moved(join("door", head, *jambs), np.array([*at, 0.0]), (wall + 1) * np.pi / 2)


def _pieces(span: Point, doors: list[float]) -> list[tuple[Point, Point]]:
    """(along, height) intervals of a wall: full height beside the doorways, the rest above them."""
    edges = [span[0], *(edge for door in doors for edge in (door - DOOR_WIDTH / 2, door + DOOR_WIDTH / 2)), span[1]]
    heights = [(0.0, HEIGHT), (DOOR_HEIGHT, HEIGHT)]
    return [(piece, heights[i % 2]) for i, piece in enumerate(zip(edges[:-1], edges[1:], strict=True))]


def _corners(piece: tuple[Point, Point], across: list[float], axis: int) -> tuple[Sequence[float], Sequence[float]]:
    """Lowest and highest corner of an (along, height) piece of a wall along an axis."""
    (begin, end), (bottom, top) = piece
    near, far = across
    if axis == 0:
        return (begin, near, bottom), (end, far, top)
    return (near, begin, bottom), (far, end, top)


def _slab(low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
    """Box from its lowest to its highest corner."""
    (x, y, z), (u, v, w) = low, high
    return box((u - x, v - y, w - z), ((x + u) / 2, (y + v) / 2, z))
