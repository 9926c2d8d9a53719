"""A run: its maps, and a record of each of its frames.

A pose is a (4, 4) float64 matrix, camera -> world, everywhere on the host; files write it as TUM's seven numbers.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import jax
import numpy as np

from emgs_jax.back_end.saved_map import SavedMap
from emgs_jax.back_end.state import BackEnd, BackEndConfig
from emgs_jax.data.base import Dataset
from emgs_jax.device.clock import Clock
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import MIN_ROWS, REFERENCE
from emgs_jax.loop_closure.prior_query import PriorQuery
from emgs_jax.mapping.atlas import Atlas, unvisited
from emgs_jax.mapping.convert import to_camera
from emgs_jax.mapping.records import UNPLACED, FrameRecord
from emgs_jax.ops.camera import Camera
from emgs_jax.slam import SlamConfig, SlamState

CLOSED_AT_0 = "max_step", "max_step_rad", "max_pose_std"  # gates of localization


@dataclass(frozen=True)
class MappingRun:
    """A run so far: its maps, and the log of its frames.

    Args:
        clock: measures load, predict and map.
        records: outcomes of the frames; the mapping does not read them.
        prior_query: predicts both visits of a loop, see `prior_queries`.
        first_covariance: (6, 6) of the first frame, in the unit in which frames were placed; set at the end of the run
            (`with_first_frame`).
    """

    atlas: Atlas
    clock: Clock = field(default_factory=Clock)
    records: Sequence[FrameRecord] = ()
    prior_query: PriorQuery = lambda a, b: None
    first_covariance: np.ndarray | None = None

    @property
    def camera(self) -> Camera:
        """Camera of the full images."""
        return self.atlas.camera

    @property
    def config(self) -> SlamConfig:
        """Configs of all stages, with the capacities that the maps need."""
        return self.atlas.config

    @property
    def state(self) -> SlamState | None:
        """State after the last frame; None before the camera is in a map."""
        return self.atlas.state

    @property
    def back_end(self) -> BackEnd | None:
        """Pose graph; None without a back end: poses stay as first estimated."""
        return None if self.atlas.graph.config is None else self.atlas.graph

    @property
    def apart(self) -> Mapping[int, SlamState]:
        """States of submaps that are not joined with the map, by number; empty before there is a map."""
        others = {} if self.state is None else self.atlas.submaps
        return {number: one.state for number, one in others.items() if number != self.atlas.graph.active}

    @property
    def map(self) -> GaussianMap | None:
        """All Gaussians; None before the first window."""
        return None if self.state is None else self.state.map

    @property
    def poses(self) -> np.ndarray:
        """T_world_camera of each record, (n, 4, 4)."""
        return _stacked([record.pose for record in self.records])

    @property
    def raw_poses(self) -> np.ndarray:
        """Raw predictions of the poses, likewise."""
        return _stacked([record.raw_pose for record in self.records])

    @property
    def true_poses(self) -> list[np.ndarray | None]:
        """True poses of the data set, likewise; None if unknown."""
        return [record.true_pose for record in self.records]


def new_run(
    dataset: Dataset,
    config: SlamConfig,
    clock: Clock | None = None,
    graph: BackEndConfig | None = None,
    saved: SavedMap | None = None,
) -> MappingRun:
    """Make a run of `dataset` before its first frame; `graph` gives it a back end, `saved` that of an earlier run.

    Raises:
        ValueError: `saved` is combined with `merged` initialization, JAX computes in float64, or as `check_settings`.
    """
    if jax.config.jax_enable_x64:
        raise ValueError(
            'JAX_ENABLE_X64 is set, and maps are made in float32: jax.config.update("jax_enable_x64", False) turns it '
            "off, or unset JAX_ENABLE_X64"
        )
    check_settings(config)
    back_end = BackEnd(graph, tuple(dataset.intrinsics), float(config.fit.min_std))
    clock, camera = Clock() if clock is None else clock, to_camera(dataset)
    for words in clamped(config, camera):
        warn_once(words)
    if saved is None:
        return MappingRun(Atlas(camera, config, back_end), clock)
    if config.initialization == "merged":
        raise ValueError("map= places one view after the other: use slam.initialization=incremental with it")
    config = replace(config, submap=replace(config.submap, map_capacity=saved.map.weight.shape[0]))
    return MappingRun(
        Atlas(camera, config, replace(saved.back_end, active=None), {0: unvisited(saved, camera, config)}), clock
    )


def check_settings(config: SlamConfig) -> None:
    """Raise ValueError, with the reason, for settings by which no map could be made, or no frame be tracked in it."""
    existence, motion, pixels = config.existence, config.motion, config.fit.points_per_gaussian
    names = "birth", "hit", "miss", "max_log_odds", "refuted"
    birth, hit, miss, most, refuted = (float(getattr(existence, name)) for name in names)
    highest = most if hit > 0 else min(birth, most) if miss > 0 else birth
    shown = " ".join(f"slam.existence.{name}={float(getattr(existence, name)):g}" for name in names)
    if highest <= 0:
        raise ValueError(
            f"{shown}: no Gaussian would ever be confirmed, which takes log-odds above 0, and frames are tracked by "
            "these: raise max_log_odds, or birth or hit"
        )
    if (min(birth + hit, most) if hit > 0 else birth) < refuted:
        raise ValueError(f"{shown}: every Gaussian would be removed after the next frame: lower refuted")
    prior, look = float(motion.prior), float(motion.hit)
    if motion.num_looks and float(motion.miss) > 0 and prior + look <= 0:
        raise ValueError(
            f"slam.motion.prior={prior:g} slam.motion.hit={look:g}: all that one earlier frame confirms would be taken "
            "for moving, and no frame be tracked: their sum must be above 0"
        )
    gates = {f"slam.localization.{name}": getattr(config.localization, name) for name in CLOSED_AT_0}
    gates["slam.localization.icp.max_mahalanobis_sq"] = config.localization.icp.max_mahalanobis_sq
    if closed := [name for name, value in gates.items() if float(value) == 0]:
        raise ValueError(f"{closed[0]}=0 lets no frame pass, so none would be tracked: give a value above 0")
    if pixels > REFERENCE:
        raise ValueError(
            f"slam.fit.points_per_gaussian={pixels} makes no Gaussian of an image, which counts as {REFERENCE} pixels "
            "(518 × 392) whatever its size: give fewer, such as 85"
        )


def clamped(config: SlamConfig, camera: Camera) -> list[str]:
    """Describe settings that have no effect on images of this size, and what happens instead."""
    found, least = [], MIN_ROWS * config.observation.thin**2 * REFERENCE / (camera.width * camera.height)
    if config.fit.points_per_gaussian < math.floor(least):
        found.append(
            f"slam.fit.points_per_gaussian={config.fit.points_per_gaussian} makes the Gaussians of "
            f"{math.floor(least)}: fewer than {MIN_ROWS} points of an image of {camera.width}×{camera.height} with "
            f"slam.observation.thin={config.observation.thin} have no covariance"
        )
    if config.em.num_neighbours > config.em.num_candidates:
        found.append(
            f"slam.em.num_neighbours={config.em.num_neighbours} finds no more than "
            f"slam.em.num_candidates={config.em.num_candidates}"
        )
    return found


@cache
def warn_once(words: str) -> None:
    """Print a warning once per process."""
    print(f"warning: {words}", file=sys.stderr)


def row_of_first_node(run: MappingRun) -> int:
    """Return the row of the first record that is a node of the back end; all later records are nodes, too."""
    return len(run.records) - (len(run.back_end.nodes) - run.back_end.first_node)


def with_truth(run: MappingRun, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return poses and true poses (n, 4, 4) of the placed frames whose truth is known; None without any.

    Poses of lost frames are guesses, and those of submaps that were never joined are in a world of their own.
    """
    rows = rows_with_truth(run)
    if not len(rows):
        return None
    estimate, truth = (np.stack([path[row] for row in rows]) for path in (poses, run.true_poses))
    return estimate, truth.astype(np.float64)


def rows_with_truth(run: MappingRun) -> np.ndarray:
    """Return the rows of the records of placed frames whose truth is known; those of `with_truth`."""
    rows = zip(run.true_poses, run.records, strict=True)
    return np.flatnonzero([true is not None and record.status not in UNPLACED for true, record in rows])


def placed_percent(run: MappingRun) -> float:
    """Return the share of the frames with a true pose that are placed in the map; what `with_truth` is of."""
    statuses = [record.status for record, true in zip(run.records, run.true_poses, strict=True) if true is not None]
    return 100.0 * float(np.mean([status not in UNPLACED for status in statuses])) if statuses else 0.0


def _stacked(poses: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(poses) if poses else np.zeros((0, 4, 4))
