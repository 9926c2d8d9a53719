"""The prior `multiview_stereo`: classical geometry from calibrated images, without weights and without a GPU.

Structure from motion of the window gives the poses; a plane sweep against some of the other views the depth, and the
matches on a blank region its plane (`swept.py`), or a network whose weights the user has the depth (`learned.py`). What
was found for an image (keypoints, matches, depth) is kept while the image is in the window, so the windows of a
sequence must be asked for in order. The current image is in the middle of its window, so its depth is matched, and
compared with that of other views, on both sides. The confidence of a depth is 1 + the probability that it is right
(`confidence.py`): 1 where nothing is known.

The frame is that of the first image that could be placed (image 0, unless the camera rests at first), and the scale
that of its window, which is fixed by `median_depth`; images alone do not tell it. The radial distortion of the lens is
measured until the first key view goes: points lie on the rays of the lens as it is known, not on those of the pinhole.

Where the camera has lost all that the structure knows, the newest views begin another one, with a frame and a scale of
its own. What is known of the views before is of no use then: they have no pose any more, the anchor included.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.io.files import jsonable
from emgs_jax.keypoints.poses import calibration
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import Prior, PriorPrediction, Provenance, Window
from emgs_jax.prior.multiview.confidence import probability
from emgs_jax.prior.multiview.dense import DenseConfig, Matched, Stereo
from emgs_jax.prior.multiview.depth import agreement
from emgs_jax.prior.multiview.incremental import StructureConfig, at_size, extend
from emgs_jax.prior.multiview.initialization import begin_again, initialize
from emgs_jax.prior.multiview.keys import kept, key_views
from emgs_jax.prior.multiview.landmarks import Structure, confirmed, detect, forget, link
from emgs_jax.prior.multiview.learned import LearnedConfig, learned
from emgs_jax.prior.multiview.lens import as_shown, points_shown, straight
from emgs_jax.prior.multiview.sources import choose, parallax
from emgs_jax.prior.multiview.swept import SweptConfig, swept

jitted_agreement = eqx.filter_jit(agreement)


def stereo_of(config: SweptConfig | LearnedConfig) -> Stereo:
    """The way to a view's depth that a config is for."""
    return learned(config) if isinstance(config, LearnedConfig) else swept(config)


def _values(config: StructureConfig | DenseConfig) -> dict:
    """Return the values of a config as JSON holds them: a device's .1 is .1 again, and infinity is null."""
    given = jax.tree.map(lambda v: float(str(np.float32(v))) if isinstance(v, jax.Array) else v, asdict(config))
    return jsonable(given)


def tried_depths(z: np.ndarray, margin: float) -> np.ndarray:
    """The nearest and the farthest depth that is tried: of all landmarks but a hundredth at either end, and a margin.

    Args:
        z: depths of those that a view shows, m.
        margin: factor by which the range goes beyond theirs.
    """
    return np.float32([np.percentile(z, 1) / margin, np.percentile(z, 99) * margin])


