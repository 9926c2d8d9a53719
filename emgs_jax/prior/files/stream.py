"""Depth and pose that come with each image: an RGB-D camera with odometry, a VIO, a network in another process.

They are read from the .npz beside the image (docs/predictions.md, our own layout): `Camera` writes what a source gives,
and a recorded folder has them. So a recording gives the same predictions again.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.prior.base import (
    DenseView,
    Prior,
    PriorPrediction,
    Provenance,
    Window,
    check_pose_std,
    equal_covariances,
    no_points,
    predicted,
    relative_poses,
)
from emgs_jax.prior.files.conventions import Sight, check_conventions, median_misfit
from emgs_jax.prior.files.own import own_pose, read_npz_view
from emgs_jax.prior.files.view import Camera, at_frame, whole_image

# Pairs of views that show another convention or unit, and those that show how well depths fit: as many as of files.
NUM_CLEAR, NUM_PAIRS = 2, 5
MOVED = 0.05  # from one of these views to the next: radians, or a share of the depth
SOURCE = "T_world_camera of the stream"


class Stream(Prior):
    """Depth in metres and T_world_camera, in `NAME.npz` beside the image `NAME.png`; NaN where the pose is not known.

    Args:
        max_depth_step: relative depth difference across which nothing is interpolated.
        pose_std: of every pose, (metres, degrees); None: the map finds out.
        max_misfit: largest median difference of the depths of two views, of the first `NUM_PAIRS`.
    """

    def __init__(
        self, max_depth_step: float = 0.03, pose_std: Sequence[float] | None = None, max_misfit: float = 0.1
    ) -> None:
        self._max_depth_step, self._max_misfit = float(max_depth_step), float(max_misfit)
        self._pose_std = check_pose_std(pose_std)
        self._poses: dict[int, np.ndarray] = {}  # of the last window, by frame
        self._points: dict[int, DenseView] = {}  # likewise
        self._dataset: Dataset | None = None  # that was checked
        self._first: list[Sight] | None = []  # views with a pose, until they are compared
        settings = {"scale": "metric", "max_depth_step": self._max_depth_step}
        self.provenance = Provenance("stream", settings | {"pose_std": self._pose_std and [*self._pose_std]})

    def num_newer(self, window_size: int) -> int:
        """None: a frame is mapped as soon as it is there."""
        return 0

    def num_first(self, window_size: int) -> int:
        """One, likewise."""
        return 1

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Raise ValueError unless depth and pose lie beside the first image."""
        if not (files := dataset.files(0)):
            raise ValueError(
                f"prior=stream needs images with a depth and a pose, and {dataset.name} has none of its own"
            )
        own_pose(_beside(files[0]))
        self._dataset = dataset

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        size = frames[0].image.shape[1::-1]
        camera, names = Camera((size[0], size[1]), intrinsics), {frame.index: Path(frame.name) for frame in frames}
        known, before, self._points = self._poses, self._points, {}
        self._poses = {i: known[i] if i in known else own_pose(_beside(names[i])) for i in window.views}
        poses = np.concatenate([*self._poses.values()])
        for index in window.dense:
            is_known = bool(np.isfinite(poses[window.views.index(index)]).all())
            self._points[index] = before.get(index) or self._at_frame(index, _beside(names[index]), camera, is_known)
        if self._first is not None:
            self._check_conventions(window, poses[window.views.index(window.current)], camera)
        T_anchor_view = relative_poses(poses) if np.isfinite(poses[0]).all() else poses
        covariance = equal_covariances(self._pose_std, T_anchor_view)
        return predicted(window, T_anchor_view, [*self._points.values()], pose_covariance=covariance)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> None:
        """Nothing: odometry that has drifted does not measure a loop."""

    def _at_frame(self, index: int, path: Path, camera: Camera, is_known: bool) -> DenseView:
        """Points, confidence and mask of a frame; none is valid without a pose."""
        if not is_known:
            return no_points(camera.size)
        stored = None if self._dataset is None else self._dataset.stored_pixels(index)
        return at_frame(read_npz_view(path), camera, whole_image, self._max_depth_step, stored)

    def _check_conventions(self, window: Window, pose: np.ndarray, camera: Camera) -> None:
        """Compare the first views with a pose that has moved from one to the next, once there are enough.

        Two alone would end a run by chance: depths of a network vary.
        """
        points, _, mask = self._points[window.current]
        if not np.isfinite(pose).all() or not mask.any():
            return
        if self._first:
            step = np.linalg.inv(self._first[-1].T_world_camera) @ pose
            angle = np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1))
            if np.linalg.norm(step[:3, 3]) < MOVED * np.median(points[..., 2][mask]) and angle < MOVED:
                return
        self._first = [*self._first, Sight(points, mask, pose)]
        pairs, intrinsics = [*itertools.pairwise(self._first)], camera.intrinsics
        if len(pairs) == NUM_CLEAR:
            tqdm.write(f"prior=stream: {check_conventions(pairs, intrinsics, SOURCE, np.inf)}")
        if len(pairs) == NUM_PAIRS:
            if median_misfit(pairs, intrinsics) > self._max_misfit:
                check_conventions(pairs, intrinsics, SOURCE, self._max_misfit)  # raises
            self._first = None


def _beside(image: Path) -> Path:
    """The file with what came with an image; ValueError if there is none."""
    path = image.with_suffix(".npz")
    if not path.is_file():
        raise ValueError(
            f"prior=stream: {path.name} is not beside {image}: it has the depth (h, w) in metres and T_world_camera "
            "(4, 4) of each image. For a camera without both choose another prior (docs/live.md)"
        )
    return path
