"""Merge finished runs: read their folders, join their maps, and write the files of one run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from emgs_jax.back_end.saved_map import PLACES_FILE, SavedMap, first_node_of, load_places
from emgs_jax.back_end.state import BackEnd, Node
from emgs_jax.config.configure import CONF, build, build_dataset, compose, graph_config, message_of
from emgs_jax.data.joined import common_camera, joined_name
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds
from emgs_jax.features.text import save_text
from emgs_jax.io.files import FrameLog, new_folder
from emgs_jax.io.trajectory import from_tum
from emgs_jax.keypoints.sift import mutual
from emgs_jax.loop_closure.place_recognition import Keyframe, unit_descriptors
from emgs_jax.mapping.atlas import Atlas, set_unjoined_apart, unvisited
from emgs_jax.mapping.integrate import finish_back_end
from emgs_jax.mapping.merging import beside, join, motion, with_lost, without_repeats
from emgs_jax.mapping.records import FrameRecord, to_line, with_moved_nodes, with_unjoined_apart
from emgs_jax.mapping.run import MappingRun, with_truth
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import SCALE_STD_KEY, UP_KEYS
from emgs_jax.runs.dense import DenseMap, center_cloud, dense_map, voxel_of
from emgs_jax.runs.files import save_outputs, save_progress
from emgs_jax.runs.finished_run import FRAMES_FILE, POINTS_FILE, TEXT_FILE, FinishedRun, read_run
from emgs_jax.runs.kept_points import moved_parts, moved_points, read_points
from emgs_jax.runs.metrics import Scorer, describe, score_back_end, score_map, true_cloud
from emgs_jax.runs.provenance import git_now, write_metrics
from emgs_jax.runs.repeat import repeat
from emgs_jax.runs.results import METRICS_FILE

OF_DATA = "name", "sequence"  # keys of a provenance's data
MIN_SAME, MAX_MOVED = 0.5, 0.02  # keypoints that an image has again, and how far off, of its longer side


@dataclass(frozen=True)
class MergeableRun:
    """A finished run to be merged, with a node for each of its records."""

    finished: FinishedRun
    atlas: Atlas
    records: tuple[FrameRecord, ...]


def mergeable(folder: Path) -> MergeableRun:
    """Read a finished run; raise ValueError if it has no keyframes for place recognition."""
    run = read_run(folder)
    config = config_of(run)
    slam, graph = build(config, "slam").in_unit(run.metre), graph_config(config)
    if graph is None or run.online is None or not (folder / PLACES_FILE).is_file():
        raise ValueError(
            f"{folder} has no keyframes of its own by which its places are found: map it again with graph=default"
        )
    end, depth_noise = load_places(folder / PLACES_FILE, BackEnd(graph, _camera_of(run)[1], float(slam.fit.min_std)))
    records = tuple(record_of(line, pose) for line, pose in zip(run.frames, run.poses, strict=True))
    end, lost = with_records(end, records, run.online, first_node_of(folder / PLACES_FILE))
    slam = replace(slam, submap=replace(slam.submap, map_capacity=run.map.weight.shape[0]))
    known = unvisited(SavedMap(run.map, end, depth_noise, is_frozen=False, checksum=""), run.camera, slam)
    return MergeableRun(run, with_lost(Atlas(run.camera, slam, end, {0: known}), lost), records)


def config_of(run: FinishedRun) -> DictConfig:
    """Return the config of a run, with infinities, which metrics.json cannot hold."""
    return compose(*repeat(run.provenance["config"]).words)


def record_of(line: Mapping[str, Any], pose: np.ndarray) -> FrameRecord:
    """Read a record from its line of frames.jsonl; `pose` is the final one."""

    known = {field.name: line[field.name] for field in fields(FrameRecord) if field.name in line}
    for name, value in known.items():
        if name.endswith("pose") and value is not None:
            known[name] = from_tum(np.array([value], np.float64))[0]
    return FrameRecord(**known | {"pose": pose})


def with_records(
    end: BackEnd, records: Sequence[FrameRecord], online: np.ndarray, first: int
) -> tuple[BackEnd, Sequence[Node]]:
    """Add the records' data to the nodes, and make nodes for frames before the map began.

    Args:
        online: poses as first estimated, nan before the map began and where a frame is not placed.
        first: number of nodes that are of a saved map.
    """
    lead = len(records) - (len(end.nodes) - first)
    lost = [Node(record.pose, record.pose, 0.0, record.index, is_placed=False) for record in records[:lead]]

    def told(node: Node, record: FrameRecord, pose: np.ndarray) -> Node:
        covariance = None if record.covariance is None else np.array(record.covariance)
        noise = record.depth_noise if record.status == "tracked" else None
        pose = pose if np.isfinite(pose).all() else node.pose
        return replace(node, online=pose, covariance=covariance, depth_noise=noise, origin=record.origin)

    known = map(told, end.nodes[first:], records[lead:], online[lead:])
    return replace(end, nodes=(*end.nodes[:first], *known), first_node=first), lost


def check_features(first: FinishedRun, other: FinishedRun) -> None:
    """ValueError where the features of two runs are of other models, or mean other classes."""
    one, two = first.text, other.text
    if one is None or two is None:
        return
    is_one_space = one.model == two.model and one.vectors.shape[1] == two.vectors.shape[1]
    if is_one_space:
        is_same_name = np.array([[a == b for b in two.names] for a in one.names])
        is_same_vector = np.isclose(one.vectors[:, None], two.vectors, atol=1e-5).all(-1)
        is_one_space = (is_same_name == is_same_vector).all()
    if not is_one_space:
        raise ValueError(
            f"features of {other.folder} ({', '.join(two.names[:3])}, …) are not those of {first.folder} "
            f"({', '.join(one.names[:3])}, …): map both with the same features= and the same classes"
        )


@dataclass(frozen=True)
class Merged:
    """Runs that are joined.

    Args:
        run: with all frames of all runs, one run after the other.
        order: of the runs; those that are joined come first.
        reasons: why a run is not joined.
        kept: the row in `run.records` that stands for each one: its own, or that of the same image in another run.
    """

    run: MappingRun
    order: list[int]
    reasons: dict[int, str]
    kept: list[int]


def merged(runs: Sequence[MergeableRun], has_truth: bool) -> Merged:
    """Join all runs with the first one, each by common images or places with a run that is already joined.

    Without `has_truth` the true poses are not in one world, and are left out. ValueError if none can be joined with the
    first, or if features mean something else.
    """
    for other in runs[1:]:
        check_features(runs[0].finished, other.finished)
    atlas, order, pending, reasons = runs[0].atlas, [0], [*range(1, len(runs))], {}
    images = [*range(len(runs[0].records))]  # the first row of the image of each
    while pending:
        for number in pending:
            shared = shared_frames([runs[one] for one in order], runs[number])
            found = join(atlas, runs[number].atlas, shared)
            if isinstance(found, Atlas):
                break
            reasons[number] = found
        else:
            break
        atlas, order, known = found, [*order, number], {row: images[one] for one, row in reversed(shared)}
        begin = len(images)
        images += [known.get(row, begin + row) for row in range(len(runs[number].records))]
        pending.remove(number)
        reasons.pop(number, None)
    if len(order) == 1:
        why = "; ".join(f"{runs[number].finished.folder}: {reason}" for number, reason in reasons.items())
        raise ValueError(f"none can be joined with {runs[0].finished.folder}, so there is no merged run: {why}")
    for number in pending:
        atlas, order = beside(atlas, runs[number].atlas), [*order, number]
        images += range(len(images), len(images) + len(runs[number].records))
    atlas = set_unjoined_apart(atlas, kept=0)
    records = enumerate(record for number in order for record in runs[number].records)
    records = [replace(one, index=row, true_pose=one.true_pose if has_truth else None) for row, one in records]
    records = with_unjoined_apart(records, atlas.graph.nodes, kept=0)
    atlas = numbered(finish_back_end(atlas))
    records = with_moved_nodes(records, (), atlas.graph.nodes)
    records = in_one_world(records, [runs[number] for number in order], atlas)
    is_placed = [node.is_placed for node in atlas.graph.nodes[atlas.graph.first_node :]]
    return Merged(MappingRun(atlas, records=records), order, reasons, first_placed(images, is_placed))


def shared_frames(parts: Sequence[MergeableRun], other: MergeableRun) -> list[tuple[int, int]]:
    """Pair the frames of runs, counted one run after the other, with those of another run that are the same image.

    Frames are the same if they have one name and time, and those that are keyframes in both are of the same image.
    """
    pairs, begin, keyframes = [], 0, keyframes_of(other)
    rows = {(record.name, record.timestamp): row for row, record in enumerate(other.records)}
    for part in parts:
        names = ((record.name, record.timestamp) for record in part.records)
        found = [(row, rows[name]) for row, name in enumerate(names) if name in rows]
        known = keyframes_of(part)
        same = [is_same_image(known[a], keyframes[b]) for a, b in found if a in known and b in keyframes]
        pairs += [(begin + a, b) for a, b in found] if same and all(same) else []
        begin += len(part.records)
    return pairs


def keyframes_of(run: MergeableRun) -> dict[int, Keyframe]:
    """Return the keyframes of a run's own frames by row."""
    graph = run.atlas.graph
    return {one.frame - graph.first_node: one for one in graph.database.keyframes if one.frame >= graph.first_node}