class MultiviewStereo(Prior):
    """Structure from motion and stereo of a sliding window.

    Args:
        structure: poses and landmarks.
        dense: depth.
    """

    is_sequential = True  # a window needs those before it

    def __init__(self, structure: StructureConfig, dense: SweptConfig | LearnedConfig) -> None:
        self._given, self._dense_config, self._stereo = structure, dense, stereo_of(dense)
        settings = {"structure": _values(structure), "dense": _values(dense)}
        settings["dense"].pop("checkpoint", None)  # its digest says which it is, wherever it lies
        self.provenance = Provenance("multiview_stereo", {"version": 9} | settings)
        self._next = 0
        self._structure = Structure(np.eye(3))

    def num_newer(self, window_size: int) -> int:
        """Half of the window, so that a depth is matched with views on both sides: a third of it and what checks it."""
        return max(window_size // 2, 1)

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Raise ValueError where a window has too few images to confirm a depth."""
        confidence = self._dense_config.confidence
        best = max(confidence.photo) * np.array(confidence.geo)
        least = 1 + max(int(np.sum(best < self._dense_config.min_probability)), 1)
        if window_size < least:
            raise ValueError(f"multiview_stereo compares at least {least} images, got slam.window_size={window_size}")

    def report(self) -> dict[str, float]:
        """`prior/distortion`: k of the lens, as it was measured."""
        return {"prior/distortion": self._structure.distortion}

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Poses of all views and depth of `window.dense`; a view that cannot be placed has NaN and no valid point."""
        if window.inference == 0:
            self._begin(frames, intrinsics)
        elif window.inference != self._next:
            raise ValueError(
                f"multiview_stereo carries its landmarks from window to window: expected window {self._next}, got "
                f"{window.inference}; ask for all windows in order"
            )
        self._next = window.inference + 1
        self._forget(window)
        for frame in frames:
            if frame.index >= self._oldest and frame.index not in self._structure.views:
                self._add(frame)
        self._place_views(window.current)
        return self._answer(window)

    def _begin(self, frames: Sequence[Frame], intrinsics: Sequence[float]) -> None:
        height, width = frames[0].image.shape[:2]
        focal, center = np.float32(intrinsics[:2]), np.float32(intrinsics[2:])
        self._camera = Camera(focal, center, width, height)
        self._structure_config = at_size(self._given, width, height)
        self._structure = Structure(calibration(intrinsics))
        self._has_begun = False
        self._oldest = 0  # view of this structure
        self._images: dict[int, np.ndarray] = {}
        self._prepared: dict[int, Any] = {}
        self._depths: dict[int, np.ndarray] = {}
        self._spreads: dict[int, np.ndarray] = {}
        # A later window sees the anchor, the FIFO, the current and the newest image.
        self._num_views = len(frames) + 3

    def _place_views(self, current: int) -> None:
        given, distortion = (self._camera, self._num_views, self._structure_config), self._structure.distortion
        if self._has_begun:
            extend(self._structure, *given)
            other = begin_again(self._structure, current, *given)
            if other is not None:
                self._structure, self._oldest = other, min(other.views)
        elif initialize(self._structure, *given):
            self._has_begun = True
        if self._structure.distortion != distortion:
            self._prepared.clear()

    def _forget(self, window: Window) -> None:
        config = self._structure_config.keys
        keys = key_views(self._structure, window.views, self._camera.width, config)
        stays = {*window.views, *kept(self._structure, keys, config)}
        self._structure.is_lens_known |= len(keys) > config.max_keys
        gone = [frame for frame in self._structure.views if frame not in stays]
        forget(self._structure, gone, self._structure_config.matching)
        for known in (self._images, self._prepared, self._depths, self._spreads):
            for frame in [frame for frame in known if frame not in stays]:
                del known[frame]

    def _add(self, frame: Frame) -> None:
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        if gray.shape != (self._camera.height, self._camera.width):
            raise ValueError(
                f"{frame.name} has size {gray.shape[::-1]}, the window's first image "
                f"{(self._camera.width, self._camera.height)}: give dataset.size=[width,height]"
            )
        view, lens = detect(gray, self._structure_config.matching), self._structure.lens()
        view.pixels = straight(view.pixels, lens)
        self._images[frame.index] = frame.image
        self._structure.views[frame.index] = view
        link(self._structure, frame.index, self._structure_config.matching)

    def _answer(self, window: Window) -> PriorPrediction:
        placed, lens = self._structure.placed(), self._structure.lens()
        ahead = range(window.current + 1, (window.current + window.views[-1]) // 2 + 1)  # which confirm it
        for frame in (*window.dense, *ahead):
            if frame not in self._depths or not self._depths[frame].any():  # it may have been placed since
                self._depths[frame], self._spreads[frame] = self._depth(frame)
        confidence = np.stack([as_shown(self._confidence(frame), lens) for frame in window.dense])
        confidence = np.maximum(confidence, 1.0)
        depth = np.stack([as_shown(self._depths[frame], lens) for frame in window.dense])
        mask = (depth > 0) & (confidence >= 1.0 + self._dense_config.min_probability)
        points = points_shown(np.where(mask, depth, 0.0), lens).astype(np.float32)
        features = np.zeros((*mask.shape, 0), np.float16)
        T_anchor_view = np.full((len(window.views), 4, 4), np.nan)
        if self._oldest <= window.views[0]:
            T_anchor_view[0] = np.eye(4)  # also where it is not known
        for row, frame in enumerate(window.views[1:], start=1):
            if frame in placed:
                T_anchor_view[row] = placed[frame].T_ref_view
        return PriorPrediction(window, T_anchor_view, points, confidence, mask, features)

    def _depth(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Depth (h, w) of a view, 0 where it is not known, and its spread."""
        view, nothing = self._structure.views[frame], np.zeros(self._images[frame].shape[:2], np.float32)
        sources = self._sources(frame)
        if not sources:
            return nothing, nothing
        max_error = self._structure_config.matching.max_reprojection_error
        views = [self._structure.views[other] for other in sources]
        points = self._structure.points[confirmed(self._structure, view, views, max_error)]
        z = (points - view.T_ref_view[:3, 3]) @ view.T_ref_view[:3, 2]
        z = z[z > 0]
        if not len(z):
            return nothing, nothing
        count = self._dense_config.num_sources
        is_used = np.arange(count) < len(sources)
        sources = (sources * count)[:count]
        matched = Matched(
            self._view(frame),
            [self._view(other) for other in sources],
            self._relative(sources, frame),
            is_used,
            tried_depths(z, self._dense_config.depth_margin),
            self._camera,
        )
        return self._stereo.estimate(matched)

    def _view(self, frame: int) -> Any:
        """Return what the way to a depth keeps of an image; made anew when the lens is known better."""
        if frame not in self._prepared:
            self._prepared[frame] = self._stereo.prepare(self._images[frame], self._structure.lens())
        return self._prepared[frame]

    def _sources(self, frame: int) -> list[int]:
        """The placed views that together show the view's landmarks under most parallax, best first."""
        view, placed = self._structure.views[frame], self._structure.placed()
        if frame not in placed:
            return []
        landmarks = view.landmark[self._structure.known(view)]
        points, center = self._structure.points[landmarks], view.T_ref_view[:3, 3]
        best = self._dense_config.best_parallax_rad
        worth = {
            index: np.isin(landmarks, other.landmark)
            * np.minimum(parallax(points, center, other.T_ref_view[:3, 3]) / best, 1.0)
            for index, other in placed.items()
            if index != frame
        }
        return choose(worth, self._dense_config.num_sources)

    def _confidence(self, frame: int) -> np.ndarray:
        """One more than the probability that each depth is right."""
        placed, count = self._structure.placed(), self._dense_config.num_checks
        others = sorted((o for o in self._depths if o in placed and o != frame), key=lambda o: abs(o - frame))[:count]
        if frame not in placed or not others:
            return np.ones_like(self._depths[frame])
        maps = np.zeros((count, *self._depths[frame].shape), np.float32)
        maps[: len(others)] = [self._depths[other] for other in others]
        others = (others * count)[:count]
        agreed = jitted_agreement(
            jnp.asarray(self._depths[frame]),
            jnp.asarray(maps),
            self._relative(others, frame),
            self._camera,
            jnp.float32(self._dense_config.depth_step),
        )
        return 1.0 + probability(self._spreads[frame], np.asarray(agreed), self._dense_config.confidence)

    def _relative(self, others: Sequence[int], frame: int) -> jaxlie.SE3:
        """T_other_frame of several views."""
        views = self._structure.views
        T = [np.linalg.inv(views[other].T_ref_view) @ views[frame].T_ref_view for other in others]
        return jaxlie.SE3.from_matrix(jnp.asarray(np.stack(T), jnp.float32))
