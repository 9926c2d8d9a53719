"""Convert a prior's prediction on the host to the arrays of a step, with all checks of the input."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jaxlie
import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.device.arrays import on_device, to_se3
from emgs_jax.geometry import seen_from
from emgs_jax.observation import Observation, ObservationConfig, Prediction, observe
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import PriorPrediction
from emgs_jax.slam import SlamConfig

_observe = eqx.filter_jit(observe)


class FirstWindow(eqx.Module):
    """The first prediction of a sequence: all views in camera frames, oldest first, with the prior's poses.

    Args:
        pose_covariance: (n, 2, 6, 6), see `Prediction`.
        scale_std: (n,), likewise.
    """

    views: Observation
    T_world_views: jaxlie.SE3
    pose_covariance: jax.Array
    scale_std: jax.Array


def to_camera(dataset: Dataset) -> Camera:
    """Make the camera of a data set's frames."""
    fx, fy, cx, cy = dataset.intrinsics
    return Camera((fx, fy), (cx, cy), *dataset.size)


def _check(prediction: PriorPrediction, frames: Mapping[int, Frame]) -> None:
    height, width = frames[prediction.window.current].image.shape[:2]
    expected = len(prediction.window.dense), height, width
    for name, got in (
        ("points", prediction.points.shape[:-1]),
        ("confidence", prediction.confidence.shape),
        ("mask", prediction.mask.shape),
    ):
        if got != expected:
            raise ValueError(
                f"the prior's {name} have shape {got} at frame {prediction.window.current}, expected {expected} "
                "(dense views, height, width): predict at the data set's size"
            )
    _check_covariance(prediction)
    if prediction.features.ndim != 4 or len(prediction.features) != expected[0]:
        raise ValueError(
            f"the prior's features have shape {prediction.features.shape} at frame {prediction.window.current}, "
            f"expected ({expected[0]}, rows, columns, width): a grid that covers the image of each dense view"
        )


def _check_covariance(prediction: PriorPrediction) -> None:
    covariance, window, scale_std = prediction.pose_covariance, prediction.window, prediction.scale_std
    if scale_std is not None and not scale_std >= 0:
        raise ValueError(
            f"the prior's scale_std at frame {window.current} must be a number from 0, got {scale_std}: give None "
            "where nothing is known"
        )
    if covariance is None:
        return
    known = covariance[np.isfinite(covariance).all((-2, -1))] if covariance.ndim == 3 else covariance
    is_sound = covariance.shape == (len(window.views), 6, 6)
    if is_sound and len(known):
        variances = np.diagonal(known, axis1=1, axis2=2)
        std = np.sqrt(np.where(variances > 0, variances, 1.0))
        known = known / std[:, None] / std[:, :, None]  # metres and radians round differently
        is_sound = np.abs(known - known.mT).max() <= 1e-6 and np.linalg.eigvalsh(known).min() >= -1e-6
    if not is_sound:
        raise ValueError(
            f"the prior's pose_covariance at frame {window.current}, of shape {covariance.shape}, must be "
            f"({len(window.views)}, 6, 6): symmetric matrices without negative variances, NaN where nothing is known"
        )


def _observation(prediction: PriorPrediction, view: int, frame: Frame, config: ObservationConfig) -> Observation:
    image, mask = frame.image * np.float32(1.0 / 255.0), np.asarray(prediction.mask[view])
    points, features, confidence = (
        np.asarray(values[view], np.float32)
        for values in (prediction.points, prediction.features, prediction.confidence)
    )
    return _observe(*on_device((points, image, features, confidence, mask)), config)


def _pose_covariance(prediction: PriorPrediction, previous: int, current: int) -> np.ndarray:
    """Compute covariances (2, 6, 6) of the motion between two views and of the second one's pose; NaN if unknown.

    Neighbours share errors, so the motion is at least as certain as the two poses together.
    """
    if prediction.pose_covariance is None:
        return np.full((2, 6, 6), np.nan)
    before, here = prediction.pose_covariance[[previous, current]]
    T_previous, T_current = prediction.T_anchor_view[[previous, current]]
    return np.stack([here + seen_from(before, T_previous, T_current[None])[0], here])


def _scale_std(prediction: PriorPrediction) -> np.float32:
    return np.float32(np.nan if prediction.scale_std is None else prediction.scale_std)