def is_same_image(a: Keyframe, b: Keyframe) -> bool:
    """Test whether two keyframes are of one image: most keypoints of it are there, and where they were.

    Not to the pixel: runs that estimate the intrinsics straighten the image a little differently.
    """
    if a.size != b.size:
        return False
    rows_a, rows_b = mutual(unit_descriptors(a), unit_descriptors(b), max_ratio=1.0)
    moved = np.linalg.norm(a.pixels[rows_a] - b.pixels[rows_b], axis=1)
    return (moved < MAX_MOVED * max(a.size)).sum() >= MIN_SAME * min(len(a.pixels), len(b.pixels))


def first_placed(images: Sequence[int], is_placed: Sequence[bool]) -> list[int]:
    """For each row, find the first one of its image that is placed, or the first if none is."""
    found: dict[int, int] = {}
    for row, image in enumerate(images):
        if image not in found or (is_placed[row] and not is_placed[found[image]]):
            found[image] = row
    return [found[image] for image in images]


def each_once(run: MappingRun, kept: Sequence[int]) -> MappingRun:
    """Leave out the frames for which another one stands, see `Merged`."""
    atlas = numbered(without_repeats(run.atlas, kept))
    rows = [row for row, one in enumerate(kept) if row == one]
    nodes = atlas.graph.nodes[atlas.graph.first_node :]
    records = [
        replace(run.records[row], index=new, origin=node.origin)
        for new, (row, node) in enumerate(zip(rows, nodes, strict=True))
    ]
    return replace(run, atlas=atlas, records=records)


