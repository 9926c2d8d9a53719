"""Procedural solid textures of the built-in scenes: two colours an object, mixed by a pattern of the position."""

import colorsys
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import map_coordinates

from emgs_jax.data.furniture import Part

NOISE_CELLS = 32  # period of the noise, in texture scales
PATTERNS = ("noise", "stripes", "checker")


@dataclass(frozen=True)
class Looks:
    """Textures of objects: a pattern of the world position mixes the colours `low` and `high`, RGB in 0..1."""

    low: Float[np.ndarray, "n 3"]
    high: Float[np.ndarray, "n 3"]
    scale: Float[np.ndarray, " n"]  # metres of one noise cell
    pattern: Int[np.ndarray, " n"]  # row of PATTERNS
    offset: Float[np.ndarray, "n 3"]  # of the object in the noise
    origin: Float[np.ndarray, "n 3"]  # of the texture in the world, metres, so that copies look alike
    noise: Float[np.ndarray, "s s s"]  # random lattice, wraps around


def draw_looks(parts: list[Part], rng: np.random.Generator) -> Looks:
    """Draw a look for every object; hues step by the golden ratio, so that no two are alike."""
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
        origin=np.zeros((len(parts), 3)),
        noise=rng.uniform(0, 1, (NOISE_CELLS, NOISE_CELLS, NOISE_CELLS)),
    )


def copied(looks: Looks, rows: Int[np.ndarray, " c"], shifts: Float[np.ndarray, "c 3"]) -> Looks:
    """Looks of copies of the objects `rows`, shifted by metres in the world."""
    each = {field: getattr(looks, field)[rows] for field in ("low", "high", "scale", "pattern", "offset", "origin")}
    return replace(looks, **{**each, "origin": each["origin"] + shifts})


def paint(
    points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"], objects: Int[np.ndarray, " p"], looks: Looks
) -> UInt8[np.ndarray, "p 3"]:
    """RGB of world points on the given objects; matt, so that it does not depend on the view."""
    points = points - looks.origin[objects]
    cells = points / looks.scale[objects, None] + looks.offset[objects]
    grain = 0.65 * _noise(cells, looks) + 0.35 * _noise(2.3 * cells + 17.0, looks)
    bend = 1.5 * grain
    stripes = np.sin(2.1 * (cells[:, 0] + cells[:, 1] + 0.6 * cells[:, 2]) + bend)
    checker = np.sin(1.3 * cells[:, 0] + bend) * np.sin(1.3 * cells[:, 1] + bend)
    shape = np.choose(looks.pattern[objects], [4.0 * (grain - 0.5), stripes, 1.6 * checker])
    mix = np.clip(0.5 + 0.35 * np.tanh(1.8 * shape) + 0.9 * (grain - 0.5), 0, 1)
    color = looks.low[objects] + mix[:, None] * (looks.high - looks.low)[objects]
    patches = 0.75 + 0.5 * _noise(points / 0.7 + 5.0, looks)  # large spots distinguish the tiles of a pattern
    light = 0.72 + 0.28 * np.abs(normals @ np.array([0.48, 0.36, 0.8]))
    return (255 * np.clip(color * (patches * light)[:, None], 0, 1) + 0.5).astype(np.uint8)


def _noise(cells: Float[np.ndarray, "p 3"], looks: Looks) -> Float[np.ndarray, " p"]:
    return map_coordinates(looks.noise, cells.T, order=1, mode="grid-wrap", prefilter=False)
