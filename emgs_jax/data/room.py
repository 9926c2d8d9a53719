"""A furnished room for the synthetic data set: boxes, cylinders and a ball with procedural solid textures. z is up."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import map_coordinates

from emgs_jax.data.reading import Number

# A label is the position in here.
CLASSES = ("wall", "floor", "ceiling", "table", "chair", "sofa", "shelf", "cabinet", "lamp", "picture", "box", "ball")
NOISE_CELLS = 32  # the noise repeats after this many texture scales
PATTERNS = ("noise", "stripes", "checker")

Part = tuple[str, trimesh.Trimesh]


@dataclass(frozen=True)
class Looks:
    """Texture of every object: colours `low` and `high` are mixed by a pattern of the world position.

    Args:
        low, high: RGB in 0..1.
        scale: metres of one noise cell.
        pattern: row of PATTERNS.
        offset: where in the noise the object begins.
        noise: random values of the lattice, wraps around.
    """

    low: Float[np.ndarray, "n 3"]
    high: Float[np.ndarray, "n 3"]
    scale: Float[np.ndarray, " n"]
    pattern: Int[np.ndarray, " n"]
    offset: Float[np.ndarray, "n 3"]
    noise: Float[np.ndarray, "s s s"]


def build_room(rng: np.random.Generator) -> tuple[list[Part], Float[np.ndarray, " 3"]]:
    """Objects of a random room as (class, mesh) and its size x, y, z in metres; the origin is the floor's centre."""
    size = np.array([5.0, 4.0, 2.6]) * rng.uniform(0.95, 1.05, 3)
    parts = _shell(size) + _center(rng)
    walls = rng.permutation(4).tolist()
    for wall, build in zip(walls, (_sofa, _shelf, _cabinet, _desk), strict=True):
        parts += _against(build(rng), wall, size, rng.uniform(-0.3, 0.3))
    for wall in range(4):
        for along in (-0.75, 0.75):
            if rng.uniform() < 0.8 and not (wall == walls[1] and along < 0):
                parts += _against(_picture(rng), wall, size, along + rng.uniform(-0.2, 0.2))
    corners = rng.permutation(4).tolist()
    for corner, build in zip(corners, (_lamp, _boxes, _ball), strict=False):
        sign = np.array([1 - 2 * (corner & 1), 1 - (corner & 2)])
        parts += _moved(build(rng), np.array([*(sign * (size[:2] / 2 - 0.38)), 0.0]))
    return parts, size


def draw_looks(parts: list[Part], rng: np.random.Generator) -> Looks:
    """A random look for every object; hues step by the golden ratio so that no two are alike."""
    hues = (rng.uniform() + 0.618034 * np.arange(len(parts))) % 1.0
    is_shell = np.array([name in ("wall", "ceiling") for name, _ in parts])
    saturation = np.where(is_shell, 0.3, rng.uniform(0.45, 0.75, len(parts)))
    dark = np.where(is_shell, 0.5, rng.uniform(0.2, 0.35, len(parts)))
    bright = np.where(is_shell, 0.95, rng.uniform(0.8, 1.0, len(parts)))
    low = [colorsys.hsv_to_rgb(*hsv) for hsv in zip(hues, saturation, dark, strict=True)]
    high = [colorsys.hsv_to_rgb((h + 0.1) % 1.0, s, v) for h, s, v in zip(hues, saturation, bright, strict=True)]
    small = np.array([name in ("picture", "box", "ball", "lamp") for name, _ in parts])
    return Looks(
        low=np.array(low),
        high=np.array(high),
        scale=np.where(small, 0.07, rng.uniform(0.10, 0.16, len(parts))),
        pattern=np.where([name == "floor" for name, _ in parts], 2, rng.integers(0, len(PATTERNS), len(parts))),
        offset=rng.uniform(0, NOISE_CELLS, (len(parts), 3)),
        noise=rng.uniform(0, 1, (NOISE_CELLS, NOISE_CELLS, NOISE_CELLS)),
    )


