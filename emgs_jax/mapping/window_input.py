"""Inputs of a run, window by window: read, predict and convert frames when they are needed."""

from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from emgs_jax.back_end.factors import FrameData
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.device.clock import Clock, Timer
from emgs_jax.loop_closure.prior_query import JointPrediction, PriorQuery
from emgs_jax.mapping.convert import FirstWindow, opening, to_first_window, to_prediction
from emgs_jax.observation import Prediction
from emgs_jax.ops.ranges import MAX_LENGTH_M
from emgs_jax.prior.base import Prior, PriorPrediction, calls_of, check_unit, visits, with_frames
from emgs_jax.slam import SlamConfig


class RawView(NamedTuple):
    """Raw prediction of a frame: points (h, w, 3), camera frame, and the mask of those that are confident enough.

    The mapping also leaves out points without a normal. `num_left_out` counts predictions that are no points: not
    finite, behind the camera, or farther than a map can hold.
    """

    points: np.ndarray
    mask: np.ndarray
    image: np.ndarray
    T_world_camera: np.ndarray  # that of the previous frame if the prior has none
    features: np.ndarray  # (y, x, f), a grid that covers the image
    num_left_out: int = 0


@dataclass(frozen=True)
class WindowInput:
    """One input of a run: a frame or several, with their prediction.

    Args:
        frames: one, or several if the map is made from all of them.
        prediction: views that the map starts from, or the prediction of a step; None if no map can start yet.
        T_world_anchor: known pose of the first frame; NaN if the inference is not related to it.
        T_anchor_views: predicted pose of every view of the window, by frame index.
        seconds: of the conversion.
        world: number of the world of `T_anchor_views`, see `PriorPrediction`; 0: that of the first frame. In any other
            world `prediction` has no pose, because the camera's pose in the map is unknown.
        adjusted: poses of earlier frames that the prior has changed, see `PriorPrediction`.
    """

    frames: tuple[Frame, ...]
    raw: tuple[RawView, ...]
    prediction: FirstWindow | Prediction | None
    T_world_anchor: np.ndarray
    T_anchor_views: Mapping[int, np.ndarray]
    seconds: Mapping[str, float]
    world: int = 0
    adjusted: Mapping[int, np.ndarray] = field(default_factory=dict)

    @property
    def data(self) -> list[FrameData]:
        """Parts of a frame that the back end needs."""
        return [
            FrameData(frame.index, frame.image, raw.points, raw.mask, self.T_anchor_views, world=self.world)
            for frame, raw in zip(self.frames, self.raw, strict=True)
        ]


def window_inputs(
    dataset: Dataset, prior: Prior, config: SlamConfig, clock: Clock | None = None
) -> Iterator[WindowInput]:
    """Yield all inputs of a sequence: frames from which no map can start, the first window, then steps.

    The pose of the first frame is the true one if known, otherwise the identity.

    Raises:
        ValueError: no frame has points and a pose from which a map can start, or the thresholds do not suit the unit of
            the predictions.
    """
    done: dict[int, np.ndarray] = {}  # raw poses
    is_started, clock, world, known = False, clock or Clock(), 0, set()
    for prediction, frames in predictions(dataset, prior, config.window_size, clock):
        check_unit(prediction)
        here = {index for index, pose in _poses(prediction).items() if np.isfinite(pose).all()}
        world += bool(is_started and known and here and not here & known)
        known = here or known
        world = world if prediction.world is None else prediction.world
        with clock.phase("map"):
            anchor = first_pose(frames)
            raw = _raw_views(prediction, frames, anchor, world, done, config)
            convert = _step if is_started else _opening
            known_anchor = np.full((4, 4), np.nan) if world else anchor
            found = convert(PredictedWindow(prediction, frames, known_anchor, raw, world), config, Timer(clock))
        yield from found
        done |= {index: view.T_world_camera for index, view in raw.items()}
        is_started = found[-1].prediction is not None
    if not is_started:
        raise ValueError(
            f"none of the {len(done)} frames of {dataset.name} {dataset.sequence} has a valid point and a "
            "pose, so there is nothing to start a map from: take frames farther apart or closer together "
            "(dataset.stride=...), larger images (dataset.size=...) or another prior"
        )


def predictions(
    dataset: Dataset, prior: Prior, window_size: int, clock: Clock
) -> Iterator[tuple[PriorPrediction, dict[int, Frame]]]:
    """Predict window by window; read a frame when a window needs it, and drop it when none does."""
    calls = calls_of(prior, dataset, window_size)
    for window, frames in clock.each("load", with_frames(calls, dataset)):
        with clock.phase("predict"):
            prediction = prior.predict(window, list(frames.values()), dataset.intrinsics)
        yield prediction, frames


