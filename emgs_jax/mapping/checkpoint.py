"""Checkpoints: a run that was stopped resumes from its map and records after some input, saved in one file.

Frames are read and predicted from the start again, because what they carry along (landmarks of a window, the raw
predictions' points, keyframes) follows from that alone, the same every time. The steps are not replayed: state and
records come from the file, so that the result has the same bits as that of an uninterrupted run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emgs_jax.io.files import changes, jsonable
from emgs_jax.io.npz import load_headed, save_headed
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.mapping.run import MappingRun
from emgs_jax.ops.ranges import number
from emgs_jax.slam import SlamState

CHECKPOINT_FILE = "checkpoint.npz"
FORMAT, VERSION = "emgs_jax.checkpoint", 7
POSES = tuple(field.name for field in fields(FrameRecord) if field.name.endswith("pose"))
MATRICES = dict.fromkeys(POSES, 4) | {"covariance": 6, "similarity": 4}  # of a record, and how many rows they have


@dataclass(frozen=True)
class CheckpointConfig:
    """Interval between checkpoints of a run.

    Args:
        every: frames; 0 = never, and a run that is stopped starts again at its first frame.
    """

    every: int = number(low=0, high=1_000_000_000)


@dataclass(frozen=True)
class Checkpoint:
    """A run after some of its inputs.

    Args:
        leaves: of the state, in the order of `jax.tree.leaves`; none before there is a map.
        records: as the frames were placed.
        inactive: leaves of the states of the other disconnected submaps, by their number.
    """

    num_inputs: int
    leaves: Sequence[np.ndarray]
    capacities: tuple[int, int]
    records: Sequence[FrameRecord]
    inactive: Mapping[int, Sequence[np.ndarray]] = field(default_factory=dict)

    def restored(self, run: MappingRun) -> MappingRun:
        """Rebuild states and config in a run whose inputs were replayed; its state has any size."""
        names = ("map_capacity", "submap_capacity")
        submap = replace(run.config.submap, **dict(zip(names, self.capacities, strict=True)))

        def state(leaves: Sequence[np.ndarray]) -> SlamState:
            return jax.tree.unflatten(jax.tree.structure(run.state), [jnp.asarray(leaf) for leaf in leaves])

        inactive = {submap: state(leaves) for submap, leaves in self.inactive.items()}
        current = state(self.leaves) if len(self.leaves) else None
        return replace(run, state=current, inactive=inactive, config=replace(run.config, submap=submap))


def save_checkpoint(path: Path, checkpoint: Checkpoint, signature: Mapping[str, Any]) -> None:
    """Write a checkpoint of the run that `signature` (as JSON has it) tells from others; the old one is replaced."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "signature": jsonable(signature),
        "num_inputs": checkpoint.num_inputs,
        "capacities": checkpoint.capacities,
        "num_leaves": len(checkpoint.leaves),
        "aside": list(checkpoint.inactive),
        "records": [{k: v for k, v in vars(record).items() if k not in MATRICES} for record in checkpoint.records],
    }
    arrays = {f"leaf_{row}": np.asarray(leaf) for row, leaf in enumerate(checkpoint.leaves)}
    for submap, leaves in checkpoint.inactive.items():
        arrays |= {f"aside_{submap}_{row}": np.asarray(leaf) for row, leaf in enumerate(leaves)}
    for name, size in MATRICES.items():
        nothing = np.full((size, size), np.nan)  # stands for None
        found = [nothing if getattr(r, name) is None else getattr(r, name) for r in checkpoint.records]
        arrays[name] = np.asarray(found, np.float64).reshape(-1, size, size)
    save_headed(path, header, arrays)


def load_checkpoint(path: Path, signature: Mapping[str, Any]) -> Checkpoint:
    """Read the checkpoint of the run that `signature` describes.

    Raises:
        ValueError: there is none, it is damaged, or it is of another run; the message names what is different.
    """
    try:
        header, arrays = load_headed(path, {"format": FORMAT, "version": VERSION})
        if changed := changes(header["signature"], jsonable(signature)):
            raise ValueError(f"it is of another run: {changed[0]}")
        matrices = [{name: arrays[name][row] for name in MATRICES} for row in range(len(header["records"]))]
        records = [
            FrameRecord(**line, **{name: None if np.isnan(rows).any() else rows for name, rows in found.items()})
            for line, found in zip(header["records"], matrices, strict=True)
        ]
        rows = range(header["num_leaves"])
        inactive = {submap: [arrays[f"aside_{submap}_{row}"] for row in rows] for submap in header["aside"]}
        leaves = [arrays[f"leaf_{row}"] for row in rows]
        return Checkpoint(header["num_inputs"], leaves, tuple(header["capacities"]), records, inactive)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} cannot be resumed: {error}") from error


class Keeper:
    """Owner of a run's checkpoint file: `found` is the checkpoint to resume from, None where there is none.

    Args:
        config: when it is written; None = never.
        signature: settings that must match those of the checkpoint.
    """

    def __init__(
        self, path: Path = Path(CHECKPOINT_FILE), config: CheckpointConfig | None = None, signature: Mapping = {}
    ) -> None:
        self.path, self._every, self._signature = path, config.every if config else 0, signature
        self.found: Checkpoint | None = None
        self.note: str | None = None  # why a file that is there is of no use
        self._done: tuple[MappingRun | None, int, tuple[FrameRecord, ...]] = None, 0, ()
        self._num_saved = 0
        if self._every and path.exists():
            try:
                self.found = load_checkpoint(path, signature)
                self._num_saved = len(self.found.records)
            except ValueError as error:
                self.note = f"{error}; this run starts at its first frame"

    def keep(self, run: MappingRun, records: Sequence[FrameRecord]) -> None:
        """Note a run after its next input, with the new records as first estimated; save it if a checkpoint is due."""
        _, num_inputs, placed = self._done
        self._done = run, num_inputs + 1, (*placed, *records)
        if len(self._done[-1]) >= self._num_saved + self._every:
            self.save()

    def save(self) -> None:
        """Write the run as it was after its last complete input, if that is not written yet."""
        run, num_inputs, placed = self._done
        if not self._every or run is None or len(placed) <= self._num_saved:
            return
        capacities = run.config.submap.map_capacity, run.config.submap.submap_capacity
        leaves = jax.device_get(jax.tree.leaves(run.state))
        others = {submap: jax.device_get(jax.tree.leaves(one)) for submap, one in run.inactive.items()}
        checkpoint = Checkpoint(num_inputs, leaves, capacities, placed, others)
        save_checkpoint(self.path, checkpoint, self._signature)
        self._num_saved = len(placed)

    def drop(self) -> None:
        """Remove the file of a run that is complete."""
        self.path.unlink(missing_ok=True)