def in_one_world(records: Sequence[FrameRecord], parts: Sequence[MergeableRun], atlas: Atlas) -> list[FrameRecord]:
    """Convert the other poses and node numbers in the records to the world and numbers of the merged run.

    The first mapped frame of each run was placed at its raw pose, so raw poses move in the same way.
    """
    found, nodes = [], atlas.graph.nodes[atlas.graph.first_node :]
    for part in parts:
        before, begin = part.atlas.graph.nodes[part.atlas.graph.first_node :], len(found)
        first = next((row for row, node in enumerate(before) if node.is_placed), 0)
        similarity = motion(before[first], nodes[begin + first])
        for record, node in zip(records[begin : begin + len(before)], nodes[begin:], strict=False):
            poses = {name: getattr(record, name) for name in ("raw_pose", "newest_pose")}
            moved = {name: pose if pose is None else similarity.apply_to_poses(pose) for name, pose in poses.items()}
            found.append(replace(record, origin=node.origin, **moved))
    return found


def numbered(atlas: Atlas) -> Atlas:
    """Renumber the nodes of all records by the frames of the merged run."""
    first = atlas.graph.first_node
    nodes = tuple(
        replace(node, frame=row - first) if row >= first else node for row, node in enumerate(atlas.graph.nodes)
    )
    return replace(atlas, graph=replace(atlas.graph, nodes=nodes))


def merge(folders: Sequence[Path], out: Path, has_truth: bool = True) -> tuple[dict[str, Any], list[str]]:
    """Write a merged run into a new folder, with unit and world of the first run.

    Returns its metrics, and notes: which run was not joined and why, and what could not be made.
    """
    read = [mergeable(folder) for folder in folders]
    found = merged(read, has_truth)
    with new_folder(out) as new:
        return save_merged(new, read, found, has_truth)


