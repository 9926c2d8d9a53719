"""The files of a run: trajectory, map, Gaussians, densified points, mesh and the overview."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from emgs_jax.back_end.g2o import save_graph_g2o
from emgs_jax.back_end.saved_map import save_places
from emgs_jax.drawing.layers import closing_covariances, feature_colors
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.features.text import TextEmbeddings, save_text
from emgs_jax.gaussian_map import GaussianMap, confirmed
from emgs_jax.geometry import seen_from
from emgs_jax.io.files import atomic_write, remove_temporaries, write_json
from emgs_jax.io.map_file import save_map
from emgs_jax.io.mesh import save_mesh_ply
from emgs_jax.io.ply import save_gaussians_ply, save_points_ply
from emgs_jax.io.trajectory import from_tum, save_trajectory_tum
from emgs_jax.mapping.checkpoint import CHECKPOINT_FILE
from emgs_jax.mapping.event import NEW_SUBMAP
from emgs_jax.mapping.records import APART, UNJOINED, UNPLACED, FrameRecord, records_apart
from emgs_jax.mapping.run import MappingRun, row_of_first_node, with_truth
from emgs_jax.prior.base import Prior
from emgs_jax.render.densify import DensifyConfig
from emgs_jax.runs.back_end import loop_list, metric_graph
from emgs_jax.runs.dense import DenseMap, center_cloud
from emgs_jax.runs.finished_run import EXPORTS, FRAMES_FILE, LOOPS_FILE, POLISH, REPORT_FILE, TEXT_FILE

# metrics.json first: it makes a folder a finished result.
OUTPUTS = (
    *("metrics.json", "trajectory.txt", "trajectory_online.txt", "graph.g2o", LOOPS_FILE, "frames.jsonl"),
    *("map.npz", "submaps", "places.npz", "map.ply", "points.ply", "mesh.ply", "overview.png", TEXT_FILE, REPORT_FILE),
    *(CHECKPOINT_FILE, "query.json", "query.png", "semantic.npz", "semantic.ply", "features.png", "labels"),
    *EXPORTS,
    *POLISH,
)


def claim_folder(folder: Path, goes_on: bool = False) -> list[str]:
    """Claim a folder for a new run: move outputs of an earlier one to previous-1, previous-2, …; say what was done.

    So a run that ends early never lies beside the metrics of another one. Outputs of a run that `goes_on` stay.
    """
    notes = [f"removed {folder / name}, which a write that was killed has left" for name in remove_temporaries(folder)]
    old = [] if goes_on else [folder / name for name in OUTPUTS if (folder / name).exists()]
    if old:
        target = next(path for path in (folder / f"previous-{n}" for n in itertools.count(1)) if not path.exists())
        target.mkdir()
        for path in old:
            path.replace(target / path.name)
        notes.append(f"{folder} held outputs of an earlier run: they are in {target} now")
    return notes


def save_progress(folder: Path, run: MappingRun) -> None:
    """Write trajectory.txt and map.npz of the frames so far; nothing before there is a map.

    With a back end, also write places.npz, by which another run continues the map; trajectory_online.txt, the poses as
    they were when the frames were placed (in the unit of the finished map); graph.g2o; and loops.json. Frames that are
    apart are marked in frames.jsonl. Submaps that were never joined go to submaps/, by number.
    """
    _complete_lines(folder / FRAMES_FILE, run)
    if run.state is not None:
        rows = zip(run.records, run.poses, strict=True)
        placed = [(record, pose) for record, pose in rows if record.status not in UNPLACED]
        _save_path_and_map(folder, [record for record, _ in placed], [pose for _, pose in placed], run.state.map)
    for number, state in run.apart.items():  # in its own world and unit
        submap, records = folder / "submaps" / str(number), records_apart(run.records, number)
        submap.mkdir(parents=True, exist_ok=True)
        _save_path_and_map(submap, records, [record.pose for record in records], state.map)
    end = run.back_end
    if end is not None and end.database.keyframes and run.state is not None:
        save_places(folder / "places.npz", end, float(run.state.estimate.depth_noise))
    online = [] if end is None else [node.online for node in end.nodes[end.first_node :]]
    if online:
        rows = zip(run.records[-len(online) :], online, strict=True)
        placed = [(record.timestamp, pose) for record, pose in rows if record.status not in UNPLACED]
        times, poses = zip(*placed, strict=True) if placed else ((), np.zeros((0, 4, 4)))
        save_trajectory_tum(folder / "trajectory_online.txt", times, np.asarray(poses))
        write_json(folder / LOOPS_FILE, loop_list(end))
        if end.factors:  # a single frame has no measurements
            save_graph_g2o(folder / "graph.g2o", metric_graph(end))


def _save_path_and_map(folder: Path, records: Sequence[FrameRecord], poses: Sequence[np.ndarray], map: GaussianMap):
    times = [record.timestamp for record in records]
    save_trajectory_tum(folder / "trajectory.txt", times, np.reshape(poses, (-1, 4, 4)))
    save_map(folder / "map.npz", map)


def _complete_lines(path: Path, run: MappingRun) -> None:
    """Complete frames.jsonl at the end of a run.

    Add the first frame's covariance, mark frames that are apart, and write what later frames have shown to move.
    """
    is_complete = all(record.reason != UNJOINED and record.moving_pixels is None for record in run.records)
    if not path.exists() or (run.first_covariance is None and is_complete):
        return
    lines, records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()], iter(run.records)
    uncertain = [line for line in lines if line["covariance"] is not None]
    has_one_world = all(record.location != NEW_SUBMAP for record in run.records)  # poses as placed, of the first, too
    if run.first_covariance is not None and uncertain and has_one_world:
        first = next(line["pose"] for line in lines if line["pose"] is not None)
        placed = from_tum(np.array([first, *(line["pose"] for line in uncertain)]))
        added = seen_from(run.first_covariance, placed[0], placed[1:])
        for line, covariance in zip(uncertain, added, strict=True):
            line["covariance"] = (np.array(line["covariance"]) + covariance).tolist()
    for line in lines:
        record = None if line["status"] == "skipped" else next(records)
        if record is not None and record.moving_pixels is not None:
            line |= {"moving": record.moving, "moving_pixels": record.moving_pixels}
        if record is not None and record.reason == UNJOINED:
            line |= {name: getattr(record, name) for name in ("status", "reason", "submap")}
            line |= {} if record.status == APART else {"covariance": None}
    with atomic_write(path, "w") as handle:
        handle.writelines(json.dumps(line, allow_nan=False) + "\n" for line in lines)


def save_classes(folder: Path, prior: Prior) -> None:
    """Write text.npz, the embeddings of the classes; nothing without classes."""
    if prior.feature_names:
        about = prior.provenance.settings.get("features", {})  # of the model that made them, if there is one
        model, templates = about.get("model", {"prior": prior.provenance.name}), tuple(about.get("templates", ()))
        vectors = np.asarray(prior.text_features, np.float32)
        text = TextEmbeddings(tuple(prior.feature_names), vectors, templates, model)
        save_text(folder / TEXT_FILE, text)


def save_outputs(
    folder: Path,
    run: MappingRun,
    dense: DenseMap,
    config: DensifyConfig,
    title: str,
    with_scale: bool,
    unit: str = "m",
) -> list[str]:
    """Write the files that show the map; return what could not be made, and why.

    Args:
        with_scale: align the true path by a similarity, as it is scored, not by a rigid motion.
        unit: of the map's lengths, for the picture.
    """
    gaussians = jax.device_get(shown := confirmed(run.state.map))
    valid = gaussians.valid
    means, covs, normals = (values[valid] for values in (gaussians.means, gaussians.covs, gaussians.normals))
    rest = gaussians.colors[valid], float(config.render.opacity), normals
    save_gaussians_ply(folder / "map.ply", means, closing_covariances(means, covs, normals), *rest)
    labels = () if dense.labels is None else (dense.labels.labels, dense.labels.classes)
    save_points_ply(folder / "points.ply", dense.cloud.points, dense.cloud.normals, dense.cloud.colors, *labels)
    # matplotlib is slow to import, and the map does not wait for it
    from emgs_jax.drawing.overview import Paths, draw_overview

    centers = center_cloud(run)
    colored = dense.cloud.points, dense.cloud.colors
    no_mesh = save_mesh_ply(folder / "mesh.ply", centers.points, centers.normals, colored)
    is_placed = np.array([record.status not in UNPLACED for record in run.records])
    paths = Paths(np.stack(run.poses), is_placed, _placed_truth(run, with_scale), *_moved(run), unit=unit)
    features = None  # the centres in the colours of their features
    if gaussians.features[valid].any():
        features = replace(centers, colors=np.asarray(feature_colors(shown))[valid])
    classes = () if dense.labels is None else dense.labels.classes
    draw_overview(folder / "overview.png", dense.cloud, paths, dense.pictures, title, classes, features)
    return [] if no_mesh is None else [f"no mesh.ply: {no_mesh}"]


def _placed_truth(run: MappingRun, with_scale: bool) -> np.ndarray | None:
    """Align the true path (n, 4, 4) with the estimate, NaN where unknown; None if it is unknown altogether.

    A prior has its own frame and often its own unit, so without alignment an exact path would look as if it drifted.
    """
    known = with_truth(run, run.poses)
    if known is None:
        return None
    alignment, _ = align_poses(*known, with_scale)
    truth = np.stack([np.full((4, 4), np.nan) if pose is None else pose for pose in run.true_poses])
    return alignment.inverse().apply_to_poses(truth)


def _moved(run: MappingRun) -> tuple[np.ndarray | None, tuple[tuple[int, int], ...]]:
    """Return the path before the back end moved it, and its loops, for `Paths`."""
    end = run.back_end
    if end is None or not end.closures:  # frames that are only located in a saved map are no nodes beside its loops
        return None, ()
    shift = row_of_first_node(run) - end.first_node  # from a node to the row of its record
    loops = tuple((shift + loop.a, shift + loop.b) for loop in end.accepted if min(loop.a, loop.b) >= end.first_node)
    return np.stack([node.online for node in end.nodes[end.first_node :]]), loops
