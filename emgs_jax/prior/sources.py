"""The other views that a view is matched or compared with, and their choice."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from emgs_jax.ops.pytree import stack
from emgs_jax.structure.model import Structure


class Sources(NamedTuple):
    """Other views."""

    views: Any  # what of them is compared, such as grey images in [0, 1], features or depths (m, 0 = none); batched
    T_source_view: jaxlie.SE3  # view -> source, batched likewise
    is_used: Bool[Array, "s"]  # sources that count


def sources_of(found: Structure, frame: int, others: Sequence[int], count: int, view: Callable[[int], Any]) -> Sources:
    """The first `count` of `others`; where they are fewer, they are repeated, and the repetitions do not count."""
    is_used = np.arange(count) < len(others)
    others, poses = (list(others) * count)[:count], found.T_world_camera
    T = np.stack([np.linalg.inv(poses[other]) @ poses[frame] for other in others])
    T_source_view = jaxlie.SE3.from_matrix(jnp.asarray(T, jnp.float32))
    return Sources(stack([view(other) for other in others]), T_source_view, jnp.asarray(is_used))


def placed_beside(found: Structure, frame: int) -> list[int]:
    """Frames of the same world that show landmarks, without this one, the nearest in time first."""
    others = np.flatnonzero((found.world == found.world[frame]) & found.is_placed)
    others = others[others != frame]
    return others[np.argsort(np.abs(others - frame), kind="stable")].tolist()


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