def paint(
    points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"], objects: Int[np.ndarray, " p"], looks: Looks
) -> UInt8[np.ndarray, "p 3"]:
    """RGB of points in the world on the given objects; matt, so that a point has one colour from everywhere."""
    cells = points / looks.scale[objects, None] + looks.offset[objects]
    grain = 0.65 * _noise(cells, looks) + 0.35 * _noise(2.3 * cells + 17.0, looks)
    bend = 1.5 * grain
    stripes = np.sin(2.1 * (cells[:, 0] + cells[:, 1] + 0.6 * cells[:, 2]) + bend)
    checker = np.sin(1.3 * cells[:, 0] + bend) * np.sin(1.3 * cells[:, 1] + bend)
    shape = np.choose(looks.pattern[objects], [4.0 * (grain - 0.5), stripes, 1.6 * checker])
    mix = np.clip(0.5 + 0.35 * np.tanh(1.8 * shape) + 0.9 * (grain - 0.5), 0, 1)
    color = looks.low[objects] + mix[:, None] * (looks.high - looks.low)[objects]
    patches = 0.75 + 0.5 * _noise(points / 0.7 + 5.0, looks)  # large spots tell one tile of a pattern from the next
    light = 0.72 + 0.28 * np.abs(normals @ np.array([0.48, 0.36, 0.8]))
    return (255 * np.clip(color * (patches * light)[:, None], 0, 1) + 0.5).astype(np.uint8)


def _noise(cells: Float[np.ndarray, "p 3"], looks: Looks) -> Float[np.ndarray, " p"]:
    return map_coordinates(looks.noise, cells.T, order=1, mode="grid-wrap", prefilter=False)


def _box(size: Sequence[Number], low_center: Sequence[Number]) -> trimesh.Trimesh:
    """Box of (x, y, z) size whose bottom face is centred at low_center."""
    x, y, z = low_center
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix((x, y, z + size[2] / 2)))


def _cylinder(radius: float, height: float, bottom: Number) -> trimesh.Trimesh:
    center = trimesh.transformations.translation_matrix((0, 0, bottom + height / 2))
    return trimesh.creation.cylinder(radius, height, sections=32, transform=center)


def _join(name: str, *meshes: trimesh.Trimesh) -> list[Part]:
    return [(name, trimesh.util.concatenate(list(meshes)))]


def _moved(parts: list[Part], offset: Float[np.ndarray, " 3"], angle: float = 0.0) -> list[Part]:
    """Turn about z by an angle in radians, then shift."""
    matrix = trimesh.transformations.rotation_matrix(angle, (0, 0, 1))
    matrix[:3, 3] = offset
    return [(name, mesh.copy().apply_transform(matrix)) for name, mesh in parts]


def _against(parts: list[Part], wall: int, size: Float[np.ndarray, " 3"], along: float) -> list[Part]:
    """Furniture built at the origin with its back to y = 0, put to one of the walls +x, +y, -x, -y."""
    angle = wall * np.pi / 2
    out, side = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    return _moved(parts, out * size[wall % 2] / 2 + side * along, angle + np.pi / 2)


def _shell(size: Float[np.ndarray, " 3"]) -> list[Part]:
    (x, y, z), t = size, 0.1
    parts = _join("floor", _box((x + t, y + t, t), (0, 0, -t))) + _join("ceiling", _box((x + t, y + t, t), (0, 0, z)))
    for s in (-1, 1):
        parts += _join("wall", _box((t, y + t, z), (s * (x + t) / 2, 0, 0)))
        parts += _join("wall", _box((x + t, t, z), (0, s * (y + t) / 2, 0)))
    return parts


def _center(rng: np.random.Generator) -> list[Part]:
    """Table with things on it and chairs around it."""
    w, d = rng.uniform(0.95, 1.2), rng.uniform(0.55, 0.7)
    parts = _table(w, d, 0.74)
    parts += _moved(_join("box", _box((0.24, 0.16, 0.2), (0, 0, 0))), np.array([-w / 4, 0.05, 0.74]), rng.uniform(0, 3))
    parts += _moved(_sphere(0.11), np.array([w / 4, rng.uniform(-0.1, 0.1), 0.74]))
    places = ((0.0, -(d / 2 + 0.18)), (np.pi, d / 2 + 0.18), (np.pi / 2, w / 2 + 0.2))
    for angle, distance in places[: rng.integers(2, 4)]:
        offset = np.array([distance if angle == np.pi / 2 else 0.0, 0.0 if angle == np.pi / 2 else distance, 0.0])
        parts += _moved(_chair(), offset + [rng.uniform(-0.08, 0.08), 0, 0], angle + rng.uniform(-0.2, 0.2))
    return parts


def _table(w: float, d: float, h: float) -> list[Part]:
    legs = [_box((0.06, 0.06, h - 0.04), (x * (w / 2 - 0.05), y * (d / 2 - 0.05), 0)) for x in (-1, 1) for y in (-1, 1)]
    return _join("table", _box((w, d, 0.04), (0, 0, h - 0.04)), *legs)


