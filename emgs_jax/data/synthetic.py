"""A ray-cast, furnished room: images with exact depth, poses, labels and normals, from a seed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from emgs_jax.data import furniture
from emgs_jax.data.furniture import Part
from emgs_jax.data.looks import draw_looks
from emgs_jax.data.movers import Doorway, Lane
from emgs_jax.data.raycast import RayCast, Scene, level_poses

MARGIN = np.array([1.25, 1.05])  # from the walls to the camera's ellipse
ARC = np.radians(140.0)  # of the camera's path


@dataclass(eq=False)
class Synthetic(RayCast):
    """The camera circles the middle of a room and looks across it: about 6.5 cm and 3.6 degrees a frame of 40."""

    num_frames: int = 40

    name, classes, version = "synthetic", furniture.CLASSES, 1

    def __post_init__(self) -> None:
        super().__post_init__()
        rng = np.random.default_rng(self.seed)
        parts, room_size = build_room(rng)
        scene = Scene(parts, draw_looks(parts, rng))
        poses = camera_path(self.num_frames, room_size, rng)
        self._show(f"room{self.seed}", scene, poses, self._things(lane_around(room_size, poses[:, :2, 3])))


def build_room(rng: np.random.Generator) -> tuple[list[Part], Float[np.ndarray, " 3"]]:
    """Build the objects of a random room, and its size x, y, z in metres; the origin is the floor's centre."""
    size = np.array([5.0, 4.0, 2.6]) * rng.uniform(0.95, 1.05, 3)
    parts = _shell(size) + furniture.table_with_chairs(rng)
    walls = rng.permutation(4).tolist()
    for wall, build in zip(walls, (furniture.sofa, furniture.shelf, furniture.cabinet, furniture.desk), strict=True):
        parts += furniture.against(build(rng), wall, size, rng.uniform(-0.3, 0.3))
    for wall in range(4):
        for along in (-0.75, 0.75):
            if rng.uniform() < 0.8 and not (wall == walls[1] and along < 0):
                parts += furniture.against(furniture.picture(rng), wall, size, along + rng.uniform(-0.2, 0.2))
    corners = rng.permutation(4).tolist()
    for corner, build in zip(corners, (furniture.lamp, furniture.boxes, furniture.ball), strict=False):
        sign = np.array([1 - 2 * (corner & 1), 1 - (corner & 2)])
        parts += furniture.moved(build(rng), np.array([*(sign * (size[:2] / 2 - 0.38)), 0.0]))
    return parts, size


def _shell(size: Float[np.ndarray, " 3"]) -> list[Part]:
    (x, y, z), t = size, 0.1
    parts = furniture.join("floor", furniture.box((x + t, y + t, t), (0, 0, -t)))
    parts += furniture.join("ceiling", furniture.box((x + t, y + t, t), (0, 0, z)))
    for s in (-1, 1):
        parts += furniture.join("wall", furniture.box((t, y + t, z), (s * (x + t) / 2, 0, 0)))
        parts += furniture.join("wall", furniture.box((x + t, t, z), (0, s * (y + t) / 2, 0)))
    return parts


def lane_around(room_size: Float[np.ndarray, " 3"], camera: Float[np.ndarray, "n 2"]) -> Lane:
    """The camera's whole ellipse, across which it looks; a door leaf swings from the wall that it faces."""
    radii = room_size[:2] / 2 - MARGIN
    angle = np.unwrap(np.arctan2(*(camera / radii).T[::-1]))
    sense = 1.0 if angle[-1] >= angle[0] else -1.0
    turn = angle[0] + sense * np.linspace(0, 2 * np.pi, 721)
    line = radii * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1)
    walked = np.interp(np.abs(angle - angle[0]), np.linspace(0, 2 * np.pi, 721), np.append(0.0, np.cumsum(length)))
    middle = len(camera) // 2
    wall = round((angle[middle] + np.pi) / (np.pi / 2)) % 4
    out, side = (np.round([np.cos(turn), np.sin(turn)]) for turn in (wall * np.pi / 2, (wall + 1) * np.pi / 2))
    hinge = out * (room_size[wall % 2] / 2 - 0.05) - side * 0.3
    doorway = Doorway((hinge[0], hinge[1]), (wall + 1) * np.pi / 2, 0.8)
    return Lane(line, walked, length.sum() / 2, length.sum() / 2 + 0.3 * walked[-1], doorway, middle)


def camera_path(
    num_frames: int, room_size: Float[np.ndarray, " 3"], rng: np.random.Generator
) -> Float[np.ndarray, "n 4 4"]:
    """T_world_camera along an arc above the furniture, looking inward and slightly down, without roll."""
    begin, sense, phase = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
    round_ = np.linspace(0, ARC, num_frames)
    angle = begin + sense * round_
    a, b = room_size[:2] / 2 - MARGIN
    height = 1.5 + 0.06 * np.sin(2 * round_ + phase)
    positions = np.stack([a * np.cos(angle), b * np.sin(angle), height], axis=-1)
    yaw = angle + np.pi + np.radians(5) * np.sin(2 * round_ + phase)
    pitch = np.radians(-16) + np.radians(4) * np.sin(3 * round_ + phase)
    return level_poses(positions, yaw, pitch)