def first_pose(frames: Mapping[int, Frame]) -> np.ndarray:
    """Return T_world_camera of the anchor, (4, 4) float64; the identity if the truth is unknown."""
    truth = frames[0].T_world_camera
    return np.eye(4) if truth is None else np.asarray(truth, np.float64)


class PredictedWindow(NamedTuple):
    """A window's prediction, its frames, the anchor's pose or NaN, raw views of new frames, and the world's number."""

    prediction: PriorPrediction
    frames: Mapping[int, Frame]
    T_world_anchor: np.ndarray
    raw: Mapping[int, RawView]
    world: int

    def input(
        self, indices: Sequence[int], prediction: FirstWindow | Prediction | None, seconds: Mapping[str, float] = {}
    ) -> WindowInput:
        """Make an input of some of its frames."""
        frames, raw = (tuple(values[index] for index in indices) for values in (self.frames, self.raw))
        poses, adjusted = _poses(self.prediction), self.prediction.adjusted
        return WindowInput(frames, raw, prediction, self.T_world_anchor, poses, seconds, self.world, adjusted)


def _step(window: PredictedWindow, config: SlamConfig, timer: Timer) -> list[WindowInput]:
    """Convert the current frame to the input of a step."""
    step = to_prediction(*window[:3], config.observation)
    return [window.input([window.prediction.window.current], step, timer.read())]


def _opening(window: PredictedWindow, config: SlamConfig, timer: Timer) -> list[WindowInput]:
    """Convert the frames before a map can start, the first window, and the steps from the same window."""
    views, usable = to_first_window(*window[:3], config.observation, since=min(window.raw))
    found = [window.input([index], None) for index in window.raw if not usable or index < usable[0]]
    if views is None:
        return found
    first, steps = opening(views, config)
    count = len(usable) - len(steps)  # views that the map is made from
    found.append(window.input(usable[:count], first, timer.read()))
    return found + [window.input([index], step) for index, step in zip(usable[count:], steps, strict=True)]


def _poses(prediction: PriorPrediction) -> dict[int, np.ndarray]:
    return dict(zip(prediction.window.views, prediction.T_anchor_view, strict=True))


def _raw_views(
    prediction: PriorPrediction,
    frames: Mapping[int, Frame],
    anchor: np.ndarray,
    world: int,
    done: dict[int, np.ndarray],
    config: SlamConfig,
) -> dict[int, RawView]:
    """Extract pose and points of each new frame as predicted; `done`: raw poses of earlier frames."""
    window, known, views = prediction.window, ChainMap({}, done), {}
    for row, index in enumerate(window.dense):
        if index in known:
            continue
        points, confidence = prediction.points[row], prediction.confidence[row]
        given = prediction.mask[row] & ~(confidence < float(config.observation.min_confidence))
        is_sound = (np.abs(points) < MAX_LENGTH_M).all(axis=-1) & (points[..., 2] > 0) & np.isfinite(confidence)
        mask = given & is_sound
        pose = anchor @ _poses(prediction)[index] if world == 0 else _pose_after(prediction, index, known)
        if not np.isfinite(pose).all():
            pose, mask = known.get(index - 1, anchor), np.zeros_like(mask)
        image, features = frames[index].image, prediction.features[row]
        views[index] = RawView(points, mask, image, pose, features, int(np.sum(given & ~is_sound)))
        known[index] = pose
    return views


def _pose_after(prediction: PriorPrediction, index: int, known: Mapping[int, np.ndarray]) -> np.ndarray:
    """Chain a pose to the last earlier frame with a pose in this prediction, which may be a placeholder.

    Without such a frame, return the pose of the previous frame; NaN if the prediction has no pose of this one.
    """
    poses = _poses(prediction)
    before = [other for other in poses if other in known and np.isfinite(poses[other]).all()]
    if not before:
        return known[index - 1] if np.isfinite(poses[index]).all() else poses[index]
    return known[before[-1]] @ np.linalg.inv(poses[before[-1]]) @ poses[index]


def make_prior_query(prior: Prior, dataset: Dataset, spacing: int, window_size: int, clock: Clock) -> PriorQuery:
    """Return a function with which a run's prior predicts both visits of a loop; it reads the frames again."""

    def query(a: int, b: int) -> JointPrediction | None:
        window = visits(a, b, spacing, window_size)
        with clock.phase("load"):
            frames = [dataset[index] for index in window.views]
        with clock.phase("predict"):
            found = prior.revisit(window, frames, dataset.intrinsics)
        if found is None:
            return None
        return JointPrediction(found.T_anchor_view[window.views.index(b)], tuple(found.points), tuple(found.mask))

    return query
