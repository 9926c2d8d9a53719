"""A ray-cast, furnished apartment: long walks, loops, and places that look like loops."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.data import furniture
from emgs_jax.data.furnishing import at_wall, furnish
from emgs_jax.data.furniture import Part, moved
from emgs_jax.data.looks import copied, draw_looks
from emgs_jax.data.movers import Doorway, Lane
from emgs_jax.data.plan import (
    APART,
    BAY,
    DOOR_WIDTH,
    EAST,
    HALF_HALL,
    HEIGHT,
    NORTH,
    NUM_BAYS,
    WALL,
    WEST,
    Plan,
    Point,
    draw_plan,
    lining,
    shell,
)
from emgs_jax.data.raycast import RayCast, Scene
from emgs_jax.data.walks import RADIUS, WALKS, carry, rounded, table_of

AHEAD = 2.4  # m from the camera to the middle of a person's way
AHEAD_OF_DOOR = 4.0  # m from a door to the camera when it opens
CHAIR_AT = 0.3  # of the path: where a second lap, or the way back, comes by again

Copies = list[Float[np.ndarray, " 3"]]  # offsets of the copies of a group of objects


@dataclass(eq=False)
class Apartment(RayCast):
    """Six furnished rooms, a hall and a gallery, walked through at eye level; a seed fixes all but the walk.

    Without `num_frames` there are 280 to 560 frames, 7 cm apart, less around corners.
    """

    # two_laps through four rooms; figure_of_eight through a doorway; out_and_back, which sees all from the other side;
    # twin_rooms, two that look alike; corridor, which repeats every 3 m
    walk: str = "two_laps"

    name, version = "apartment", 1
    classes = (*furniture.CLASSES, "door", "bed", "plant")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.walk not in WALKS:
            raise ValueError(f"dataset.walk must be one of {', '.join(WALKS)}, got {self.walk!r}")
        of_plan, of_scene, of_walk = np.random.default_rng(self.seed).spawn(3)
        self.plan = draw_plan(of_plan)
        poses = carry(WALKS[self.walk](self.plan), self.num_frames, of_walk)
        things = self._things(lane_ahead(self.plan, poses[:, :2, 3]))
        self._show(f"apartment{self.seed}_{self.walk}", build_apartment(self.plan, of_scene), poses, things)


def lane_ahead(plan: Plan, camera: Float[np.ndarray, "n 2"]) -> Lane:
    """The camera's path; a door leaf hangs in the doorway nearest to its middle, or beside the path."""
    walked = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(camera, axis=0), axis=1)))
    gaps = np.linalg.norm(camera[:, None] - [at for _, at in doorways(plan)], axis=-1)
    row = int(np.argmin(gaps.min(axis=1) + 0.02 * np.abs(walked - walked[-1] / 2)))
    wall, at = doorways(plan)[int(np.argmin(gaps[row]))]
    if gaps[row].min() > DOOR_WIDTH / 2:
        at, wall = camera[row] + np.array([DOOR_WIDTH / 2, 0.0]), EAST
    across = (wall + 1) * np.pi / 2
    hinge = np.array(at) - (DOOR_WIDTH / 2 - 0.06) * np.array([np.cos(across), np.sin(across)])
    doorway = Doorway((hinge[0], hinge[1]), across, DOOR_WIDTH - 0.14)
    opens = int(np.searchsorted(walked, walked[row] - AHEAD_OF_DOOR))
    return Lane(camera, walked, AHEAD, CHAIR_AT * walked[-1], doorway, opens)


def doorways(plan: Plan) -> list[tuple[int, Point]]:
    middle = HALF_HALL + WALL
    found = [(EAST, plan.north_door), (EAST, plan.south_door)]
    found += [(NORTH, (x, y)) for x in (plan.west, plan.east) for y in (middle, -middle)]
    return [*found, (NORTH, (plan.twin_door, middle)), (NORTH, (plan.twin_door + APART, middle))]


