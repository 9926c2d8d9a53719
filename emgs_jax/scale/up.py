"""Which way is up: by cameras that are held level, and by floors and walls."""

import numpy as np
from jaxtyping import Float

TILT = 0.02  # weight of the cameras' mean -y beside the directions that are level
WIDTHS_DEG = (20.0, 10.0, 5.0, 3.0)  # of what counts as level or upright, narrower in each step
NUM_STEPS = 3  # with each width
OPEN = 1e-3  # weight of the direction so far, for what surfaces leave open, such as one wall alone


def up_of_cameras(rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "3"]:
    """Return the unit vector u that is up by cameras that are held level, however they are pitched.

    The x axes x_i of level cameras are horizontal: u minimizes Σ (x_i·u)² / n - TILT (u·ȳ)², where -ȳ is their mean y
    axis (down). Where the cameras do not turn, x_i leave u open, and ȳ decides.

    Args:
        rotations: camera → world, OpenCV axes.
    """
    level, down = rotations[:, :, 0], rotations[:, :, 1].mean(axis=0)
    _, vectors = np.linalg.eigh(level.T @ level / len(level) - TILT * np.outer(down, down))
    up = vectors[:, 0]
    return -up if up @ down > 0 else up


def up_of_surfaces(
    up: Float[np.ndarray, "3"], normals: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "3"]:
    """Improve a direction by floors, tables and ceilings, whose normals are along it, and walls, across it.

    With w = exp(-θ² / 2 width²) of the angle θ to exactly along or across, and the weights a, u minimizes
    Σ_walls a w (n·u)² - Σ_floors a w (n·u)²; the width falls from step to step.

    Args:
        up: unit vector, within about 20° of the truth.
        normals: unit vectors.
        weights: as 1 / σ², up to a factor.

    Returns:
        The direction as it was, if surfaces lead farther from it than that: outdoors, trees and banks do.
    """
    before = up
    for width in np.radians(WIDTHS_DEG).repeat(NUM_STEPS):
        angle = np.arccos(np.clip(np.abs(normals @ up), 0.0, 1.0))
        along, across = (weights * np.exp(-0.5 * (off / width) ** 2) for off in (angle, np.pi / 2 - angle))
        if not along.any() and not across.any():
            return up
        open_as_before = OPEN * (along.sum() + across.sum()) * np.outer(up, up)
        _, vectors = np.linalg.eigh(((across - along)[:, None] * normals).T @ normals - open_as_before)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return up if up @ before >= np.cos(np.radians(WIDTHS_DEG[0])) else before
