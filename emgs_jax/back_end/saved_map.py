"""places.npz: a run's back end, beside map.npz, so that another run can continue in the map.

It holds keyframes, poses and factors. The frames of the new run become further nodes of the same pose graph.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.back_end.factors import Factor
from emgs_jax.back_end.state import BackEnd, BackEndConfig, Node
from emgs_jax.data.reading import fingerprint, resize_nearest
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.io.map_file import load_map
from emgs_jax.io.npz import load_headed, save_headed
from emgs_jax.keypoints.sift import DESCRIPTOR_SIZE
from emgs_jax.loop_closure.place_recognition import Database, Keyframe, unit_descriptors, vlad
from emgs_jax.loop_closure.verification import LoopMeasurement

PLACES_FILE, MAP_FILE, METRICS_FILE = "places.npz", "map.npz", "metrics.json"
HEADER = {"format": "emgs_jax.places", "version": 1, "descriptors": "rootsift"}
MODES = ("extend", "localize")
LEFT_OUT = -1  # submap of nodes that were never joined with the map
NODES = {
    "poses": "pose",
    "log_scales": "log_scale",
    "frames": "frame",
    "is_placed": "is_placed",
}  # name in the file: of a node
LOOPS = {"verified": "verified", "contradicted": "violating", "accepted": "accepted"}  # name in the file: in a back end
OF_EDGES = Factor._fields[:-1]  # these nodes stay where they are, whatever the next run's prior predicts
OF_POINTS, OF_KEYFRAMES = ("pixels", "descriptors", "points"), ("frame", "intrinsics", "size", "depths")


@dataclass(frozen=True)
class SavedMap:
    """A map of an earlier run that another run continues.

    Args:
        map: of an earlier run.
        back_end: of that run; its `first_node` is that of the next run.
        depth_noise: median difference of a frame from the map, as a fraction of its depth.
        is_frozen: True in localization mode, in which the map stays as it is.
        checksum: of its files.
    """

    map: GaussianMap
    back_end: BackEnd
    depth_noise: float
    is_frozen: bool
    checksum: str

    @property
    def count(self) -> int:
        """Number of its Gaussians."""
        return int(np.asarray(self.map.gaussians.valid).sum())


def save_places(path: Path, end: BackEnd, depth_noise: float) -> None:
    """Write the file that `load_places` reads."""
    keyframes = _on_one_grid(end.database.keyframes)
    header = HEADER | {
        "depth_noise": depth_noise,
        "num_trained": end.database.num_trained,
        "has_one_unit": end.has_one_unit,
        "first_node": end.first_node,
    }
    arrays = {name: np.array([getattr(node, field) for node in end.nodes]) for name, field in NODES.items()} | {
        "words": end.database.words
    }
    arrays["is_kept"] = np.array([node.submap == end.active for node in end.nodes])
    arrays |= {f"keyframes.{name}": np.stack([getattr(one, name) for one in keyframes]) for name in OF_KEYFRAMES}
    arrays |= {f"keyframes.{name}": np.concatenate([getattr(one, name) for one in keyframes]) for name in OF_POINTS}
    arrays["keyframes.num_points"] = np.array([len(one.pixels) for one in keyframes])
    edges = _table("edges", end.factors, OF_EDGES)
    arrays |= edges | {"edges.kind": edges.pop("edges.is_loop").astype(int)}
    for name, field in LOOPS.items():
        arrays |= _table(name, getattr(end, field), LoopMeasurement.__annotations__)
    save_headed(path, header, arrays)


def _on_one_grid(keyframes: Sequence[Keyframe]) -> list[Keyframe]:
    """Keyframes with depths on the grid of the first one: merged runs may have had others."""
    shape = keyframes[0].depths.shape
    return [
        one if one.depths.shape == shape else replace(one, depths=resize_nearest(one.depths, shape[::-1]))
        for one in keyframes
    ]


def load_places(path: Path, end: BackEnd) -> tuple[BackEnd, float]:
    """Read places.npz into a back end that has no node yet; return it, and the depth noise.

    Raises:
        ValueError: the file is damaged or of another version, or its descriptors are of another kind.
    """
    try:
        header, arrays = load_headed(path, HEADER)
        for name, array in arrays.items():
            if array.dtype.kind == "f" and name != "keyframes.points" and not np.isfinite(array).all():
                raise ValueError(f"{name} is not finite")
        has_one_unit = bool(header.get("has_one_unit", True))  # older files do not have it
        end = replace(end, has_one_unit=has_one_unit, **_fields(arrays, int(header["num_trained"])))
        return end, float(header["depth_noise"])
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(
            f"{path} holds no keyframes to continue from ({error}): map again with graph=default"
        ) from error


def first_node_of(path: Path) -> int:
    """Read how many nodes the run of a places.npz took over from a saved map; 0 in files of older versions."""
    return int(load_headed(path, HEADER)[0].get("first_node", 0))


def load_saved_map(
    folder: str | None, mode: str, config: BackEndConfig | None, intrinsics: Sequence[float], min_std: float
) -> SavedMap | None:
    """Load the map in the folder of a finished run; None without a folder.

    Args:
        mode: `extend` or `localize`.
        intrinsics: of the new images, which may be from another camera.

    Raises:
        ValueError: the folder is not that of a finished run with a back end, or a file of it cannot be used.
    """
    if mode not in MODES:
        raise ValueError(f"map_mode must be one of {', '.join(MODES)}, got {mode!r}")
    if folder is None:
        return None
    folder = Path(folder)
    if config is None:
        raise ValueError(f"map={folder} needs the keyframes of a back end: add graph=default")
    if not folder.is_dir():
        raise ValueError(f"map={folder} is no folder: give that of a finished run")
    if not (folder / METRICS_FILE).exists():
        raise ValueError(
            f"map={folder} has no {METRICS_FILE}, so its run is not finished: the same command with "
            f"hydra.run.dir={folder} goes on with it"
        )
    if not (folder / PLACES_FILE).exists():
        raise ValueError(f"map={folder} has no {PLACES_FILE}: map it again with graph=default")
    end, depth_noise = load_places(folder / PLACES_FILE, BackEnd(config, tuple(intrinsics), min_std))
    size = end.database.keyframes[0].depths.shape[::-1]
    if size != tuple(config.place_recognition.grid):
        raise ValueError(
            f"map={folder} was made with graph.place_recognition.grid=[{size[0]},{size[1]}]: give that here, too"
        )
    map = load_map(folder / MAP_FILE)
    births = np.asarray(map.birth)[np.asarray(map.gaussians.valid)]
    if len(births) == 0 or births.min() < 0 or births.max() >= len(end.nodes):
        raise ValueError(f"{folder}: {MAP_FILE} and {PLACES_FILE} are not of one run: map again")
    files = folder / MAP_FILE, folder / PLACES_FILE
    return SavedMap(map, end, depth_noise, mode == "localize", fingerprint(folder, files, {}))


def _fields(arrays: Mapping[str, np.ndarray], num_trained: int) -> dict[str, Any]:
    """Read nodes, keyframes and measurements, as fields of a back end."""
    poses, log_scales, frames, is_placed = (arrays[name] for name in NODES)
    count = len(poses)
    if poses.shape != (count, 4, 4) or not count == len(log_scales) == len(frames) == len(is_placed) > 0:
        raise ValueError(f"{count} nodes have {len(log_scales)} scales, {len(frames)} frames, {len(is_placed)} states")
    keyframes, words = _keyframes(arrays), arrays["words"]
    if words.ndim != 2 or words.shape[1] != DESCRIPTOR_SIZE:
        raise ValueError(f"words have shape {words.shape}, expected (k, {DESCRIPTOR_SIZE})")
    numbers = [one.frame for one in keyframes]
    if numbers != sorted(set(numbers)) or not 0 <= numbers[0] <= numbers[-1] < count:
        raise ValueError("keyframes are not nodes in their order")
    vectors = np.stack([vlad(unit_descriptors(one), words) for one in keyframes])
    edges = {**arrays, "edges.is_loop": arrays["edges.kind"] == 1}
    submaps = np.where(arrays.get("is_kept", np.ones(count, bool)), 0, LEFT_OUT)  # older files do not have it
    loops = {
        field: [LoopMeasurement(**row) for row in _rows(name, arrays, LoopMeasurement.__annotations__, count)]
        for name, field in LOOPS.items()
    }
    return {
        "nodes": tuple(
            map(
                Node,
                *[np.float64(poses)] * 2,
                *(values.tolist() for values in (log_scales, frames, submaps, is_placed)),
            )
        ),
        "factors": [Factor(**row) for row in _rows("edges", edges, OF_EDGES, count)],
        "database": Database(keyframes, words, vectors, num_trained),
        "first_node": count,
        "connected_since": count,
    } | loops


def _keyframes(arrays: Mapping[str, np.ndarray]) -> tuple[Keyframe, ...]:
    counts = arrays["keyframes.num_points"]
    pixels, descriptors, points = (arrays[f"keyframes.{name}"] for name in OF_POINTS)
    shapes = {"pixels": (pixels, 2), "descriptors": (descriptors, DESCRIPTOR_SIZE), "points": (points, 3)}
    for name, (array, width) in shapes.items():
        if array.shape != (counts.sum(), width):
            raise ValueError(f"keyframes.{name} have shape {array.shape}, expected {(int(counts.sum()), width)}")
    parts = [np.split(array, np.cumsum(counts)[:-1]) for array in (pixels, descriptors, points)]
    frames, intrinsics, sizes, depths = (arrays[f"keyframes.{name}"] for name in OF_KEYFRAMES)
    return tuple(
        Keyframe(int(frame), *of_points, tuple(map(float, camera)), tuple(map(int, size)), np.float32(depth))
        for frame, *of_points, camera, size, depth in zip(frames, *parts, intrinsics, sizes, depths, strict=True)
    )


def _table(name: str, records: Sequence[Any], fields: Iterable[str]) -> dict[str, np.ndarray]:
    """One array for each field of all records."""
    return {f"{name}.{field}": np.array([getattr(record, field) for record in records]) for field in fields}


def _rows(name: str, arrays: Mapping[str, np.ndarray], fields: Iterable[str], count: int) -> list[dict[str, Any]]:
    """Return the records from which `_table` was made, one dict each; a and b must be among `count` nodes."""
    columns = {field: arrays[f"{name}.{field}"] for field in fields}
    for field in ("a", "b"):
        if len(columns[field]) and not 0 <= columns[field].min() <= columns[field].max() < count:
            raise ValueError(f"{name}.{field} is no node")
    rows = zip(*columns.values(), strict=True)
    return [
        {field: value.item() if np.ndim(value) == 0 else value for field, value in zip(columns, row, strict=True)}
        for row in rows
    ]