def build_apartment(plan: Plan, rng: np.random.Generator) -> Scene:
    """All objects and their looks; copies look alike."""
    lanes = np.concatenate([rounded(walk(plan), RADIUS) for walk in WALKS.values()])
    groups: list[tuple[list[Part], Copies]] = [
        (_rooms(plan, lanes, rng), [np.zeros(3)]),
        (_twin(plan, lanes, rng), [np.array([shift, 0.0, 0.0]) for shift in (0.0, APART)]),
        (_bay(plan, rng), [np.array([0.0, shift, 0.0]) for shift in BAY * np.arange(NUM_BAYS)]),
    ]
    parts, rows, shifts, first = [], [], [], 0
    for group, copies in groups:
        for shift in copies:
            parts += moved(group, shift)
            rows += range(first, first + len(group))
            shifts += [shift] * len(group)
        first += len(group)
    looks = draw_looks([part for group, _ in groups for part in group], rng)
    return Scene(parts, copied(looks, np.array(rows), np.array(shifts)))


def _rooms(plan: Plan, lanes: Float[np.ndarray, "p 2"], rng: np.random.Generator) -> list[Part]:
    """The parts that exist once."""
    f, pictures = furniture, [furniture.picture] * 4
    dining = moved(f.table_with_chairs(rng), np.array([*table_of(plan.dining, 1), 0.0]))
    living = moved(f.low_table(rng), np.array([*table_of(plan.living, -1), 0.0]), np.pi / 2)
    inside = {
        plan.living: ([f.sofa, f.shelf, f.cabinet, f.plant, f.lamp, *pictures], living),
        plan.dining: ([f.cabinet, f.shelf, f.sofa, f.plant, f.ball, *pictures], dining),
        plan.study: ([f.desk, f.shelf, f.shelf, f.boxes, f.lamp, f.ball, *pictures], []),
        plan.bedroom: ([f.bed, f.cabinet, f.desk, f.lamp, f.plant, f.boxes, *pictures], []),
        plan.hall: ([f.shelf, f.shelf, *pictures], []),
        plan.corner: ([f.picture, f.picture], []),
        plan.end: ([f.plant, f.picture], []),
    }
    parts = [part for area in inside for part in shell(area)]
    for area, (pieces, middle) in inside.items():
        parts += furnish(area, pieces, middle, lanes, rng)
    return parts + [part for wall, at in doorways(plan)[:-2] for part in lining(wall, at)]  # twins have their own


def _twin(plan: Plan, lanes: Float[np.ndarray, "p 2"], rng: np.random.Generator) -> list[Part]:
    """The western twin room and the hall before it."""
    f, pictures = furniture, [furniture.picture] * 4
    middle = moved(f.table_with_chairs(rng), np.array([*table_of(plan.twin, 0), 0.0]))
    parts = shell(plan.twin) + shell(plan.twin_bay) + lining(NORTH, (plan.twin_door, HALF_HALL + WALL))
    parts += furnish(plan.twin, [f.sofa, f.desk, f.shelf, f.cabinet, f.lamp, f.plant, *pictures], middle, lanes, rng)
    return parts + furnish(plan.twin_bay, [_closed_door, *pictures, *pictures], [], lanes, rng)


def _bay(plan: Plan, rng: np.random.Generator) -> list[Part]:
    """The first bay of the gallery: a closed door, a picture opposite and a lamp above."""
    x, y = (plan.bay.low[0] + plan.bay.high[0]) / 2, (plan.bay.low[1] + plan.bay.high[1]) / 2
    walls = rng.permutation([EAST, WEST]).tolist()
    parts = shell(plan.bay) + at_wall(_closed_door(rng), plan.bay, walls[0], 0.5)
    parts += at_wall(furniture.picture(rng), plan.bay, walls[1], 0.5)
    return parts + furniture.ceiling_lamp((x, y), HEIGHT)


def _closed_door(rng: np.random.Generator) -> list[Part]:
    return furniture.closed_door(rng.uniform(0.85, 0.95), rng.uniform(2.0, 2.1))
