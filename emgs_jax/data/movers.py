"""Moving things in the built-in scenes: people who walk, chairs that change places, doors that open.

Their places depend only on the image's position along the camera's path. z is up; metres, radians.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from emgs_jax.data import furniture
from emgs_jax.data.base import ELSEWHERE, MOVES, STAYS
from emgs_jax.data.furniture import Part

CLASSES = ("person", "chair", "door")  # in the order in which a scene gets them
SPEED = 0.5  # m/s of the camera, which gives its images times
STRIDE, PERIOD = 1.0, 4.0  # of a person who goes to and fro, ahead of the camera
ASIDE = 0.45  # m from the lane to a second person, and to a chair
CHAIR_SHIFT = 0.8  # m from its old place to its new one
SWING, SWING_TIME = np.radians(100.0), 2.0  # of a door


@dataclass(frozen=True)
class Doorway:
    """The hinge of a door leaf, the direction of the shut leaf from there, and its width."""

    hinge: tuple[float, float]
    shut: float
    width: float


@dataclass(frozen=True)
class Lane:
    """A line that is free to walk on; distances are along it."""

    line: Float[np.ndarray, "m 2"]  # points; a closed line ends with its first
    walked: Float[np.ndarray, " n"]  # distance of the camera, for each image
    lead: float  # distance from the camera to what it looks at
    chair: float  # distance of a chair's old place
    doorway: Doorway
    opens: int  # image from which on the leaf swings open

    def at(self, distance: Float[np.ndarray, " k"], aside: float = 0.0) -> Float[np.ndarray, "k 2"]:
        """Points at distances along the line and to its left; an open line is extended straight."""
        ends = np.cumsum(np.linalg.norm(np.diff(self.line, axis=0), axis=1))
        along = np.concatenate([[0.0], ends])
        if np.allclose(self.line[0], self.line[-1]):
            distance = distance % along[-1]
        tangent = np.gradient(self.line, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        inside = np.clip(distance, 0.0, along[-1])
        x, y, dx, dy = (np.interp(inside, along, values) for values in (*self.line.T, *tangent.T))
        return np.stack([x + (distance - inside) * dx - aside * dy, y + (distance - inside) * dy + aside * dx], -1)


@dataclass(frozen=True)
class Mover:
    """A moving thing."""

    part: Part  # class and mesh, in its own axes
    poses: Float[np.ndarray, "n 4 4"]  # T_world_mover of each image
    states: UInt8[np.ndarray, " n"]  # of each image: MOVES, ELSEWHERE (before its final place) or STAYS


def build_movers(count: int, lane: Lane, rng: np.random.Generator) -> list[Mover]:
    """Build a person, a chair, a door, then a second person, and so on."""
    builders = (_person, _chair, _door)
    return [builders[number % 3](lane, number // 3, rng) for number in range(count)]


def _person(lane: Lane, number: int, rng: np.random.Generator) -> Mover:
    """A person of 1.7 m who walks to and fro where the camera looks."""
    seconds = lane.walked / SPEED
    phase = 2 * np.pi * seconds / (PERIOD * (1.0 + 0.3 * number)) + rng.uniform(0, 2 * np.pi)
    place = lane.at(lane.walked + lane.lead + STRIDE * np.sin(phase), ASIDE * number)
    yaw = rng.uniform(0, 2 * np.pi) + 0.6 * np.cos(phase)
    legs = [furniture.cylinder(0.08, 0.85, 0.0).apply_translation((0.0, side, 0.0)) for side in (-0.1, 0.1)]
    body, head = furniture.box((0.24, 0.46, 0.6), (0, 0, 0.82)), furniture.sphere(0.13)[0][1]
    (part,) = furniture.join("person", *legs, body, head.apply_translation((0.0, 0.0, 1.44)))
    return Mover(part, _placed(place, yaw), np.full(len(place), MOVES, np.uint8))


def _chair(lane: Lane, number: int, rng: np.random.Generator) -> Mover:
    distance, yaw = lane.chair + 0.9 * number, rng.uniform(0, 2 * np.pi)
    before, after = lane.at(np.array([distance, distance + CHAIR_SHIFT]), -ASIDE)
    is_moved = np.arange(len(lane.walked)) >= len(lane.walked) / 2
    place, yaws = np.where(is_moved[:, None], after, before), np.where(is_moved, yaw + 1.0, yaw)
    return Mover(furniture.chair()[0], _placed(place, yaws), np.where(is_moved, STAYS, ELSEWHERE).astype(np.uint8))


def _door(lane: Lane, number: int, rng: np.random.Generator) -> Mover:
    """A leaf that swings open once; further ones hang in the same frame and open later."""
    door, seconds = lane.doorway, lane.walked / SPEED
    opened = (seconds - seconds[lane.opens]) / SWING_TIME - 0.5 * number
    share = np.clip(opened, 0.0, 1.0)
    leaf = furniture.box((door.width, 0.04, 2.0), (door.width / 2, 0, 0.02))
    poses = _placed(np.tile(np.array(door.hinge), (len(share), 1)), door.shut + SWING * share)
    states = np.select([share == 0, share < 1], [ELSEWHERE, MOVES], STAYS).astype(np.uint8)
    return Mover(furniture.join("door", leaf)[0], poses, states)


def _placed(place: Float[np.ndarray, "n 2"], yaw: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    poses = np.stack([trimesh.transformations.rotation_matrix(angle, (0, 0, 1)) for angle in yaw])
    poses[:, :2, 3] = place
    return poses
