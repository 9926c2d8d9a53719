"""Data of the benchmark: the first frames of a data set, as a prior predicts them."""

import itertools
from dataclasses import dataclass

import jax
import jaxlie
import numpy as np
from omegaconf import DictConfig

from emgs_jax.config.configure import build, build_dataset, build_prior
from emgs_jax.device.clock import Clock
from emgs_jax.mapping.capacity import start
from emgs_jax.mapping.convert import FirstWindow, to_camera, to_first_window, to_prediction
from emgs_jax.mapping.window_input import first_pose, predictions
from emgs_jax.observation import Observation, Prediction
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import PriorPrediction
from emgs_jax.slam import SlamConfig, SlamState


@dataclass(frozen=True)
class Data:
    """The first window and the step after it, with the arrays that they come from.

    Args:
        camera: of the full images.
        raw: the prior's answer to the first window.
        images: (views, h, w, 3), of the first window.
        true_poses: T_world_camera (views, 4, 4) of the first window.
    """

    camera: Camera
    config: SlamConfig
    raw: PriorPrediction
    images: np.ndarray
    first: FirstWindow
    prediction: Prediction
    true_poses: np.ndarray


def load(config: DictConfig) -> Data:
    """The data of a config. Raises ValueError where frames are missing."""
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)
    slam = build(config, "slam")
    calls = list(itertools.islice(predictions(dataset, prior, slam.window_size, Clock()), 2))
    frames = calls[0][1] if calls else {}
    if len(calls) < 2 or any(frames[row].T_world_camera is None for row in range(slam.window_size)):
        raise ValueError(
            f"the benchmark needs {slam.window_size + 1} frames with true poses, {dataset.name} {dataset.sequence} has "
            f"{len(dataset)} frames: use dataset=synthetic"
        )
    anchor = first_pose(frames)
    shown = [frames[row] for row in calls[0][0].window.dense]
    return Data(
        camera=to_camera(dataset),
        config=slam,
        raw=calls[0][0],
        images=np.stack([frame.image for frame in shown]),
        first=to_first_window(*calls[0], anchor, slam.observation)[0],
        prediction=to_prediction(*calls[1], anchor, slam.observation),
        true_poses=np.stack([frame.T_world_camera for frame in shown]),
    )


def first_state(data: Data) -> tuple[SlamState, SlamConfig]:
    """The map of all views of the first window."""
    return start(data.first, data.camera, data.config)


def view(data: Data, row: int) -> tuple[jaxlie.SE3, Observation]:
    """One view of the first window: the prior's pose, and the points in the camera's frame."""
    return jax.tree.map(lambda leaf: leaf[row], (data.first.T_world_views, data.first.views))
