"""A furnished room for the synthetic data set. z is up."""

import numpy as np
from jaxtyping import Float

from emgs_jax.data import furniture
from emgs_jax.data.furniture import Part

# A label is the position in here.
CLASSES = ("wall", "floor", "ceiling", "table", "chair", "sofa", "shelf", "cabinet", "lamp", "picture", "box", "ball")


def build_room(rng: np.random.Generator) -> tuple[list[Part], Float[np.ndarray, " 3"]]:
    """Objects of a random room as (class, mesh) and its size x, y, z in metres; the origin is the floor's centre."""
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
    parts = furniture.join("floor", furniture.box((x + t, y + t, t), (0, 0, -t))) + furniture.join(
        "ceiling", furniture.box((x + t, y + t, t), (0, 0, z))
    )
    for s in (-1, 1):
        parts += furniture.join("wall", furniture.box((t, y + t, z), (s * (x + t) / 2, 0, 0)))
        parts += furniture.join("wall", furniture.box((x + t, t, z), (0, s * (y + t) / 2, 0)))
    return parts
