"""The prior `multiview_stereo`: classical geometry from the images alone, without weights and without a GPU.

COLMAP finds the poses of all images at once (`structure/`); a plane sweep against some of the other views the depth of
each, and the matches on a blank region its plane (`swept.py`), or a network whose weights the user has (`learned.py`).
The confidence of a depth is one over the standard deviation of log z (`depth_noise.py`), and 1 where nothing is known.

Every model of COLMAP is a world with a frame and a unit of its own: images do not tell the scale, so its landmarks get
the median depth `median_depth`. An answer has the poses of its current frame's world. A frame between two of one world
may have a pose that is a guess: it has no points, so it is never fused.
"""

from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.io.files import jsonable
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import Prior, PriorPrediction, Provenance, Window
from emgs_jax.prior.multiview.dense import DenseConfig, Matched, Stereo
from emgs_jax.prior.multiview.depth import mean_difference, pixels_per_log_depth
from emgs_jax.prior.multiview.depth_noise import relative_std
from emgs_jax.prior.multiview.learned import LearnedConfig, learned
from emgs_jax.prior.multiview.lens import Lens, as_shown, lens_of, points_shown
from emgs_jax.prior.multiview.sources import choose, parallax
from emgs_jax.prior.multiview.swept import SweptConfig, swept
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.model import NONE, Structure
from emgs_jax.structure.sequence import structure_of

