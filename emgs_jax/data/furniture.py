"""Furniture as meshes: boxes, cylinders and balls, in metres, z up; what stands at a wall has its back to y = 0."""

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float

from emgs_jax.data.reading import Number

# Classes of a room; a label is the position in here.
CLASSES = ("wall", "floor", "ceiling", "table", "chair", "sofa", "shelf", "cabinet", "lamp", "picture", "box", "ball")
Part = tuple[str, trimesh.Trimesh]  # class and mesh of an object


def box(size: Sequence[Number], low_center: Sequence[Number]) -> trimesh.Trimesh:
    """Box of (x, y, z) size whose bottom face is centred at low_center."""
    x, y, z = low_center
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix((x, y, z + size[2] / 2)))


def cylinder(radius: float, height: float, bottom: Number) -> trimesh.Trimesh:
    center = trimesh.transformations.translation_matrix((0, 0, bottom + height / 2))
    return trimesh.creation.cylinder(radius, height, sections=32, transform=center)


def join(name: str, *meshes: trimesh.Trimesh) -> list[Part]:
    return [(name, trimesh.util.concatenate(list(meshes)))]


def moved(parts: list[Part], offset: Float[np.ndarray, " 3"], angle: float = 0.0) -> list[Part]:
    """Turn about z by an angle in radians, then shift."""
    matrix = trimesh.transformations.rotation_matrix(angle, (0, 0, 1))
    matrix[:3, 3] = offset
    return [(name, mesh.copy().apply_transform(matrix)) for name, mesh in parts]


def against(parts: list[Part], wall: int, size: Float[np.ndarray, " 3"], along: float) -> list[Part]:
    """Move furniture with its back at y = 0 to one of the walls +x, +y, -x, -y."""
    angle = wall * np.pi / 2
    out, side = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    return moved(parts, out * size[wall % 2] / 2 + side * along, angle + np.pi / 2)


def table_with_chairs(rng: np.random.Generator) -> list[Part]:
    w, d = rng.uniform(0.95, 1.2), rng.uniform(0.55, 0.7)
    parts = table(w, d, 0.74)
    parts += moved(join("box", box((0.24, 0.16, 0.2), (0, 0, 0))), np.array([-w / 4, 0.05, 0.74]), rng.uniform(0, 3))
    parts += moved(sphere(0.11), np.array([w / 4, rng.uniform(-0.1, 0.1), 0.74]))
    places = ((0.0, -(d / 2 + 0.18)), (np.pi, d / 2 + 0.18), (np.pi / 2, w / 2 + 0.2))
    for angle, distance in places[: rng.integers(2, 4)]:
        offset = np.array([distance if angle == np.pi / 2 else 0.0, 0.0 if angle == np.pi / 2 else distance, 0.0])
        parts += moved(chair(), offset + [rng.uniform(-0.08, 0.08), 0, 0], angle + rng.uniform(-0.2, 0.2))
    return parts


def table(w: float, d: float, h: float) -> list[Part]:
    legs = [box((0.06, 0.06, h - 0.04), (x * (w / 2 - 0.05), y * (d / 2 - 0.05), 0)) for x in (-1, 1) for y in (-1, 1)]
    return join("table", box((w, d, 0.04), (0, 0, h - 0.04)), *legs)


def chair() -> list[Part]:
    """Chair whose back stands at negative y."""
    legs = [box((0.04, 0.04, 0.43), (x * 0.18, y * 0.18, 0)) for x in (-1, 1) for y in (-1, 1)]
    return join("chair", box((0.42, 0.42, 0.04), (0, 0, 0.43)), box((0.42, 0.04, 0.45), (0, -0.19, 0.47)), *legs)


def sofa(rng: np.random.Generator) -> list[Part]:
    w = rng.uniform(1.7, 2.0)
    arms = [box((0.2, 0.85, 0.6), (s * (w / 2 - 0.1), 0.43, 0)) for s in (-1, 1)]
    back = box((w - 0.4, 0.22, 0.85), (0, 0.12, 0))
    cushion = [("box", box((0.4, 0.14, 0.36), (s * w / 5, 0.32, 0.42))) for s in (-1, 1)]
    return join("sofa", box((w - 0.4, 0.62, 0.42), (0, 0.54, 0)), back, *arms) + cushion


def shelf(rng: np.random.Generator) -> list[Part]:
    w, h = rng.uniform(1.0, 1.3), rng.uniform(1.7, 1.95)
    boards = [box((w, 0.32, 0.03), (0, 0.16, z)) for z in np.linspace(0.06, h - 0.03, 5)]
    sides = [box((0.03, 0.32, h), (s * w / 2, 0.16, 0)) for s in (-1, 1)]
    parts = join("shelf", box((w, 0.02, h), (0, 0.01, 0)), *boards, *sides)
    for z in np.linspace(0.06, h - 0.03, 5)[:4]:
        for x in (-w / 4, w / 4):
            size = (rng.uniform(0.2, w / 2 - 0.1), 0.22, rng.uniform(0.15, 0.3))
            parts += join("box", box(size, (x, 0.17, z + 0.03)))
    return parts


