"""Interface of a prior: for a window of images, the pose of every view and dense geometry of some of them."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from emgs_jax.data.base import Dataset, Frame


@dataclass(frozen=True)
class Window:
    """One call of the prior (Method A): the anchor, the FIFO from oldest to newest, the current and newer images.

    Args:
        inference: number of the call, from 0.
        views: frame indices in the order that the model sees them; `views[0]` is the anchor (frame 0).
        dense: frame indices whose dense geometry the mapping needs: all views of the first window up to the current
            one, then (previous, current).
        current: the frame that this call integrates; in the first window the last of `dense`.
    """

    inference: int
    views: tuple[int, ...]
    dense: tuple[int, ...]
    current: int


@dataclass(frozen=True)
class PriorPrediction:
    """The answer of a prior to one window. Poses are in the frame of view 0, geometry in each view's own camera.

    A prior that has lost view 0 may still know how others are to each other. Then view 0 has no pose, and the frame of
    those that have one is the answer's own. It is the same from answer to answer as long as two in a row (answers
    without any pose left out) have a pose for the same view.

    Args:
        T_anchor_view: camera -> camera of view 0, OpenCV axes, metres, float64 (v, 4, 4), NaN where it is not known;
            the first is the identity, or NaN: then the others are camera -> a frame of their own.
        points: camera-frame points, metres, float32 (d, h, w, 3), rows as in `window.dense`; 0 where the mask is off.
        confidence: float32 (d, h, w), at least 1; higher is better.
        mask: bool (d, h, w), True where the point can be used.
        features: text-aligned unit features (d, y, x, f), float16, on a grid of y by x cells that cover the image, from
            one cell per patch of a network to one per pixel; 0 where there is none, f = 0 without features.
        pose_covariance: how sure the poses are: float64 (v, 6, 6), of ξ where the true T_anchor_view is
            T_anchor_view Exp(ξ), translation (unit of the prediction) before rotation (rad), in the axes of the view.
            What a view errs like those before it, of which the map is made, counts for nothing. NaN for a view of which
            nothing is known, None where the prior does not say: then the map finds out. Poses that are known lie in one
            world: the scale of a frame's depths does not move them.
        scale_std: how sure the scale of the current frame's depths is: of the logarithm of their common factor, in the
            unit of the poses. 0 where they are triangulated from these poses. None where the prior does not say; it
            counts only where `pose_covariance` is known.
        world: number of the frame of reference that the poses are in, of a prior that tells: 0 is that of the first
            frames with a pose, and it may come back. None: a new one begins where no view has a pose as before.
    """

    window: Window
    T_anchor_view: np.ndarray
    points: np.ndarray
    confidence: np.ndarray
    mask: np.ndarray
    features: np.ndarray
    pose_covariance: np.ndarray | None = None
    scale_std: float | None = None
    world: int | None = None


@dataclass(frozen=True)
class Provenance:
    """Origin of predictions; it is written into every result and every recorded file."""

    name: str
    settings: dict = field(default_factory=dict)
    is_simulated: bool = False


class Prior(ABC):
    """Anything that predicts geometry from a window of frames: a subclass has `provenance` and `predict`.

    `predict` is deterministic. What else callers ask for has the answer of a prior without it.

    Attributes:
        provenance: where its predictions come from.
        feature_names: classes that `text_features` describes; empty without features.
        text_features: (classes, f) unit embeddings comparable with `PriorPrediction.features`.
    """

    provenance: Provenance
    feature_names: tuple[str, ...] = ()
    text_features: np.ndarray = np.zeros((0, 0), np.float32)

    @abstractmethod
    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict for `frames`, which are in the order of `window.views`."""

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        """Predict for views of two visits of a place, see `visits`; None where that is not known."""
        return self.predict(window, frames, intrinsics)

    def num_newer(self, window_size: int) -> int:
        """Images after the current one that its windows have, see `windows`: a camera's frames are mapped so late."""
        return 1

    def check(self, dataset: Dataset, window_size: int) -> None:  # noqa: B027 (most can answer for any data set)
        """Raise ValueError where the prior cannot answer for the data set."""

    def keep(self, folder: Path) -> None:  # noqa: B027 (most have nothing to keep)
        """Keep in the folder of a run what the predictions rest on, and take it from there where it is."""

    def report(self) -> dict[str, float]:
        """Return the prior's own statistics of its predictions so far, as keys `prior/…`."""
        return {}


MEDIAN_DEPTHS = 0.01, 200.0  # rooms have some metres, scenes in a unit of a network's own about 1
USUAL_DEPTH = 2.0


def check_unit(prediction: PriorPrediction) -> None:
    """Raise ValueError where depths are so large or small that they can be no metres; says a factor that helps.

    A map's thresholds are lengths, so a prior has to have metres or a scene of some units. One that knows no unit
    normalises its lengths, as `prior=files` does with `scale=arbitrary`: then its own does not matter.
    """
    depths = prediction.points[..., 2][prediction.mask & np.isfinite(prediction.points).all(-1)]
    median = float(np.median(depths)) if len(depths) else USUAL_DEPTH
    if median > 0 and not MEDIAN_DEPTHS[0] <= median <= MEDIAN_DEPTHS[1]:
        factor = 10.0 ** round(np.log10(USUAL_DEPTH) - np.log10(median))
        raise ValueError(
            f"the prior's points have a median depth of {median:.4g} in its inference "
            f"{prediction.window.inference}, and a map's thresholds are for metres, or a unit in which a scene is some "
            f"units deep: multiply points and the translations of T_anchor_view by {factor:g} (.001 makes metres of "
            "millimetres, .01 of centimetres); prior=files prior.scale=arbitrary does so by itself"
        )


