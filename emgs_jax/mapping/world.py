"""Worlds of the prior: where one lies in the map, and what a prediction in it is there.

A prior that has lost the first view may continue in a world of its own; relocalization places such a world in the map.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.device.arrays import to_se3
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.mapping.window_input import WindowInput
from emgs_jax.observation import Prediction
from emgs_jax.registration.rigid import pose_row, scale_translation

UNKNOWN = np.full((4, 4), np.nan)  # pose


@dataclass(frozen=True)
class World:
    """A world of the prior in the submap that is mapped in it.

    Args:
        number: `WindowInput.structure`; 0: that of the first frame.
        T_world_structure: its pose (4, 4); None: that of the first frame, which predictions have already.
        T_world_anchor: (4, 4) of the frame about which its lengths are scaled; None likewise.
        motion: of it since relocalization; None: the identity.
    """

    number: int = 0
    T_world_structure: np.ndarray | None = None
    T_world_anchor: np.ndarray | None = None
    motion: jaxlie.SE3 | None = None


def is_related(world: World, window: WindowInput) -> bool:
    """Test whether the predicted poses are in this world."""
    return window.structure == world.number


def place_world(window: WindowInput, pose: np.ndarray) -> World:
    """Place the world of an input by the pose of its frame in the map; lengths are scaled about that frame."""
    own = window.T_anchor_views.get(window.frames[0].index, UNKNOWN)
    return World(window.structure, pose @ np.linalg.inv(own), pose)


def anchor_world(world: World, window: WindowInput, pose: np.ndarray, scale: float) -> World:
    """Anchor the prior's world at a frame that was relocalized, by its pose and scale."""
    if not is_related(world, window):  # the prior continues in a world of its own, which moves with this frame
        return replace(place_world(window, pose), motion=jaxlie.SE3.identity())
    prediction = step_prediction(world, window)
    return replace(world, motion=anchor_motion(prediction, to_se3(pose), jnp.asarray(scale, jnp.float32)))


def step_prediction(world: World, window: WindowInput) -> Prediction:
    """Return a step's prediction in the world of the map; without poses where they are not related to it."""
    prediction = as_step_prediction(window.prediction)
    if world.T_world_structure is None or not is_related(world, window):
        return prediction
    here = window.frames[0].index
    rows = here - 1, here, here + int(prediction.has_newest)
    T_world_views = world.T_world_structure @ np.stack([window.T_anchor_views.get(row, UNKNOWN) for row in rows])
    return replace(prediction, T_world_views=to_se3(T_world_views), T_world_anchor=to_se3(world.T_world_anchor))


def as_step_prediction(opening: FirstWindow | Prediction) -> Prediction:
    """Convert the first view of a sequence to a step's input; return a step's input as it is."""
    if isinstance(opening, Prediction):
        return opening
    view, T = jax.tree.map(lambda leaf: leaf[0], opening.views), pose_row(opening.T_world_views, 0)
    return Prediction(
        current=view,
        previous=view,
        T_world_views=jaxlie.SE3(jnp.stack([T.wxyz_xyz] * 3)),
        T_world_anchor=T,
        pose_covariance=opening.pose_covariance[0],
        scale_std=opening.scale_std[0],
        has_newest=jnp.asarray(False),
        is_repeat=jnp.asarray(False),
    )


def anchor_motion(prediction: Prediction, T_world_camera: jaxlie.SE3, scale: jnp.ndarray) -> jaxlie.SE3:
    """Return the motion of the prior's world that brings its own current pose, scaled about the anchor, to this one."""
    anchor, current = prediction.T_world_anchor, pose_row(prediction.T_world_views, 1)
    return T_world_camera @ scale_translation(anchor.inverse() @ current, scale).inverse() @ anchor.inverse()


def move_prediction(prediction: Prediction, motion: jaxlie.SE3 | None) -> Prediction:
    """Apply a motion of the prior's world to a prediction; None changes nothing.

    It comes of relocalization, so that how sure the prior is of its poses in its own world says little of them here.
    """
    if motion is None:
        return prediction
    views = [motion @ pose_row(prediction.T_world_views, row) for row in range(3)]
    views = jaxlie.SE3(jnp.stack([view.wxyz_xyz for view in views]))
    unknown = jnp.full_like(prediction.pose_covariance, jnp.nan)
    anchor = motion @ prediction.T_world_anchor
    return replace(prediction, T_world_views=views, T_world_anchor=anchor, pose_covariance=unknown)
