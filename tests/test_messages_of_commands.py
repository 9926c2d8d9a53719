"""What commands say, see `messages`."""

import json
import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest import mock

import jax.numpy as jnp
import numpy as np
import pytest
import tiny_run
from loop_scene import keyframe, matrix
from loop_scene import room as walls
from omegaconf import OmegaConf
from scene import random_gaussians

import experiments.evaluate as evaluate_module
import experiments.polish as polish_module
from emgs_jax import load_config, save_map
from emgs_jax.back_end.saved_map import load_saved_map, save_places
from emgs_jax.back_end.state import BackEnd
from emgs_jax.config.configure import compose
from emgs_jax.gaussian_map import new_map
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.loop_closure.place_recognition import Database, add_keyframe
from emgs_jax.runs.results import METRICS_FILE, is_finished
from experiments.evaluate import plan
from experiments.export import export_run
from experiments.polish import polish_run
from experiments.query import query
from experiments.score import score
from experiments.segment import segment
from experiments.view import view
from tests.back_end.test_back_end import ring, walked
from tests.messages import Step, check_messages, gone, moved, put
from tests.report.test_segmentation_table import moved_run, write_truth
from tests.scripts.test_evaluate import made_up
from tests.scripts.test_score import SIMILARITY, room, write_system
from tests.written_run import written_run

pytestmark = pytest.mark.slow

GRID = "graph=default", "graph.place_recognition.grid=[8,6]"
PATH, PLY, OUT = "path.txt", "cloud.ply", "out"


def write_peer(root: Path) -> None:
    """Another system's path and cloud of the tiny room."""
    write_system(root, *room())


def path_with(change: Callable[[np.ndarray, np.ndarray], tuple]) -> Step:
    return lambda root: save_trajectory_tum(root / PATH, *change(*room()[:2]))


def read_score(root: Path, **keys) -> float:
    words = [f"trajectory={root / PATH}", f"points={root / PLY}", "method=peer", f"out={root / OUT}"]
    return score(tiny_run.compose(*words, *(f"{key}={value}" for key, value in keys.items()), name="score"))[0]


def cloud_of(points: np.ndarray) -> Step:
    return lambda root: save_points_ply(root / PLY, points, 0 * points, 0 * points)


SPREAD = np.random.default_rng(0).normal(size=(99, 3))
FAR = np.concatenate([SPREAD, [[1e9, 0, 0]]])
TEXT_PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"


OF_SCORE = [
    (path_with(lambda times, poses: (2 * times, poses)), r"or accept fewer \(min_associated_percent\)"),
    (path_with(lambda times, poses: (times + 0.05, poses)), "raise max_time_difference"),
    (
        (path_with(lambda times, poses: (times[3:], poses[3:])), {"dataset.stop": 3}),
        r"choose the same frames \(dataset.start, stop, stride\)",
    ),
    (path_with(lambda times, poses: (times, np.linalg.inv(poses))), "as world -> camera: expected are"),
    (path_with(lambda times, poses: ([*times, *times], [*poses, *SIMILARITY.apply_to_poses(poses)])), "keep one path"),
    (gone(PATH), "path.txt is no file: give a file with `timestamp tx ty tz qx qy qz qw`"),
    (put(PATH, "1 2 3\n"), "path.txt:1: expected `timestamp tx ty tz qx qy qz qw`"),
    (gone(PLY), "cloud.ply is no file: give a PLY file"),
    (put(PLY, "# nothing\n"), "cloud.ply is no PLY file .*: give a PLY file"),
    (cloud_of(SPREAD[:0]), "cloud.ply has no points: write the points of the map as PLY"),
    (cloud_of(FAR), "give the points in metres, and without stray ones"),
    (put(PLY, f"{TEXT_PLY}{CORNERS}nan 0 0\n"), "1 of 4 points are not finite .*: leave them out of the file"),
    ({"method": "a/b"}, "must be a name that is one folder below .*: choose another"),
]


