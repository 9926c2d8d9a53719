"""Choice of the other views that a view is matched against."""

import numpy as np
from jaxtyping import Float


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