jitted_difference, jitted_pixels = eqx.filter_jit(mean_difference), eqx.filter_jit(pixels_per_log_depth)
NUM_KEPT = 64  # frames whose images, depths and features are at hand


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
    """Structure from motion of all images, and stereo of each with others.

    Args:
        structure: poses and landmarks.
        dense: depth.
    """

    def __init__(self, structure: StructureConfig, dense: SweptConfig | LearnedConfig) -> None:
        self._config, self._dense_config, self._stereo = structure, dense, stereo_of(dense)
        settings = {"structure": _values(structure), "dense": _values(dense)}
        settings["dense"].pop("checkpoint", None)  # its digest says which it is, wherever it lies
        self.provenance = Provenance("multiview_stereo", {"version": 12} | settings)
        self._dataset: Dataset | None = None
        self._folder: Path | None = None
        self._found: Structure | None = None
        # What was made of a frame last is asked for again by its neighbours.
        self._view, self._depth = lru_cache(NUM_KEPT)(self._make_view), lru_cache(NUM_KEPT)(self._make_depth)

    def num_newer(self, window_size: int) -> int:
        """All but one: a structure knows all images, so the first frame alone begins the map."""
        return window_size

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Take the data set whose images the structure is made of.

        Raises:
            ValueError: it has fewer than three images.
        """
        if len(dataset) < 3:
            raise ValueError(
                f"prior=multiview_stereo needs three images or more of one place, {dataset.name} {dataset.sequence} "
                f"has {len(dataset)} in use: give more (dataset.stop, dataset.stride)"
            )
        self._dataset = dataset

    def keep(self, folder: Path) -> None:
        """Keep the structure in `folder`/structure, and take it from there; it is made now."""
        self._folder = folder / "structure"
        self._prepare()

    def report(self) -> dict[str, float]:
        """`prior/placed_percent`: frames with a pose in a model; `prior/num_worlds`: models that hold them."""
        if self._found is None:
            return {}
        is_placed = (self._found.world != NONE) & ~self._found.is_interpolated
        return {"prior/placed_percent": 100 * float(is_placed.mean()), "prior/num_worlds": len(self._found.worlds)}

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Poses of all views and depth of `window.dense`; a view that no model holds has NaN and no valid point."""
        self._prepare()
        structure, world = self._found, self._world_at(window.current)
        depths = [self._answer(frame) for frame in window.dense]
        points, confidence, mask = (np.stack(found) for found in zip(*depths, strict=True))
        T, spread = np.full((len(window.views), 4, 4), np.nan), np.full((len(window.views), 6, 6), np.nan)
        anchor = window.views[0]
        is_same = structure.world[anchor] == world
        T_anchor_world = np.linalg.inv(structure.T_world_camera[anchor]) if is_same else np.eye(4)
        for row, frame in enumerate(window.views):
            if structure.world[frame] == world:
                T[row] = np.eye(4) if frame == anchor else T_anchor_world @ structure.T_world_camera[frame]
                spread[row] = structure.covariance[frame]
        features = np.zeros((*mask.shape, 0), np.float16)
        return PriorPrediction(window, T, points, confidence, mask, features, pose_covariance=spread, world=world)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        """Predict for views of two visits of a place; None where they are not in one world."""
        self._prepare()
        world = self._found.world[[window.views[0], window.current]]
        is_known = world[0] == world[1] != NONE
        return self.predict(window, frames, intrinsics) if is_known else None

    def _prepare(self) -> None:
        """Make the structure, once."""
        if self._found is not None:
            return
        if self._dataset is None:
            raise ValueError("multiview_stereo makes a structure of a data set: call check(dataset, window_size) first")
        (width, height), intrinsics = self._dataset.size, self._dataset.intrinsics
        self._camera = Camera(np.float32(intrinsics[:2]), np.float32(intrinsics[2:]), width, height)
        self._found, is_straight = structure_of(self._dataset, self._config, self._folder)
        pinhole = Lens(self._camera.focal, self._camera.center)
        self._lenses = [
            pinhole if is_straight else lens_of(world.camera, tuple(intrinsics), (width, height))
            for world in self._found.worlds
        ]

    def _world_at(self, frame: int) -> int:
        """World of a frame; of one that none holds that of the last before which one does, so that nothing changes."""
        placed = np.flatnonzero(self._found.world[: frame + 1] != NONE)
        return int(self._found.world[placed[-1]]) if len(placed) else 0

    def _answer(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (h, w, 3), confidence and mask of a frame's pixels."""
        world, (height, width) = self._found.world[frame], (self._camera.height, self._camera.width)
        if world == NONE or self._found.is_interpolated[frame]:
            nothing = np.zeros((height, width), np.float32)
            return np.zeros((height, width, 3), np.float32), nothing + 1, nothing > 0
        lens = self._lenses[world]
        depth, std = (as_shown(values, lens) for values in (self._depth(frame)[0], self._std(frame)))
        mask = (depth > 0) & (std <= self._dense_config.noise.max_std)
        confidence = np.maximum(1.0 / np.where(mask, std, 1.0), np.float32(1.0))
        return points_shown(np.where(mask, depth, 0.0), lens), confidence, mask

    def _make_depth(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth (h, w) of a view, 0 where it is not known, its spread, and `pixels_per_log_depth`."""
        nothing = np.zeros((self._camera.height, self._camera.width), np.float32)
        sources, z = self._sources(frame), self._found.depths(frame)
        z = z[z > 0]
        if not sources or not len(z):
            return nothing, nothing, nothing
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
        depth, spread = self._stereo.estimate(matched)
        seen = jnp.asarray(depth), matched.T_source_view, jnp.asarray(is_used), self._camera
        return depth, spread, np.asarray(jitted_pixels(*seen))

    def _make_view(self, frame: int) -> Any:
        """Return what the way to a depth keeps of an image."""
        return self._stereo.prepare(self._dataset[frame].image, self._lenses[self._found.world[frame]])

    def _placed_beside(self, frame: int) -> np.ndarray:
        """Frames of the same world that show landmarks, without this one, the nearest in time first."""
        found = self._found
        others = np.flatnonzero((found.world == found.world[frame]) & ~found.is_interpolated)
        others = others[others != frame]
        return others[np.argsort(np.abs(others - frame), kind="stable")]

    def _sources(self, frame: int) -> list[int]:
        """The views that together show the view's landmarks under most parallax, best first."""
        found, landmarks = self._found, self._found.landmarks[frame]
        points, center = found.shown(frame), found.T_world_camera[frame, :3, 3]
        best = self._dense_config.best_parallax_rad
        worth = {}
        for other in self._placed_beside(frame):
            is_shown = np.isin(landmarks, found.landmarks[other], assume_unique=True)
            if is_shown.any():
                angle = parallax(points, center, found.T_world_camera[other, :3, 3])
                worth[int(other)] = is_shown * np.minimum(angle / best, 1.0)
        return choose(worth, self._dense_config.num_sources)

    def _std(self, frame: int) -> np.ndarray:
        """Standard deviation of the logarithm of each depth; inf where there is no telling."""
        depth, spread, pixels = self._depth(frame)
        count = self._dense_config.num_checks
        others = [int(other) for other in self._placed_beside(frame)[:count]]
        if not others:
            return np.full_like(depth, np.inf)
        is_used = np.arange(count) < len(others)
        others = (others * count)[:count]
        difference = jitted_difference(
            jnp.asarray(depth),
            jnp.asarray(np.stack([self._depth(other)[0] for other in others])),
            self._relative(others, frame),
            jnp.asarray(is_used),
            self._camera,
            jnp.float32(self._dense_config.depth_step),
        )
        return relative_std(pixels, spread, np.asarray(difference), self._dense_config.noise)

    def _relative(self, others: Sequence[int], frame: int) -> jaxlie.SE3:
        """T_other_frame of several views."""
        poses = self._found.T_world_camera
        T = [np.linalg.inv(poses[other]) @ poses[frame] for other in others]
        return jaxlie.SE3.from_matrix(jnp.asarray(np.stack(T), jnp.float32))