def read_plan(root: Path, *words: str, **keys) -> int:
    """Jobs of an evaluation of which one has a result, of other settings where the words say so."""
    given = [f"out={root / OUT}", *words, *(f"{key}={value}" for key, value in keys.items())]
    settings = OmegaConf.to_container(compose("suite=smoke", *given, name="evaluate"), resolve=True)
    return len([is_finished(job.folder, OmegaConf.to_container(job.config, resolve=True)) for job in plan(settings)])


def write_finished(root: Path) -> None:
    read_evaluation(root, OUT)


OF_EVALUATION = [
    ({"overrides": "'[prior.seed=3]'"}, r"give (seeds)=\[…\]"),
    ({"overrides": "'[dataset=tum]'"}, "give suite=NAME"),
    ({"overrides": "'[prior=multiview_stereo]'", "seeds": "'[0,1]'"}, r"give one seed, seeds=(\[0\])"),
]


def written_with_points(root: Path) -> None:
    save_points_ply(written_run(root / "run") / "points.ply", SPREAD, SPREAD, np.clip(np.abs(SPREAD), 0, 1))


def read_export(root: Path, **keys) -> list[Path]:
    given = {"formats": "[frustums]"} | keys
    return export_run(
        compose(f"folder={root / 'run'}", *(f"{key}={value}" for key, value in given.items()), name="export")
    )


OF_EXPORT = [
    ({"formats": "'[obj]'"}, "formats=obj is not known: choose of (colmap), nerfstudio"),
    ({"formats": "'[]'"}, "writes nothing: give (colmap), nerfstudio or frustums"),
    ((gone("run/points.ply"), {"formats": "'[colmap]'"}), "lacks points.ply, which formats=colmap needs: run again"),
    ({"images": "large", "formats": "'[colmap]'"}, "images must be one of (used), original"),
    (gone("run/metrics.json"), "finished run: it lacks metrics.json; run it to its end"),
    *(
        ({"length": f"'{given}'"}, r"length must be \[frame,frame,metres\]")
        for given in ([1, 5], [1, 5, 0], [1.5, 5, 2])
    ),
    ({"length": "'[1,9,2]'"}, "frame 9 is none of the run's"),
    ({"length": "'[1,3,2]'"}, "frame 3 is lost, so its pose is a guess"),
    ({"length": "'[1,1,2]'"}, "these two cameras are at one place"),
    ({"scale": "0"}, "scale must be .*, got 0"),
    ({"scale": "2", "length": "'[1,5,2]'"}, "give one of them"),
]


def read_answer(root: Path, words: str | None = "sofa", **keys) -> dict:
    given = {"map": root / "run", "text": words} | keys
    return query(
        compose(*(f"{key}={'null' if value is None else value}" for key, value in given.items()), name="query")
    )


LINE_OF_POSE = "1 0 0 0 0 0 0 1\n"


OF_QUERY = [
    ({"words": None}, "nothing is asked: give text=chair, text=.chair,table. or classes=FILE"),
    ({"words": "soaf"}, r"the nearest are (\w+)\."),
    ({"words": "xyz"}, r"there are wall, (\w+)\."),
    ({"words": "'[sofa,sofa]'"}, "none empty and each once"),
    ({"words": "1"}, "text must be a word or a list of words, none empty and each once, got 1"),
    ({"words": "sofa", "against": "true"}, "against must be a word or a list of words"),
    ({"words": "sofa", "against": "lamp"}, "'lamp' is no word of"),
    ({"words": None, "classes": "nowhere.txt"}, "class file nowhere.txt does not exist"),
    ({"instances.reach": "0"}, "instances.reach must be a number"),
    ({"features.text": "nowhere.npz"}, "nowhere.npz is no file"),
    ({"against": "sofa"}, "asked for too: leave it out of one"),
    ((put("p.txt", LINE_OF_POSE), {"frame": 1, "pose": "{root}/p.txt"}), "both say from where to draw"),
    ({"frame": 77}, r"no pose of frame=77: choose one from (\d) to \d"),
    ({"pose": "{root}/p.txt"}, "is no file: give lines `timestamp tx ty tz qx qy qz qw`"),
    ((put("p.txt", "# \n"), {"pose": "{root}/p.txt"}), "has no pose: give lines"),
    ({"map": "{root}/nowhere"}, "is no folder: give the one that a run wrote"),
]