def cabinet(rng: np.random.Generator) -> list[Part]:
    w, h = rng.uniform(1.1, 1.4), rng.uniform(0.8, 1.0)
    doors = [box((w / 2 - 0.05, 0.02, h - 0.12), (s * w / 4, 0.46, 0.06)) for s in (-1, 1)]
    parts = join("cabinet", box((w, 0.45, h), (0, 0.225, 0)), *doors)
    parts += moved(join("box", box((0.3, 0.25, 0.35), (0, 0, 0))), np.array([-w / 4, 0.22, h]), rng.uniform(-0.3, 0.3))
    return parts + moved(sphere(0.13), np.array([w / 4, 0.22, h]))


def desk(rng: np.random.Generator) -> list[Part]:
    parts = moved(table(rng.uniform(1.1, 1.4), 0.6, 0.72), np.array([0.0, 0.3, 0.0]))
    parts += join("box", box((0.5, 0.04, 0.32), (0, 0.12, 0.76)), box((0.06, 0.06, 0.06), (0, 0.12, 0.72)))
    return parts + moved(chair(), np.array([rng.uniform(-0.2, 0.2), 0.72, 0.0]), np.pi + rng.uniform(-0.3, 0.3))


def picture(rng: np.random.Generator) -> list[Part]:
    w, h = rng.uniform(0.4, 0.8), rng.uniform(0.35, 0.55)
    return join("picture", box((w, 0.03, h), (0, 0.015, 1.6 - h / 2 + rng.uniform(0, 0.2))))


def lamp(rng: np.random.Generator) -> list[Part]:
    h = rng.uniform(1.4, 1.7)
    return join("lamp", cylinder(0.15, 0.03, 0), cylinder(0.02, h, 0.03), cylinder(0.18, 0.3, h - 0.1))


def boxes(rng: np.random.Generator) -> list[Part]:
    parts = moved(join("box", box((0.5, 0.42, 0.4), (0, 0, 0))), np.zeros(3), rng.uniform(-0.2, 0.2))
    return parts + moved(join("box", box((0.34, 0.3, 0.3), (0, 0, 0.4))), np.zeros(3), rng.uniform(-0.6, 0.6))


def low_table(rng: np.random.Generator) -> list[Part]:
    w, d = rng.uniform(0.9, 1.2), rng.uniform(0.5, 0.7)
    parts = table(w, d, 0.45)
    parts += moved(join("box", box((0.3, 0.22, 0.1), (0, 0, 0))), np.array([-w / 4, 0.0, 0.45]), rng.uniform(0, 3))
    return parts + moved(sphere(0.09), np.array([w / 4, rng.uniform(-0.1, 0.1), 0.45]))


def bed(rng: np.random.Generator) -> list[Part]:
    w, length = rng.uniform(1.2, 1.5), rng.uniform(1.95, 2.1)
    head, foot = box((w, 0.06, 0.9), (0, 0.03, 0)), box((w, 0.06, 0.5), (0, length - 0.03, 0))
    mattress = box((w - 0.04, length - 0.12, 0.3), (0, length / 2, 0.18))
    return join("bed", head, foot, mattress) + join("box", box((0.6, 0.4, 0.12), (0, 0.3, 0.48)))


def plant(rng: np.random.Generator) -> list[Part]:
    h, r = rng.uniform(0.8, 1.1), rng.uniform(0.14, 0.17)
    crown = [trimesh.creation.icosphere(subdivisions=3, radius=r) for _ in range(5)]
    for turn, leaf in enumerate(crown):
        leaf.apply_translation((0.7 * r * np.cos(1.9 * turn), 0.7 * r * np.sin(1.9 * turn), h + 0.4 * r * turn))
    return join("plant", cylinder(0.17, 0.3, 0), cylinder(0.02, h - 0.3, 0.3), *crown)


def ceiling_lamp(at: tuple[float, float], ceiling: float) -> list[Part]:
    """Flat lamp under the ceiling at (x, y)."""
    return moved(join("lamp", cylinder(0.25, 0.08, ceiling - 0.08)), np.array([*at, 0.0]))


def closed_door(width: float, height: float) -> list[Part]:
    rails = [box((0.09, 0.05, height), (s * (width / 2 + 0.045), 0.025, 0)) for s in (-1, 1)]
    lintel = box((width + 0.18, 0.05, 0.09), (0, 0.025, height))
    panels = [box((width - 0.3, 0.04, height / 2 - 0.3), (0, 0.02, z)) for z in (0.15, height / 2 + 0.1)]
    return join("door", box((width, 0.025, height), (0, 0.0125, 0)), lintel, *rails, *panels)


def ball(rng: np.random.Generator) -> list[Part]:
    return sphere(rng.uniform(0.18, 0.28))


def sphere(radius: float) -> list[Part]:
    """Ball that lies on z = 0."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return moved([("ball", mesh)], np.array([0.0, 0.0, radius]))
