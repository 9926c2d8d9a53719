"""Interface of a prior: it predicts the poses of a window of images, and dense geometry of some of them."""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from emgs_jax.data.base import Dataset, Frame

SCALE_STD_KEY = "prior/scale_std_percent"  # in a report: how sure the metre is
# In a report: up in the axes of a frame's camera, and the frame's index in the data set, as in frames.jsonl.
UP_KEYS = "prior/up_x", "prior/up_y", "prior/up_z", "prior/up_frame"


@dataclass(frozen=True)
class Window:
    """One call of the prior (Method A): the anchor, the FIFO from oldest to newest, the current and newer images.

    Args:
        inference: number of the call, from 0.
        views: frame indices in the model's order; `views[0]` is the anchor (frame 0).
        dense: frame indices whose geometry is needed: in the first window all up to the current one, then (previous,
            current).
        current: the frame that this call integrates; in the first window the last of `dense`.
    """

    inference: int
    views: tuple[int, ...]
    dense: tuple[int, ...]
    current: int


@dataclass(frozen=True)
class PriorPrediction:
    """A prior's prediction of a window; poses are in the frame of view 0, points in each view's own camera.

    If the prior has lost view 0, its pose is NaN, and the other poses are in a frame of their own. That frame stays the
    same as long as two predictions in a row (without those that have no pose) have a pose for the same view.

    Args:
        T_anchor_view: camera -> camera of view 0, OpenCV axes, metres, float64 (v, 4, 4), NaN where unknown; the first
            is the identity or NaN.
        points: camera-frame points, metres, float32 (d, h, w, 3), rows as in `window.dense`; 0 where the mask is off.
        confidence: float32 (d, h, w), at least 1; higher is better.
        mask: bool (d, h, w), True where the point can be used.
        features: text-aligned unit features (d, y, x, f), float16, on a grid of y by x cells that cover the image (a
            patch or a pixel each); 0 where there is none, f = 0 without features.
        pose_covariance: float64 (v, 6, 6), of ξ where the true T_anchor_view is T_anchor_view Exp(ξ), translation (unit
            of the prediction) before rotation (rad), in the view's axes. An error that the views before share, of which
            the map is made, does not count. NaN for an unknown view; None: the prior does not tell, and the map
            estimates it. Poses with a covariance lie in one world: the scale of a frame's depths does not move them.
        scale_std: standard deviation of the log of a common factor of the current frame's depths, in the poses' unit; 0
            if they are triangulated from these poses. None: the prior does not tell. Needs `pose_covariance`.
        world: number of the poses' frame of reference, 0 for the first, which may come back. None: a new one begins
            where no view has a pose as before.
        adjusted: T_anchor_view (4, 4), in world 0, of frames before the current one whose poses are other ones than
            when they were predicted: the map follows. Only of priors with `adjusts_poses`.
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
    adjusted: Mapping[int, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Provenance:
    """Origin of predictions, which is written into every result and recording."""

    name: str
    settings: dict = field(default_factory=dict)
    is_simulated: bool = False


class Prior(ABC):
    """Predicts geometry from a window of frames: a subclass needs `provenance` and a deterministic `predict`."""

    provenance: Provenance
    feature_names: tuple[str, ...] = ()  # classes that `text_features` describes
    # (classes, f) unit embeddings, comparable with `PriorPrediction.features`
    text_features: np.ndarray = np.zeros((0, 0), np.float32)
    adjusts_poses: bool = False  # later predictions change poses of earlier ones, see `PriorPrediction.adjusted`

    @abstractmethod
    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict for `frames`, in the order of `window.views`."""

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        """Predict for views of two visits of a place, see `visits`; None if unknown.

        The answer refuses a loop that it does not fit, so it must not follow from the poses of the path between the
        visits. A prior with one path for all windows has none: the loop that it refuses is the one that corrects it.
        """
        return self.predict(window, frames, intrinsics)

    def num_newer(self, window_size: int) -> int:
        """Number of images after the current one in a window, see `windows`; live frames are mapped that much later."""
        return 1

    def num_first(self, window_size: int) -> int:
        """Number of images in the first window, which a camera must have given before anything is mapped."""
        return window_size

    def check(self, dataset: Dataset, window_size: int) -> None:  # noqa: B027 (most can answer for any data set)
        """Raise ValueError if the prior cannot predict for the data set."""

    def keep(self, folder: Path) -> None:  # noqa: B027 (most have nothing to keep)
        """Store what the predictions depend on in the folder of a run, or load it from there."""

    @property
    def metre(self) -> float:
        """A metre of the settings, such as the floor of covariances, in the unit of the predictions, after `keep`.

        1 unless the predictions are in a unit in which scenes look much nearer or farther than rooms do.
        """
        return 1.0

    def report(self) -> dict[str, float]:
        """Statistics of the predictions so far, as keys `prior/…`."""
        return {}