def windows(num_frames: int, window_size: int, num_newer: int = 1) -> Iterator[Window]:
    """Yield the calls of a sequence: one that fills the FIFO, then one for each further frame.

    A step sees the anchor, the current image, the `num_newer` after it, as far as the sequence has them, and those
    before it, `window_size` + 2 in all; an image is never listed twice. So with more newer images the windows are the
    same, and the current image is an older one of them; the last images of a sequence have fewer after them, and one
    less in all.
    """
    if not isinstance(window_size, int) or window_size < 1:
        raise ValueError(f"slam.window_size must be a whole number of images, 1 or more, got {window_size}")
    if not 1 <= num_newer <= window_size:
        raise ValueError(f"a window of {window_size} images cannot have {num_newer} after the current one")
    first = tuple(range(min(window_size, num_frames)))
    dense = first[: max(len(first) - num_newer + 1, 1)]
    if first:
        yield Window(0, first, dense, dense[-1])
    for inference, current in enumerate(range(len(dense), num_frames), start=1):
        newest = min(current + num_newer, num_frames)
        recent = range(max(newest - window_size - 1, 0), min(newest + 1, num_frames))
        yield Window(inference, tuple(dict.fromkeys((0, *recent))), (current - 1, current), current)


def visits(a: int, b: int, spacing: int, window_size: int) -> Window:
    """The call that shows two visits of a place together: frame a, which is the anchor, and b, which comes later.

    Beside them it has the frames `spacing` before and after a, and before b: none that is later than b. Its number is
    that of the step that integrates b, of a prior that sees one newer image.
    """
    views = [index for index in (a, a - spacing, a + spacing, b - spacing, b) if 0 <= index <= b]
    return Window(max(b - window_size + 1, 0), tuple(dict.fromkeys(views)), (a, b), b)


def with_frames(calls: Iterable[Window], dataset: Dataset) -> Iterator[tuple[Window, dict[int, Frame]]]:
    """Yield each window with its frames; one is read when a window needs it and dropped when the next does not."""
    frames: dict[int, Frame] = {}
    for window in calls:
        frames = {index: frames[index] if index in frames else dataset[index] for index in window.views}
        yield window, frames


def check_order(window: Window, frames: Sequence[Frame]) -> None:
    """Raise ValueError where `frames` are not those of `window.views`."""
    indices = tuple(frame.index for frame in frames)
    if indices != window.views:
        raise ValueError(f"frames must be those of window.views {window.views} in that order, got {indices}")


DenseView = tuple[np.ndarray, np.ndarray, np.ndarray]  # points (h, w, 3), confidence and mask (h, w)


def no_points(size: Sequence[int]) -> DenseView:
    """A view of (width, height) of which nothing is known."""
    shape = size[1], size[0]
    return np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32), np.zeros(shape, bool)


def predicted(
    window: Window, T_anchor_view: np.ndarray, dense: Sequence[DenseView], features: np.ndarray | None = None, **known
) -> PriorPrediction:
    """The answer with these dense views, and without features if there are none."""
    points, confidence, mask = (np.stack(parts) for parts in zip(*dense, strict=True))
    features = np.zeros((*mask.shape, 0), np.float16) if features is None else features
    return PriorPrediction(window, T_anchor_view, points, confidence, mask, features, **known)


def equal_covariances(pose_std: Sequence[float] | None, T_anchor_view: np.ndarray) -> np.ndarray | None:
    """Covariances of poses of which each errs by `pose_std`, a length and degrees, along every axis; None for none."""
    if pose_std is None:
        return None
    length, degrees = pose_std
    covariance = np.diag(np.repeat([float(length), np.radians(degrees)], 3) ** 2)
    is_known = np.isfinite(T_anchor_view).all((1, 2))[:, None, None]
    return np.where(is_known, covariance, np.nan)


def check_pose_std(pose_std: Sequence[float] | None) -> tuple[float, float] | None:
    """The key `prior.pose_std` as numbers; ValueError where it is no length and angle."""
    if pose_std is None:
        return None
    try:
        length, degrees = map(float, pose_std)
    except (TypeError, ValueError):
        length = degrees = np.nan
    if not (0 <= length < np.inf and 0 <= degrees <= 180):
        raise ValueError(f"prior.pose_std must be [length, degrees], both 0 or more, or null, got {pose_std}")
    return length, degrees


def relative_poses(T_reference_view: Sequence[np.ndarray]) -> np.ndarray:
    """Poses in the camera of view 0, float64 (v, 4, 4), of poses in any common frame; the first is the identity."""
    poses = np.asarray(T_reference_view, np.float64)
    relative = np.linalg.inv(poses[0]) @ poses
    relative[0] = np.eye(4)
    return relative