@cache
def end() -> BackEnd:
    graph = load_config(*GRID).graph
    database = add_keyframe(Database(), keyframe(walls(), matrix(), 0), graph.place_recognition)
    return replace(walked(graph, ring()), database=database)


def write_mapped(root: Path, birth: int = 19) -> None:
    """What a later run reads of a finished one."""
    (root / "run").mkdir(exist_ok=True)
    save_places(root / "run/places.npz", end(), 0.01)
    map = new_map(random_gaussians(20), jnp.ones(20), jnp.ones(()), jnp.asarray(birth, jnp.int32))
    save_map(root / "run/map.npz", map)
    put("run/metrics.json", "{}")(root)


def read_mapped(root: Path, words: Sequence[str] = GRID, folder: str = "run", mode: str = "extend") -> int:
    return load_saved_map(str(root / folder), mode, load_config(*words).graph, (300.0, 300.0, 160.0, 120.0), 0.01).count


OF_MAP = [
    ({"words": ()}, "needs the keyframes of a back end: add (graph=default)"),
    ({"mode": "track"}, "map_mode must be one of (extend), (localize)"),
    ({"folder": "walk"}, "is no folder: give that of a finished run"),
    (gone("run/metrics.json"), r"the same command with hydra.run.dir=\S+run goes on"),
    (gone("run/places.npz"), "has no places.npz: map it again with graph=default"),
    (put("run/places.npz", b"PK"), "no keyframes to continue from .*: map again with"),
    ({"words": ("graph=default",)}, r"was made with (graph.place_recognition.grid=\[8,6\]): give that here"),
    (lambda root: write_mapped(root, 99), "are not of one run: map again"),
]


def write_scored(root: Path) -> None:
    write_truth(root / "truth", moved_run(root / "run"))


def read_segmentation(root: Path, **keys) -> str:
    given = {"map": str(root / "run"), "truth": str(root / "truth"), "out": str(root / "out")}
    given |= {"classes": str(root / "truth/classes.txt")} | keys
    return segment(OmegaConf.merge(compose("map=a", "truth=b", name="segment"), given))[1]


TRUE_IDS = "truth/room.txt"


OF_SEGMENT = [
    ({"map": "[{root}/run,{root}/run]"}, "names a folder twice, .*: give each once"),
    ({"scenes": ["a", "b"]}, "give one name for each map"),
    ({"classes": None}, "has ids only: give their class file"),
    (
        (moved(TRUE_IDS, "truth/office0.txt"), moved("truth/room_mesh.ply", "truth/office0_mesh.ply")),
        r"lacks room_mesh.ply, room.txt: give the folder with .* or name the scenes \(scenes=(\[office0\])\)",
    ),
    (put(TRUE_IDS, "5\n9\n"), "has 2 labels and .*: fetch both files of the same mesh"),
    (put(TRUE_IDS, "wall\n"), "is no list of whole numbers, .*: fetch it again"),
    (put(TRUE_IDS, f"5\n{'9' * 30}\n"), "is no list of whole numbers, .*: fetch it again"),
    (put("truth/classes.txt", "5 wall\n"), "give the class file of this data set"),
    (put("truth/classes.txt", "5 wall\n9 lamp\n"), r"there are wall"),
]


def read_gated(root: Path, **keys) -> bool:
    return read_evaluation(root, **{"gate": "gate.yaml"} | keys)