def _chair() -> list[Part]:
    """Chair whose back stands at negative y."""
    legs = [_box((0.04, 0.04, 0.43), (x * 0.18, y * 0.18, 0)) for x in (-1, 1) for y in (-1, 1)]
    return _join("chair", _box((0.42, 0.42, 0.04), (0, 0, 0.43)), _box((0.42, 0.04, 0.45), (0, -0.19, 0.47)), *legs)


def _sofa(rng: np.random.Generator) -> list[Part]:
    w = rng.uniform(1.7, 2.0)
    arms = [_box((0.2, 0.85, 0.6), (s * (w / 2 - 0.1), 0.43, 0)) for s in (-1, 1)]
    back = _box((w - 0.4, 0.22, 0.85), (0, 0.12, 0))
    cushion = [("box", _box((0.4, 0.14, 0.36), (s * w / 5, 0.32, 0.42))) for s in (-1, 1)]
    return _join("sofa", _box((w - 0.4, 0.62, 0.42), (0, 0.54, 0)), back, *arms) + cushion


def _shelf(rng: np.random.Generator) -> list[Part]:
    """Open shelf with boxes on its boards."""
    w, h = rng.uniform(1.0, 1.3), rng.uniform(1.7, 1.95)
    boards = [_box((w, 0.32, 0.03), (0, 0.16, z)) for z in np.linspace(0.06, h - 0.03, 5)]
    sides = [_box((0.03, 0.32, h), (s * w / 2, 0.16, 0)) for s in (-1, 1)]
    parts = _join("shelf", _box((w, 0.02, h), (0, 0.01, 0)), *boards, *sides)
    for z in np.linspace(0.06, h - 0.03, 5)[:4]:
        for x in (-w / 4, w / 4):
            size = (rng.uniform(0.2, w / 2 - 0.1), 0.22, rng.uniform(0.15, 0.3))
            parts += _join("box", _box(size, (x, 0.17, z + 0.03)))
    return parts


def _cabinet(rng: np.random.Generator) -> list[Part]:
    w, h = rng.uniform(1.1, 1.4), rng.uniform(0.8, 1.0)
    doors = [_box((w / 2 - 0.05, 0.02, h - 0.12), (s * w / 4, 0.46, 0.06)) for s in (-1, 1)]
    parts = _join("cabinet", _box((w, 0.45, h), (0, 0.225, 0)), *doors)
    parts += _moved(
        _join("box", _box((0.3, 0.25, 0.35), (0, 0, 0))), np.array([-w / 4, 0.22, h]), rng.uniform(-0.3, 0.3)
    )
    return parts + _moved(_sphere(0.13), np.array([w / 4, 0.22, h]))


def _desk(rng: np.random.Generator) -> list[Part]:
    parts = _moved(_table(rng.uniform(1.1, 1.4), 0.6, 0.72), np.array([0.0, 0.3, 0.0]))
    parts += _join("box", _box((0.5, 0.04, 0.32), (0, 0.12, 0.76)), _box((0.06, 0.06, 0.06), (0, 0.12, 0.72)))
    return parts + _moved(_chair(), np.array([rng.uniform(-0.2, 0.2), 0.72, 0.0]), np.pi + rng.uniform(-0.3, 0.3))


def _picture(rng: np.random.Generator) -> list[Part]:
    w, h = rng.uniform(0.4, 0.8), rng.uniform(0.35, 0.55)
    return _join("picture", _box((w, 0.03, h), (0, 0.015, 1.6 - h / 2 + rng.uniform(0, 0.2))))


def _lamp(rng: np.random.Generator) -> list[Part]:
    h = rng.uniform(1.4, 1.7)
    return _join("lamp", _cylinder(0.15, 0.03, 0), _cylinder(0.02, h, 0.03), _cylinder(0.18, 0.3, h - 0.1))


def _boxes(rng: np.random.Generator) -> list[Part]:
    parts = _moved(_join("box", _box((0.5, 0.42, 0.4), (0, 0, 0))), np.zeros(3), rng.uniform(-0.2, 0.2))
    return parts + _moved(_join("box", _box((0.34, 0.3, 0.3), (0, 0, 0.4))), np.zeros(3), rng.uniform(-0.6, 0.6))


def _ball(rng: np.random.Generator) -> list[Part]:
    return _sphere(rng.uniform(0.18, 0.28))


def _sphere(radius: float) -> list[Part]:
    """Ball that lies on z = 0."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return _moved([("ball", mesh)], np.array([0.0, 0.0, radius]))