def to_first_window(
    prediction: PriorPrediction,
    frames: Mapping[int, Frame],
    T_world_anchor: np.ndarray,
    config: ObservationConfig,
    since: int = 0,
) -> tuple[FirstWindow | None, tuple[int, ...]]:
    """Select the views from which a map can start: the dense ones, beginning with the first that has a pose and points.

    Args:
        T_world_anchor: known pose of the first frame, (4, 4).
        since: views of earlier frames are left out.

    Returns:
        The views and their frame indices; None and () without such a view. A later view may have no pose: integrated on
        its own, it is lost.

    Raises:
        ValueError: a shape differs from the images'.
    """
    _check(prediction, frames)
    rows = [row for row, index in enumerate(prediction.window.dense) if index >= since]
    dense = [prediction.window.dense[row] for row in rows]
    views = [_observation(prediction, row, frames[index], config) for row, index in zip(rows, dense, strict=True)]
    places = [prediction.window.views.index(i) for i in dense]
    poses = np.asarray(T_world_anchor) @ prediction.T_anchor_view[places]
    has_points = [np.asarray(view.valid).any() for view in views]
    usable = [bool(known) and np.isfinite(pose).all() for known, pose in zip(has_points, poses, strict=True)]
    if not any(usable):
        return None, ()
    first = usable.index(True)
    together = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(views[first:]))
    pairs = zip(places[first:][:1] + places[first:], places[first:], strict=False)
    covariances = np.stack([_pose_covariance(prediction, *pair) for pair in pairs]).astype(np.float32)
    known = on_device(covariances), on_device(np.full(len(covariances), _scale_std(prediction)))
    return FirstWindow(on_device(together), to_se3(poses[first:]), *known), tuple(dense[first:])


def to_prediction(
    prediction: PriorPrediction, frames: Mapping[int, Frame], T_world_anchor: np.ndarray, config: ObservationConfig
) -> Prediction:
    """Convert a prediction to the current and the previous view of a step.

    Args:
        prediction: dense in (previous, current).
        T_world_anchor: known pose of the first frame, (4, 4).

    Raises:
        ValueError: a shape differs from the images'.
    """
    _check(prediction, frames)
    views, (previous, current) = prediction.window.views, prediction.window.dense
    has_newest = current + 1 in views
    rows = [views.index(previous), views.index(current), views.index(current + 1 if has_newest else current)]
    return Prediction(
        current=_observation(prediction, 1, frames[current], config),
        previous=_observation(prediction, 0, frames[previous], config),
        T_world_views=to_se3(np.asarray(T_world_anchor) @ prediction.T_anchor_view[rows]),
        T_world_anchor=to_se3(T_world_anchor),
        pose_covariance=on_device(_pose_covariance(prediction, *rows[:2]).astype(np.float32)),
        scale_std=on_device(_scale_std(prediction)),
        has_newest=on_device(np.bool_(has_newest)),
        is_repeat=on_device(np.bool_(True)),
    )


def opening(window: FirstWindow, config: SlamConfig) -> tuple[FirstWindow, list[Prediction]]:
    """Split the first window into the views that initialize the map and the steps that follow from the same window.

    With `merged` initialization these are the whole window and no steps. With `incremental` they are the first view,
    and each further view as the current frame of a step. Consecutive views come from one inference, so the two
    predictions of the previous image agree exactly, and the coarse pose of a step is the prior's own.

    Raises:
        ValueError: `merged`, and a view has no pose.
    """
    if config.initialization == "merged":
        if not np.isfinite(np.asarray(window.T_world_views.wxyz_xyz)).all():
            raise ValueError(
                "a view of the first window has no pose, so its points cannot be merged: use "
                "slam.initialization=incremental, which leaves such a view out, or begin elsewhere (dataset.start=...)"
            )
        return window, []
    found: FirstWindow = jax.device_get(window)
    num_views, poses = len(found.views.valid), found.T_world_views.wxyz_xyz
    views = [on_device(jax.tree.map(lambda leaf, row=row: leaf[row], found.views)) for row in range(num_views)]
    following = [
        Prediction(
            current=views[i],
            previous=views[i - 1],
            T_world_views=jaxlie.SE3(on_device(poses[[i - 1, i, min(i + 1, num_views - 1)]])),
            T_world_anchor=jaxlie.SE3(on_device(poses[0])),
            pose_covariance=on_device(found.pose_covariance[i]),
            scale_std=on_device(found.scale_std[i]),
            has_newest=on_device(np.bool_(i + 1 < num_views)),
            is_repeat=on_device(np.bool_(False)),
        )
        for i in range(1, num_views)
    ]
    return on_device(jax.tree.map(lambda leaf: leaf[:1], found)), following
