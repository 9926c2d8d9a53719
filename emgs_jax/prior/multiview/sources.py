"""Choice of the other views that a view is matched against."""

from collections.abc import Sequence

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from emgs_jax.structure.model import Structure


def placed_beside(found: Structure, frame: int) -> np.ndarray:
    """Frames of the same world that show landmarks, without this one, the nearest in time first."""
    others = np.flatnonzero((found.world == found.world[frame]) & found.is_placed)
    others = others[others != frame]
    return others[np.argsort(np.abs(others - frame), kind="stable")]


def relative(found: Structure, others: Sequence[int], frame: int) -> jaxlie.SE3:
    """T_other_frame of several views."""
    poses = found.T_world_camera
    T = [np.linalg.inv(poses[other]) @ poses[frame] for other in others]
    return jaxlie.SE3.from_matrix(jnp.asarray(np.stack(T), jnp.float32))


def parallax(
    points: Float[np.ndarray, "l 3"], center: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "l"]:
    """Sine of the angle at each point between the rays from two cameras."""
    a, b = points - center, points - other
    return np.linalg.norm(np.cross(a, b), axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))


def choose(worth: dict[int, Float[np.ndarray, "l"]], count: int) -> list[int]:
    """The views, at most `count`, that together are worth most to all landmarks, best first.

    One after the other is added that most increases Σ √w over the landmarks, w what the chosen views are worth to one.
    The root saturates: what no chosen view shows yet counts most, so the side to which the camera turns has its
    sources, too. Adding the best is within 1 − 1/e of the best choice of all (Nemhauser, Wolsey and Fisher, Math.
    Programming 1978).

    Args:
        worth: of every view to every landmark, 0 where it does not show it.
        count: of views.
    """
    left, chosen, total = dict(worth), [], np.zeros(1)
    while left and len(chosen) < count:
        gain = {view: np.sqrt(total + value).sum() for view, value in left.items()}
        best = max(gain, key=lambda view: gain[view])
        value = left.pop(best)
        if not value.any():
            break
        total = total + value
        chosen.append(best)
    return chosen