MEDIAN_DEPTHS = 0.01, 200.0  # rooms have some metres, scenes in a unit of a network's own about 1
USUAL_DEPTH = 2.0


def check_unit(prediction: PriorPrediction) -> None:
    """Raise ValueError, with a factor that helps, if depths are too large or too small for metres.

    A map's thresholds are lengths. A prior without a unit normalises its lengths, as `prior.scale=arbitrary` of files.
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


def windows(
    has: Callable[[int], bool], window_size: int, num_newer: int = 1, num_first: int | None = None
) -> Iterator[Window]:
    """Yield the calls of a sequence: one that fills the FIFO, then one for each further frame.

    A window has the anchor, the current image, `num_newer` after it (fewer at the end) and those before it, at most
    `window_size` + 2 in all, each once. More newer images give the same windows with an older current image.

    Args:
        has: whether there is a frame of this index, see `Dataset.has`; it may wait for a camera.
        num_first: images of the first call; None: `window_size`.
    """
    if not isinstance(window_size, int) or window_size < 1:
        raise ValueError(f"slam.window_size must be a whole number of images, 1 or more, got {window_size}")
    if not 0 <= num_newer <= window_size:
        raise ValueError(f"a window of {window_size} images cannot have {num_newer} after the current one")
    first = tuple(itertools.takewhile(has, range(window_size if num_first is None else num_first)))
    dense = first[: max(len(first) - max(num_newer, 1) + 1, 1)]
    if first:
        yield Window(0, first, dense, dense[-1])
    for inference, current in enumerate(itertools.takewhile(has, itertools.count(len(dense))), start=1):
        newer = range(current + 1, current + num_newer + 1)
        newest = next((index for index in newer if not has(index)), current + num_newer)
        recent = [index for index in range(max(newest - window_size - 1, 0), newest + 1) if has(index)]
        yield Window(inference, tuple(dict.fromkeys((0, *recent))), (current - 1, current), current)


def calls_of(prior: Prior, dataset: Dataset, window_size: int) -> Iterator[Window]:
    """Yield the calls of a prior for a data set, see `windows`."""
    return windows(dataset.has, window_size, prior.num_newer(window_size), prior.num_first(window_size))


def visits(a: int, b: int, spacing: int, window_size: int) -> Window:
    """The call for two visits of a place: the anchor a and the later frame b, with frames `spacing` beside them.

    No view is later than b. The number is that of the step that integrates b, of a prior that sees one newer image.
    """
    views = [index for index in (a, a - spacing, a + spacing, b - spacing, b) if 0 <= index <= b]
    return Window(max(b - window_size + 1, 0), tuple(dict.fromkeys(views)), (a, b), b)


def with_frames(calls: Iterable[Window], dataset: Dataset) -> Iterator[tuple[Window, dict[int, Frame]]]:
    """Yield each window with its frames; a frame is kept while consecutive windows need it."""
    frames: dict[int, Frame] = {}
    for window in calls:
        frames = {index: frames[index] if index in frames else dataset[index] for index in window.views}
        yield window, frames


def check_order(window: Window, frames: Sequence[Frame]) -> None:
    """Raise ValueError unless `frames` are those of `window.views`."""
    indices = tuple(frame.index for frame in frames)
    if indices != window.views:
        raise ValueError(f"frames must be those of window.views {window.views} in that order, got {indices}")


DenseView = tuple[np.ndarray, np.ndarray, np.ndarray]  # points (h, w, 3), confidence and mask (h, w)


def no_points(size: Sequence[int]) -> DenseView:
    """A view of (width, height) without a valid point."""
    shape = size[1], size[0]
    return np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32), np.zeros(shape, bool)


def predicted(
    window: Window, T_anchor_view: np.ndarray, dense: Sequence[DenseView], features: np.ndarray | None = None, **known
) -> PriorPrediction:
    points, confidence, mask = (np.stack(parts) for parts in zip(*dense, strict=True))
    features = np.zeros((*mask.shape, 0), np.float16) if features is None else features
    return PriorPrediction(window, T_anchor_view, points, confidence, mask, features, **known)


def equal_covariances(pose_std: Sequence[float] | None, T_anchor_view: np.ndarray) -> np.ndarray | None:
    """Covariances of poses with the same standard deviations (length, degrees) along every axis; None without."""
    if pose_std is None:
        return None
    length, degrees = pose_std
    covariance = np.diag(np.repeat([float(length), np.radians(degrees)], 3) ** 2)
    is_known = np.isfinite(T_anchor_view).all((1, 2))[:, None, None]
    return np.where(is_known, covariance, np.nan)


def check_pose_std(pose_std: Sequence[float] | None) -> tuple[float, float] | None:
    """Check the key `prior.pose_std`: a length and an angle, or None."""
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
    """Poses (v, 4, 4) relative to the first, float64; the first is exactly the identity."""
    poses = np.asarray(T_reference_view, np.float64)
    relative = np.linalg.inv(poses[0]) @ poses
    relative[0] = np.eye(4)
    return relative
