"""Walks through the apartment: a camera is carried along a route with rounded corners and looks ahead."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from emgs_jax.data.plan import APART, BAY, HALF_HALL, NUM_BAYS, Area, Plan, Point
from emgs_jax.data.raycast import level_poses

SPACING = 0.07  # metres from frame to frame on a straight line
TURN = 0.9  # metres that take as many frames as a turn by one radian: one walks slower round a corner
RADIUS = 0.9  # of the corners, metres
AROUND = 1.3  # from the middle of a table to the route around it, along x and y
LOOK_AHEAD = 0.5  # metres; one looks into a corner before walking round it
STEP = 0.01  # metres between the points of a route before it is smoothed
EYE_HEIGHT = 1.5
SWAY = (  # of a hand-held camera: amplitude, and wave lengths in metres walked; the short ones are steps
    ("sideways", 0.012, (1.5, 4.1)),
    ("height", 0.012, (0.75, 5.3)),
    ("yaw", np.radians(1.2), (1.5, 3.7)),
    ("pitch", np.radians(1.0), (0.75, 6.1)),
)
PITCH = np.radians(-9.0)

Corners = list[Point]


def table_of(area: Area, side: int) -> Point:
    """Middle of the table that a walk goes around: 2.1 m from the wall at the `side` (-1 west, 1 east), or central."""
    (x0, y0), (x1, _) = area.low, area.high
    x = {-1: x0 + 2.1, 0: (x0 + x1) / 2, 1: x1 - 2.1}[side]
    return x, y0 + 2.15


def two_laps(plan: Plan) -> Corners:
    """Twice through living room, dining room, bedroom and study, from the hall and back to it."""
    (_, north), (_, south) = plan.north_door, plan.south_door
    lap = [(plan.west, north), (plan.east, north), (plan.east, south), (plan.west, south)]
    return [(plan.west, 0.0), *lap, *lap, (plan.west, 0.5)]


def figure_of_eight(plan: Plan) -> Corners:
    """Around the tables of living and dining room, in opposite directions, through the doorway between them twice."""
    (x, y), (u, v) = table_of(plan.living, -1), table_of(plan.dining, 1)
    r, door = AROUND, plan.north_door
    dining = [(u - r, v - r), (u + r, v - r), (u + r, v + r), (u - r, v + r)]
    living = [(x + r, y - r), (x - r, y - r), (x - r, y + r)]
    return [(x, y + r), (x + r, y + r), door, *dining, door, *living, (x + 0.5, y + r)]


def out_and_back(plan: Plan) -> Corners:
    """From the bedroom along the hall into a twin room, around its table and back the same way."""
    way = [(plan.east, plan.south_door[1]), (plan.east, 0.0)]
    return [*way, *_visit(plan, 0.0), *way[::-1]]


def twin_rooms(plan: Plan) -> Corners:
    """Into a twin room, around its table and out again, and the same in the other."""
    return [(plan.twin_door - 2.0, 0.0), *_visit(plan, 0.0), *_visit(plan, APART), (2 * APART - 0.5, 0.0)]


def corridor(plan: Plan) -> Corners:
    """Along the gallery, in which every bay looks like the one before."""
    x, length = plan.corner.low[0] + HALF_HALL, BAY * NUM_BAYS
    return [(x, plan.bay.low[1] + 0.3), (x, plan.bay.low[1] + length - 1.0)]


def _visit(plan: Plan, shift: float) -> Corners:
    """From the hall around the table of a twin room, clockwise, and out again."""
    x, y = table_of(plan.twin, 0)
    door, r = plan.twin_door, AROUND
    table = [(x - r, y - r), (x - r, y + r), (x + r, y + r), (x + r, y - r)]
    inside = (door, plan.twin.low[1] + 0.5)
    return [(u + shift, v) for u, v in [(door, 0.0), inside, *table, inside, (door, 0.0)]]


WALKS: dict[str, Callable[[Plan], Corners]] = {
    walk.__name__: walk for walk in (two_laps, figure_of_eight, out_and_back, twin_rooms, corridor)
}


def rounded(corners: Corners, radius: float) -> Float[np.ndarray, "n 2"]:
    """Points `STEP` apart on the line through the corners, rounded with the radius, or less if two are close."""
    points = np.array(corners)
    pieces = [points[:1]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        here, there = corner - before, after - corner
        room = min(np.linalg.norm(here), np.linalg.norm(there)) / 2
        here, there = here / np.linalg.norm(here), there / np.linalg.norm(there)
        half = np.arccos(np.clip(here @ there, -1, 1)) / 2
        tangent = min(room, radius * np.tan(half))
        t = np.linspace(-half, half, 65)[:, None]
        middle = corner + (there - here) / np.linalg.norm(there - here) * tangent / np.sin(half)
        outward, along = (here - there) / np.linalg.norm(here - there), (here + there) / np.linalg.norm(here + there)
        pieces.append(middle + tangent / np.tan(half) * (np.cos(t) * outward + np.sin(t) * along))
    line = np.concatenate([*pieces, points[-1:]])
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    even = np.linspace(0, walked[-1], 1 + round(walked[-1] / STEP))
    return np.stack([np.interp(even, walked, line[:, axis]) for axis in (0, 1)], axis=-1)


def carry(corners: Corners, num_frames: int | None, rng: np.random.Generator) -> Float[np.ndarray, "n 4 4"]:
    """T_world_camera along a route at eye level, looking ahead, with the sway of a hand.

    Frames are evenly spaced, a turn by a radian counting as `TURN` metres; `num_frames` None: `SPACING` apart.
    """
    line = gaussian_filter1d(rounded(corners, RADIUS), 0.15 / STEP, axis=0, mode="nearest")
    ahead = np.gradient(line, axis=0)
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    points = np.arange(len(line))
    seen = np.interp(points + LOOK_AHEAD / STEP, points, heading)
    yaw = gaussian_filter1d(seen, 0.3 / STEP, mode="nearest")
    effort = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(walked), TURN * np.diff(yaw)))])
    count = 1 + int(np.ceil(effort[-1] / SPACING)) if num_frames is None else num_frames
    place = np.interp(np.linspace(0, effort[-1], count), effort, points)
    x, y, yaw, walked, heading = (
        np.interp(place, points, values) for values in (line[:, 0], line[:, 1], yaw, walked, heading)
    )
    sway = {name: _sway(walked, amplitude, lengths, rng) for name, amplitude, lengths in SWAY}
    x, y = x - np.sin(heading) * sway["sideways"], y + np.cos(heading) * sway["sideways"]
    return level_poses(np.stack([x, y, EYE_HEIGHT + sway["height"]], axis=-1), yaw + sway["yaw"], PITCH + sway["pitch"])


def _sway(
    walked: Float[np.ndarray, " n"], amplitude: float, lengths: tuple[float, ...], rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """Sum of waves over the distance walked, with random phases."""
    return sum(amplitude * np.sin(2 * np.pi * walked / length + rng.uniform(0, 2 * np.pi)) for length in lengths)
