"""Checkpoints: a stopped run resumes from its maps and its log after some input, saved in one file.

Frames are read and predicted again from the start, because that reproduces the state of the prior and its inputs
(landmarks of a window, raw poses) exactly. They are not mapped again: maps and pose graph come from the file, so the
result has the same bits as that of an uninterrupted run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jaxlie

from emgs_jax.back_end.factors import Factor
from emgs_jax.back_end.state import BackEnd, Closure, Node, Refusal
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import Gaussians
from emgs_jax.io.files import changes, jsonable
from emgs_jax.io.npz import load_headed, save_headed
from emgs_jax.io.structs import pack, unpack
from emgs_jax.loop_closure.place_recognition import Database, Keyframe
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.mapping.atlas import Atlas, Submap, World
from emgs_jax.mapping.records import FrameRecord, with_moved_nodes
from emgs_jax.mapping.run import MappingRun
from emgs_jax.motion import Looks
from emgs_jax.observation import Observation
from emgs_jax.ops.ranges import number
from emgs_jax.pose_graph.optimize import PoseGraphInfo
from emgs_jax.registration.pose_estimate import PoseEstimate
from emgs_jax.registration.pose_noise import Repeats
from emgs_jax.slam import SlamState

CHECKPOINT_FILE = "checkpoint.npz"
FORMAT, VERSION = "emgs_jax.checkpoint", 10
OF_MAPS = (Submap, World, SlamState, GaussianMap, Gaussians, Observation, Looks, PoseEstimate, Repeats, jaxlie.SE3)
OF_GRAPH = (BackEnd, Node, Factor, LoopMeasurement, Refusal, Closure, PoseGraphInfo, Database, Keyframe)


@dataclass(frozen=True)
class CheckpointConfig:
    """Interval between checkpoints of a run.

    Args:
        every: frames between checkpoints, from which the same command in the same folder resumes; 0 = none: a stopped
            run starts again at its first frame.
    """

    every: int = number(50, low=0, high=1_000_000_000)


@dataclass(frozen=True)
class Checkpoint:
    """A run after some of its inputs.

    Args:
        atlas: without camera and config, which the resuming run has.
        capacities: of the map and the submap of a step.
        records: as the frames were placed, with what later frames have shown to have moved in them.
    """

    num_inputs: int
    atlas: Atlas
    capacities: tuple[int, int]
    records: Sequence[FrameRecord]

    def restored(self, run: MappingRun) -> MappingRun:
        """Give a resuming run its atlas and log."""
        names = ("map_capacity", "submap_capacity")
        submap = replace(run.config.submap, **dict(zip(names, self.capacities, strict=True)))
        graph = replace(self.atlas.graph, config=run.atlas.graph.config)
        known = {"camera": run.camera, "config": replace(run.config, submap=submap), "graph": graph}
        records = with_moved_nodes(self.records, (), graph.nodes)
        return replace(run, atlas=replace(self.atlas, **known), records=records)


def save_checkpoint(path: Path, checkpoint: Checkpoint, signature: Mapping[str, Any]) -> None:
    """Write a checkpoint of the run that `signature` (of JSON values) identifies; it replaces the old one."""
    graph = replace(checkpoint.atlas.graph, config=None)
    checkpoint = replace(checkpoint, atlas=replace(checkpoint.atlas, camera=None, config=None, graph=graph))
    said, arrays = pack(checkpoint)
    header = {"format": FORMAT, "version": VERSION, "signature": jsonable(signature), "checkpoint": said}
    save_headed(path, header, arrays)


def load_checkpoint(path: Path, signature: Mapping[str, Any]) -> Checkpoint:
    """Read the checkpoint of the run that `signature` describes.

    Raises:
        ValueError: there is none, it is damaged, or it is of another run; the message names the difference.
    """
    try:
        header, arrays = load_headed(path, {"format": FORMAT, "version": VERSION})
        if changed := changes(header["signature"], jsonable(signature)):
            raise ValueError(f"it is of another run: {changed[0]}")
        found = unpack(header["checkpoint"], arrays, (Checkpoint, Atlas, FrameRecord, *OF_MAPS, *OF_GRAPH))
        if not isinstance(found, Checkpoint):
            raise ValueError("it holds no checkpoint")
        return found
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} cannot be resumed: {error}") from error


class Keeper:
    """Owner of a run's checkpoint file: `found` is the checkpoint to resume from, or None.

    Args:
        config: when to write it; None = never.
        signature: settings that must match those of the checkpoint.
    """

    def __init__(
        self, path: Path = Path(CHECKPOINT_FILE), config: CheckpointConfig | None = None, signature: Mapping = {}
    ) -> None:
        self.path, self._every, self._signature = path, config.every if config else 0, signature
        self.found: Checkpoint | None = None
        self.note: str | None = None  # why an existing file cannot be used
        self._done: tuple[MappingRun | None, int, tuple[FrameRecord, ...]] = None, 0, ()
        self._num_saved = 0
        if self._every and path.exists():
            try:
                self.found = load_checkpoint(path, signature)
                self._num_saved = len(self.found.records)
            except ValueError as error:
                self.note = f"{error}; this run starts at its first frame"

    def keep(self, run: MappingRun, records: Sequence[FrameRecord]) -> None:
        """Keep a run after its next input, with the new records as first estimated; save it if a checkpoint is due."""
        _, num_inputs, placed = self._done
        self._done = run, num_inputs + 1, (*placed, *records)
        if len(self._done[-1]) >= self._num_saved + self._every:
            self.save()

    def save(self) -> None:
        """Write the run after its last complete input, unless that is already written."""
        run, num_inputs, placed = self._done
        if not self._every or run is None or len(placed) <= self._num_saved:
            return
        capacities = run.config.submap.map_capacity, run.config.submap.submap_capacity
        records = [
            replace(record, moving=known.moving, moving_pixels=known.moving_pixels)
            for record, known in zip(placed, run.records, strict=True)
        ]
        save_checkpoint(self.path, Checkpoint(num_inputs, run.atlas, capacities, records), self._signature)
        self._num_saved = len(placed)

    def drop(self) -> None:
        """Remove the file of a completed run."""
        self.path.unlink(missing_ok=True)
