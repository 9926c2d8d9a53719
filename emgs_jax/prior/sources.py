"""Choose the other views that a view is matched or compared with."""

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

    views: Any  # what is compared, such as grey images in [0, 1], features or depths (0 = none); batched
    T_source_view: jaxlie.SE3  # view -> source, batched
    is_used: Bool[Array, "s"]  # False for padding


def sources_of(found: Structure, frame: int, others: Sequence[int], count: int, view: Callable[[int], Any]) -> Sources:
    """The first `count` of `others`, padded by repetitions that do not count."""
    num_used, poses = len(others), found.T_world_camera
    others = (list(others) * count)[:count]
    T = np.stack([np.linalg.inv(poses[other]) @ poses[frame] for other in others])
    return _sources([view(other) for other in others], T, num_used)


def _sources(views: Sequence[Any], T_source_view: Float[np.ndarray, "s 4 4"], num_used: int) -> Sources:
    T = jaxlie.SE3.from_matrix(jnp.asarray(T_source_view, jnp.float32))
    return Sources(stack(views), T, jnp.asarray(np.arange(len(views)) < num_used))


def same_sources(view: Any, count: int) -> Sources:
    """A view as its own sources, to compile programs before there are others."""
    return _sources([view] * count, np.stack([np.eye(4)] * count), count)


def placed_beside(found: Structure, frame: int) -> list[int]:
    """Other frames of the same world that show landmarks, the nearest in time first."""
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
    """Choose at most `count` views greedily, best first, by their worth to every landmark (0: does not show it).

    Each adds most to Σ √w over the landmarks, where w is the worth of the chosen views. The root saturates, so
    landmarks that no chosen view shows count most. Greedy is within 1 − 1/e of the optimum (Nemhauser, Wolsey and
    Fisher, Math. Programming 1978).
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
