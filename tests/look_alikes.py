"""A corridor of equal doors and tiles: places that look alike, seen by a camera that walks straight ahead."""

import cv2
import numpy as np

from emgs_jax.data.furniture import box, join
from emgs_jax.data.looks import draw_looks, paint
from emgs_jax.data.raycast import RayCast, Scene, level_poses

EVERY = 2.4  # metres from door to door, and the period of the floor
LENGTH, WIDTH, HEIGHT, WALL = 10.0, 1.8, 2.5, 0.1
TILE, GROUT = 0.2, 0.012
FOCAL_PER_WIDTH = 0.82


class Corridor(RayCast):
    """`look` is doors: equal doors on both sides, a floor that repeats; or tiles: white ones on walls and floor."""

    name, classes, version = "corridor", ("floor", "ceiling", "wall", "door"), 1

    def __init__(self, look: str, num_frames: int, step: float, size: tuple[int, int]) -> None:
        self.seed, self.num_frames, self.start, self.stop, self.stride = 0, num_frames, 0, None, 1
        self.intrinsics, self.movers, self.look = None, 0, look
        self.size = 2 * size[0], 2 * size[1]  # drawn at twice the size, against aliasing
        super().__post_init__()
        rng = np.random.default_rng(0)
        parts = join("floor", box((LENGTH, WIDTH, WALL), (LENGTH / 2, 0, -WALL)))
        parts += join("ceiling", box((LENGTH, WIDTH, WALL), (LENGTH / 2, 0, HEIGHT)))
        for side in (-1, 1):
            parts += join("wall", box((LENGTH, WALL, HEIGHT), (LENGTH / 2, side * (WIDTH + WALL) / 2, 0)))
        for x in (-WALL / 2, LENGTH + WALL / 2):
            parts += join("wall", box((WALL, WIDTH, HEIGHT), (x, 0, 0)))
        self.first_door = len(parts)
        for x in np.arange(1.2, LENGTH, EVERY) if look == "doors" else ():
            for side in (-1, 1):
                parts += join("door", box((0.9, 0.06, 2.0), (x, side * (WIDTH / 2 - 0.03), 0)))
        x = step * np.arange(num_frames) + 0.6

        def sway(amplitude):
            phase = rng.uniform(0, 1, (2, 1))
            return amplitude * np.sin(2 * np.pi * (x / np.array([[1.3], [3.7]]) + phase)).sum(axis=0)

        at = np.stack([x, sway(0.012), 1.5 + sway(0.012)], axis=-1)
        poses = level_poses(at, sway(np.radians(1.2)), np.radians(-3) + sway(np.radians(1)))
        self._show(look, Scene(parts, draw_looks(parts, rng)), poses)

    @property
    def T_world_camera(self) -> np.ndarray:
        return np.stack([self.pose(row) for row in range(len(self))])

    def image(self, row: int) -> np.ndarray:
        """RGB at the size that was asked for."""
        depth, objects, normals, rays = self._cast(row)
        points = (self.pose(row)[:3, 3] + rays[..., 3:] * depth[..., None]).reshape(-1, 3)
        normals, objects = normals.reshape(-1, 3), objects.reshape(-1)
        kind = np.array([name for name, _ in self.parts])[objects]
        is_of_doors = self.look == "doors"
        shades = self._doors(points, normals, objects, kind) if is_of_doors else _tiles(points, normals, kind)
        light = 0.72 + 0.28 * np.abs(normals @ np.array([0.48, 0.36, 0.8]))
        noise = np.random.default_rng(row).normal(0, 1.5, (len(points), 3))
        drawn = np.clip(255 * shades * light[:, None] + noise, 0, 255).astype(np.uint8).reshape(*depth.shape, 3)
        return cv2.resize(drawn, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)

    def _doors(self, points, normals, objects, kind):
        repeated = points * [1, 1, 1] - np.outer(points[:, 0] // EVERY * EVERY, [1, 0, 0])
        rows = np.where(kind == "door", self.first_door, objects)
        is_drawn = np.isin(kind, ("door", "floor"))
        drawn = paint(repeated, normals, rows, self._looks) / 255
        return np.where(is_drawn[:, None], drawn, np.where(kind == "wall", 0.85, 0.9)[:, None])


def _tiles(points, normals, kind):
    to_line = np.abs((points / TILE + 0.5) % 1 - 0.5) * TILE
    is_tile = np.clip((np.where(np.abs(normals) > 0.5, 1.0, to_line).min(axis=1) - GROUT / 2) / 0.004, 0, 1)
    return np.where(kind == "ceiling", 0.9, 0.35 + 0.57 * is_tile)[:, None] * np.ones(3)