def save_merged(
    folder: Path, read: Sequence[MergeableRun], found: Merged, has_truth: bool
) -> tuple[dict[str, Any], list[str]]:
    """Write the files of a merged run; return what `merge` does."""
    order, reasons, run = found.order, found.reasons, each_once(found.run, found.kept)
    parts = [read[number].finished for number in order]
    joined = [read[number] for number in order if number not in reasons]
    keeps_points = all(_has_own_points(one.finished) for one in joined)
    repeated = [row for row, one in enumerate(found.kept) if row != one]
    origin, dataset, note = _origin(parts, (has_truth, repeated), "own" if keeps_points else "map")
    config = config_of(parts[0])
    densify, evaluation = build(config, "densify").in_unit(parts[0].metre), build(config, "evaluation")
    densify = replace(densify, points="map")
    (width, height), (fx, fy, cx, cy) = origin["data"]["frames"].values()
    run = replace(run, atlas=replace(run.atlas, camera=Camera((fx, fy), (cx, cy), width, height)))
    with FrameLog(folder / FRAMES_FILE) as log:
        for record in run.records:
            log.append(to_line(record))
    save_progress(folder, run)
    dense = DenseMap(center_cloud(run)) if dataset is None else dense_map(run, dataset, densify, evaluation)
    if keeps_points:
        voxel = voxel_of(with_truth(run, run.poses), evaluation)
        dense = replace(dense, cloud=kept_cloud(joined, found.run.atlas.graph.nodes, voxel))
    metrics = {}
    if dataset is not None:
        scorer = Scorer(dataset, evaluation, true_cloud(dataset, evaluation), None, None, parts[0].is_metric)
        metrics = score_map(run, dense.cloud, center_cloud(run), None, scorer) | dense.rendering
    title, unit = f"{len(order) - len(reasons)} runs merged", "m" if parts[0].is_metric else "units"
    notes = save_outputs(folder, run, dense, densify, title, evaluation.alignment == "sim3", unit)
    if parts[0].text is not None:
        save_text(folder / TEXT_FILE, parts[0].text)
    metrics |= describe(run) | score_back_end(run) | world_of(parts[0], found.kept) | {"provenance": origin}
    write_metrics(folder / METRICS_FILE, metrics)
    apart = [f"{read[n].finished.folder} is not joined, and in submaps/ as it is: {why}" for n, why in reasons.items()]
    return metrics, [*apart, *notes, *filter(None, [note])]


def world_of(first: FinishedRun, kept: Sequence[int]) -> dict[str, Any]:
    """Choose what is known of the unit and of up in the first run, whose world the merged one has.

    Up is known by a frame, which gets its number in the merged run; `kept` is that of `Merged`.
    """
    known = {key: first.metrics[key] for key in (SCALE_STD_KEY, *UP_KEYS) if key in first.metrics}
    index = known.get(UP_KEYS[-1])
    rows = [row for row, frame in enumerate(first.frames) if frame["index"] == index]
    number = {UP_KEYS[-1]: sum(one == row for row, one in enumerate(kept[: kept[rows[0]]]))} if rows else {}
    return known | number


def kept_cloud(parts: Sequence[MergeableRun], nodes: Sequence[Node], voxel: float) -> PointCloud:
    """Average the points of all joined runs, moved with their nodes into their common map, in voxels."""
    moved = moved_parts([part.atlas for part in parts], nodes)
    clouds = (
        moved_points(read_points(part.finished.folder / POINTS_FILE), one, part.atlas.graph.config.deform)
        for part, one in zip(parts, moved, strict=True)
    )
    return fuse_clouds(clouds, voxel)


def _has_own_points(run: FinishedRun) -> bool:
    return run.provenance["config"]["densify"].get("points") == "own" and (run.folder / POINTS_FILE).is_file()


def _origin(
    parts: Sequence[FinishedRun], shown: tuple[bool, Sequence[int]], points: str
) -> tuple[dict[str, Any], ReadableFrames | None, str]:
    """Make the provenance of a merged run with such `points`, its images, and the reason if there are none.

    Args:
        shown: has_truth and the repeated rows of `ImagesOfRuns`.
    """
    first = parts[0].provenance
    settings = OmegaConf.to_container(OmegaConf.create(dict(first["config"])), resolve=True)
    images = {"_target_": OmegaConf.load(CONF / "merge.yaml").dataset["_target_"], "has_truth": shown[0]}
    images |= {"runs": [str(one.folder.resolve()) for one in parts], "repeated": [*shown[1]]}
    settings |= {"dataset": images, "map": None, "on_bad_frame": "error"}
    settings["densify"] |= {"points": points}
    if "masks" in settings:
        settings["masks"] |= {"folder": None, "classes": None, "names": None}  # each run has its own
    try:
        dataset, note = build_dataset(OmegaConf.create(settings)), ""
    except (ValueError, OSError, InstantiationException) as error:
        dataset, note = None, f"colours are those of the Gaussians, for images are gone: {message_of(error)}"
    data = {key: joined_name(one.provenance["data"][key] for one in parts) for key in OF_DATA}
    size, intrinsics = common_camera([_camera_of(one) for one in parts])
    data |= {"fingerprint": dataset and dataset.fingerprint(), "camera": {}}
    origin = {"config": settings, "git": git_now(), "simulated": any(one.provenance["simulated"] for one in parts)}
    return first | origin | {"data": data | {"frames": {"size": size, "intrinsics": intrinsics}}}, dataset, note


def _camera_of(run: FinishedRun) -> tuple[tuple[int, int], tuple[float, float, float, float]]:
    """Return size and intrinsics of a run's images, exactly."""
    known = run.provenance["data"]["frames"]
    return tuple(known["size"]), tuple(known["intrinsics"])