def read_evaluation(root: Path, out: str = "out", **keys) -> bool:
    """An evaluation whose runs only write what they are of."""
    given = {key: root / value if key in FILES and value else value for key, value in keys.items()}
    words = [f"{key}={'null' if value is None else value}" for key, value in given.items()]
    with mock.patch.object(evaluate_module, "run", made_up):
        settings = compose("suite=smoke", f"out={root / out}", *words, name="evaluate")
        return not evaluate_module.evaluate(OmegaConf.to_container(settings, resolve=True))


FILES = "gate", "rounded", "write_gate"


def evaluated(**keys) -> Step:
    def run(root):
        read_evaluation(root, **keys)

    return run


def of_other_code(root: Path) -> None:
    for path in (root / "out").rglob(METRICS_FILE):
        content = json.loads(path.read_text())
        content["provenance"]["versions"]["emgs_jax"] = "0"
        path.write_text(json.dumps(content))


OF_GATE = [
    (gone("gate.yaml"), "gate.yaml is no file: write one with .* write_gate=FILE"),
    (put("gate.yaml", "["), "is no baseline .*: write one with .* write_gate=FILE"),
    ({"shard": "1/2"}, "a gate needs the results of all jobs: run once more without shard"),
    ({"shard": "0/2", "gate": None}, r"such as (\d/\d), got"),
    (of_other_code, "the current code: choose another out=FOLDER, or move them away"),
    ({"gate": None, "write_gate": "new.yaml", "rounded": "again"}, ": evaluate into it first"),
    (
        (evaluated(out="again"), {"gate": None, "write_gate": "new.yaml", "rounded": "again"}),
        r"at least 5 are needed for tolerances: evaluate seeds=(\[\S+\]) into both folders",
    ),
]


def read_polish(root: Path, folder: str = "run", words: Sequence[str] = ()) -> str:
    """What is looked at before splats are fitted."""
    config = compose(f"folder={root / folder}", *words, name="polish")
    with mock.patch.multiple(polish_module, polish=lambda *_: {"splats": 1}, write_report=lambda *_: None):
        return polish_run(config)


OF_POLISH = [
    ({"words": ["polish=none"]}, "choose (polish=default)"),
    ({"folder": "walk"}, "is no folder: give the one that a run wrote"),
    (gone("run/map.npz"), "holds no finished run: it lacks map.npz; run it to its end"),
]


def read_view(root: Path, port: int | None = None, folder: str = "run") -> bool:
    """Serve a run at a port; None: at one that is taken."""
    pytest.importorskip("viser", reason="serves runs: pip install -e .[viewer]")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1] if port is None else port
        view(compose(f"folder={root / folder}", f"port={port}", name="view")).stop()
    return True


FREE = {"port": 8123}


OF_VIEW = [
    ({}, r"is taken by another program, .* such as port=(\d+)$"),
    ({"folder": "walk"} | FREE, "give the one that a run wrote, with metrics.json in it"),
    ((gone("run/trajectory.txt"), FREE), "lacks trajectory.txt; run it to its end"),
]


TABLES = {
    "map": (write_mapped, read_mapped, OF_MAP),
    "segment": (write_scored, read_segmentation, OF_SEGMENT),
    "gate": (lambda root: read_evaluation(root, write_gate="gate.yaml"), read_gated, OF_GATE),
    "polish": (written_with_points, read_polish, OF_POLISH),
    "view": (written_with_points, read_view, OF_VIEW),
    "score": (write_peer, read_score, OF_SCORE),
    "evaluate": (write_finished, read_plan, OF_EVALUATION),
    "export": (written_with_points, read_export, OF_EXPORT),
    "query": (written_with_points, read_answer, OF_QUERY),
}


@pytest.mark.parametrize("name", TABLES)
def test_each_message_says_what_is_wrong_and_what_to_do(name, tmp_path):
    check_messages(tmp_path, *TABLES[name])
