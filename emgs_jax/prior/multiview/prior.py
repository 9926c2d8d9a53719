"""The prior `multiview_stereo`: classical geometry from the images alone, without weights and without a GPU.

COLMAP finds the poses of all images (`structure/`), or, online, of those that have come (`structure/online.py`). Depth
is from a plane sweep, with planes in blank regions (`swept.py`), from a stereo network (`learned.py`), or from a
monocular network or files, fitted to COLMAP's landmarks (`monocular.py`). Its confidence is one over the standard
deviation of log z (`depth_noise.py`), at least 1.

Every model of COLMAP is a world with its own frame and unit: its landmarks get the median depth `median_depth`. A
prediction has the poses of the current frame's world. A frame that no model holds has no pose.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import Dataset, Frame, wait_for_all
from emgs_jax.data.masks import check_names, names_of
from emgs_jax.data.reading import contents
from emgs_jax.io.files import jsonable
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import (
    SCALE_STD_KEY,
    UP_KEYS,
    DenseView,
    Prior,
    PriorPrediction,
    Provenance,
    Window,
    no_points,
    predicted,
)
from emgs_jax.prior.multiview.dense import DenseConfig, Depth, Scene, Way
from emgs_jax.prior.multiview.depth import mean_difference
from emgs_jax.prior.multiview.depth_files import DepthFilesConfig, way_of_files
from emgs_jax.prior.multiview.depth_noise import relative_std
from emgs_jax.prior.multiview.learned import LearnedConfig, learned
from emgs_jax.prior.multiview.lens import Lens, as_shown, lens_of, points_shown
from emgs_jax.prior.multiview.matched import begin_matched, rehearse
from emgs_jax.prior.multiview.monocular_network import MeterConfig, way_of_meter
from emgs_jax.prior.multiview.swept import SweptConfig, swept
from emgs_jax.prior.sources import Sources, placed_beside, same_sources, sources_of
from emgs_jax.scale.estimate import Scale
from emgs_jax.scale.metres import Given, ScaleConfig, View, metres_of, read_given
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.given import names_at
from emgs_jax.structure.model import NONE, Structure, median_depth, scaled, without_worlds
from emgs_jax.structure.sequence import follow_images, structure_of
from emgs_jax.structure.store import doubtful_in

jitted_difference = eqx.filter_jit(mean_difference)
NUM_KEPT = 64  # frames whose depths are cached
AnyDense = SweptConfig | LearnedConfig | DepthFilesConfig | MeterConfig


def way_of(config: AnyDense) -> Way:
    if isinstance(config, DepthFilesConfig):
        return way_of_files(config)
    if isinstance(config, MeterConfig):
        return way_of_meter(config)
    stereo = learned(config) if isinstance(config, LearnedConfig) else swept(config)
    of_stereo = {"stereo": stereo, "config": config}
    return Way(partial(begin_matched, **of_stereo), rehearse=partial(rehearse, **of_stereo))


def _described(config: AnyDense, way: Way) -> dict:
    """Settings without paths, which are identified by a digest."""
    paths = "folder", "checkpoint"
    return {key: value for key, value in _values(config).items() if key not in paths} | dict(way.contents)


def _values(config: StructureConfig | DenseConfig) -> dict:
    """The values of a config for JSON; a float32 of .1 becomes .1."""
    return jsonable(
        jax.tree.map(lambda v: float(str(np.float32(v))) if isinstance(v, jax.Array) else v, asdict(config))
    )


class MultiviewStereo(Prior):
    """Structure from motion of all images, and dense depth of each."""

    def __init__(self, structure: StructureConfig, dense: AnyDense, metres: ScaleConfig) -> None:
        self._config, self._dense, self._way, self._metres = structure, dense, way_of(dense), metres
        self.adjusts_poses = structure.online
        if structure.online and (self._way.needs_all or structure.model is not None or metres.is_given):
            key = "scale=" if metres.is_given else "this prior/dense"
            key = "prior.structure.model" if structure.model is not None else key
            raise ValueError(
                f"prior.structure.online=true makes poses as images come, and {key} needs all of them: use one"
            )
        settings = {"structure": _values(structure), "dense": _described(dense, self._way)}
        if metres.is_given or getattr(dense, "kind", None) == "metric":
            settings["unit"] = "m"
        if metres.is_given:
            settings["scale"] = jsonable(asdict(metres))
        if metres.positions == "dataset" and structure.model is None:
            settings["poses"] = "dataset"
        model = {} if structure.model is None else {"model": Path(structure.model).expanduser()}
        if files := metres.files | model:
            settings["contents"] = {key: contents(path) for key, path in files.items()}
        self.provenance = Provenance("multiview_stereo", {"version": 15} | settings)
        self._dataset: Dataset | None = None
        self._given: Given | None = None  # what `_metres` names
        self._folder: Path | None = None
        self._up_to: Callable[[int], Structure] | None = None  # of the frames up to this one, at least
        self._known: Structure | None = None
        self._newest = lambda: self._known  # in metres where these are known
        self._lenses: dict[tuple, Lens] = {}
        self._num_adjusted = 0
        self._scale_std: float | None = None
        self._up: tuple[np.ndarray, int] | None = None  # in the axes of a frame's camera, and the frame

    def num_newer(self, window_size: int) -> int:
        """All but one: a structure knows all images, so the first frame alone begins the map. None online."""
        return 0 if self._config.online else window_size

    def num_first(self, window_size: int) -> int:
        """One online: the structure itself waits until it can begin."""
        return 1 if self._config.online else window_size

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Take the data set; ValueError if it has fewer than three images, or depths or lengths are not of them."""
        if not self._config.online and wait_for_all(dataset) < 3:
            raise ValueError(
                f"prior=multiview_stereo needs three images or more of one place, {dataset.name} {dataset.sequence} "
                f"has {len(dataset)} in use: give more (dataset.stop, dataset.stride)"
            )
        self._way.check(dataset)
        self._dataset, self._given = dataset, read_given(self._metres, dataset)

    def keep(self, folder: Path) -> None:
        """Make the structure in `folder`/structure, or load it from there.

        An online one begins with the first call. Programs are compiled here, before images pass.
        """
        self._folder = folder / "structure"
        if not self._config.online:
            self._take(0)
            return
        self._open()
        self._way.rehearse(self._camera)
        nothing = np.zeros((self._camera.height, self._camera.width), np.float32)
        if self._dense.num_checks:
            self._difference(nothing, same_sources(jnp.asarray(nothing), self._dense.num_checks))

    def report(self) -> dict[str, float]:
        """Return `prior/placed_percent`: frames with a pose in a model, `prior/num_worlds`: number of models.

        Of models that were made here also `prior/doubtful_percent`: frames of those that are said to be doubtful.
        In metres also `prior/scale_std_percent`, and `prior/up_x`, … (`UP_KEYS`), if a source tells up.
        """
        found = self._newest()
        if found is None:
            return {}
        placed = 100 * float(found.is_placed.mean())
        known = {} if self._scale_std is None else {SCALE_STD_KEY: 100 * self._scale_std}
        is_own = self._config.model is None and not self._config.online
        doubtful = doubtful_in(self._folder) if is_own else None
        if doubtful is not None:
            is_doubtful = [name in doubtful for name in names_of(self._dataset)]
            known["prior/doubtful_percent"] = 100 * float(np.mean(found.is_placed & is_doubtful))
        if self._up is not None:
            up, frame = self._up
            index = getattr(self._dataset, "kept", range(len(self._dataset)))[frame]
            known |= dict(zip(UP_KEYS, [*map(float, up), index], strict=True))
        return {"prior/placed_percent": placed, "prior/num_worlds": len(found.worlds)} | known

    @property
    def metre(self) -> float:
        """That of an own structure for a given one, whose unit stays: its median depth over `median_depth`."""
        if self._config.model is None or self.provenance.settings.get("unit") == "m":
            return 1.0
        found = self._take(0)
        return median_depth(found) / self._config.median_depth if found.is_placed.any() else 1.0

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict; a view that is in no model has NaN and no valid point."""
        structure = self._take(max(window.views))
        return replace(self._predicted(structure, window), adjusted=self._adjusted(structure, window))

    def _predicted(self, structure: Structure, window: Window) -> PriorPrediction:
        world = self._world_at(window.current)
        T, spread = np.full((len(window.views), 4, 4), np.nan), np.full((len(window.views), 6, 6), np.nan)
        anchor = window.views[0]
        T_anchor_world = from_world(structure, anchor, world)
        for row, frame in enumerate(window.views):
            if structure.world[frame] == world:
                T[row] = np.eye(4) if frame == anchor else T_anchor_world @ structure.T_world_camera[frame]
                spread[row] = structure.covariance[frame]
        dense, current = [self._answer(frame) for frame in window.dense], window.current
        scale_std = np.float64(self._depths(current).scale_std) if structure.is_placed[current] else None
        number = int(np.searchsorted(np.unique(structure.world[structure.is_placed]), world))
        return predicted(window, T, dense, pose_covariance=spread, scale_std=scale_std, world=number)

    def _adjusted(self, structure: Structure, window: Window) -> dict[int, np.ndarray]:
        """The poses of earlier frames, as they are predicted now, where all were adjusted since the last call."""
        was, self._num_adjusted = self._num_adjusted, structure.num_adjusted
        if was == structure.num_adjusted:
            return {}
        T = from_world(structure, window.views[0], 0) @ structure.T_world_camera
        return {frame: T[frame] for frame in range(window.current) if structure.world[frame] == 0}

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        """Predict for views of two visits of a place; None unless they are in one world."""
        structure = self._take(max(window.views))
        world = structure.world[[window.views[0], window.current]]
        is_known = world[0] == world[1] != NONE
        return self._predicted(structure, window) if is_known else None

    def _take(self, frame: int) -> Structure:
        """The structure of the images up to this one, or of more."""
        if self._up_to is None:
            self._open()
        self._known = self._up_to(frame)
        return self._newest()

    def _open(self) -> None:
        """Make the structure and begin the depths; online no image is taken yet."""
        if self._dataset is None:
            raise ValueError("multiview_stereo makes a structure of a data set: call check(dataset, window_size) first")
        (width, height), intrinsics = self._dataset.size, self._dataset.intrinsics
        self._camera = Camera(np.float32(intrinsics[:2]), np.float32(intrinsics[2:]), width, height)
        self._up_to, self._is_straight = self._begin()
        if not self._config.online:
            self._known = self._up_to(0)
        depths, scales = self._way.begin(Scene(self._dataset, self._newest, self._lens, self._camera))
        self._depths = lru_cache(NUM_KEPT)(depths)  # a frame's neighbours ask for its depth again
        if self._metres.is_given or any(scales):
            self._to_metres(self._newest(), scales)

    def _begin(self) -> tuple[Callable[[int], Structure], bool]:
        """A function that gives the newest structure, see `_take`, and True if its images are undistorted."""
        if self._config.online:
            return follow_images(self._dataset, self._config), False
        if self._config.model is not None:
            names = names_at(Path(self._config.model).expanduser())
            check_names(self._dataset, names, f"prior.structure.model={self._config.model}")
        at_poses = self._metres.positions == "dataset"
        found, is_straight = structure_of(self._dataset, self._config, self._folder, at_poses)
        return lambda frame: found, is_straight

    def _to_metres(self, found: Structure, scales: Sequence[Scale | None]) -> None:
        """Bring structure and depths into metres by the lengths that are known; frames of other worlds lose their pose.

        Args:
            scales: of each world, by depths in metres; empty without such.
        """

        def view(frame: int) -> View:
            points, confidence, _ = self._answer(frame)
            return View(points, 1.0 / confidence)

        each = metres_of(self._given, found.T_world_camera, found.world, view, scales)
        depths = self._depths
        factors = np.ones(len(each))
        for world, (scale, _, notes) in enumerate(each):
            of = f" of model {world}" if len(each) > 1 else ""
            lost = f"unknown, so no pose for its images ({np.sum(found.world == world)})"
            said = [lost] if scale is None else [f"± {100 * scale.std:.1f} %, by {scale.source}"]
            tqdm.write(f"scale{of}: {'; '.join([*said, *notes])}")
            factors[world] = 1.0 if scale is None else scale.factor
        self._scale_std = max(scale.std for scale, *_ in each if scale is not None)
        unknown = [world for world, (scale, *_) in enumerate(each) if scale is None]
        in_metres = without_worlds(scaled(found, factors), unknown)
        first = int(np.flatnonzero(in_metres.is_placed)[0])
        up = each[in_metres.world[first]].up
        self._up = None if up is None else (found.T_world_camera[first, :3, :3].T @ up, first)

        def depth_in_metres(frame: int) -> Depth:
            one = depths(frame)
            return one._replace(depth=np.float32(factors[found.world[frame]]) * one.depth)

        self._newest, self._depths = lambda: in_metres, lru_cache(NUM_KEPT)(depth_in_metres)

    def _lens(self, world: int) -> Lens:
        """The lens of the images of a world."""
        if self._is_straight:
            return Lens(self._camera.focal, self._camera.center)
        camera = self._known.worlds[world].camera
        parameters = camera.model_name, camera.width, camera.height, *map(float, camera.params)
        if parameters not in self._lenses:  # an online structure adjusts it
            intrinsics, size = tuple(self._dataset.intrinsics), (self._camera.width, self._camera.height)
            self._lenses = {**dict([*self._lenses.items()][-1:]), parameters: lens_of(camera, intrinsics, size)}
        return self._lenses[parameters]

    def _world_at(self, frame: int) -> int:
        """World of a frame, or of the last frame before it that has one."""
        world = self._newest().world[: frame + 1]
        placed = np.flatnonzero(world != NONE)
        return int(world[placed[-1]]) if len(placed) else 0

    def _answer(self, frame: int) -> DenseView:
        found = self._newest()
        if not found.is_placed[frame]:
            return no_points((self._camera.width, self._camera.height))
        lens, std = self._lens(found.world[frame]), self._std(found, frame)
        is_sure = np.isfinite(std) & (std <= self._dense.noise.max_std)
        depth = np.float32(np.where(is_sure, self._depths(frame).depth, 0.0))
        depth, std = (as_shown(values, lens) for values in (depth, np.where(depth > 0, std, np.float32(np.inf))))
        mask = depth > 0
        confidence = np.maximum(1.0 / np.where(mask, std, 1.0), np.float32(1.0))
        return points_shown(np.where(mask, depth, 0.0), lens), confidence, mask

    def _std(self, found: Structure, frame: int) -> np.ndarray:
        """Standard deviation of the log of each depth; inf where undetermined."""
        config, depths = self._dense, self._depths
        depth, spread, pixels, _ = depths(frame)
        others = placed_beside(found, frame)[: config.num_checks]
        if not others:
            return np.full_like(depth, np.inf)
        seen = sources_of(found, frame, others, config.num_checks, lambda other: jnp.asarray(depths(other).depth))
        return relative_std(pixels, spread, self._difference(depth, seen), config.noise)

    def _difference(self, depth: np.ndarray, seen: Sources) -> np.ndarray:
        step = jnp.float32(self._dense.depth_step)
        return np.asarray(jitted_difference(jnp.asarray(depth), seen, self._camera, step))


def from_world(structure: Structure, anchor: int, world: int) -> np.ndarray:
    """T_anchor_world (4, 4); the identity where the anchor has no pose there, such as a first image that is dark."""
    is_there = structure.world[anchor] == world
    return np.linalg.inv(structure.T_world_camera[anchor]) if is_there else np.eye(4)
