"""Advice of commands and of what they write, see `advice`."""

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
from omegaconf import DictConfig, OmegaConf
from scene import random_gaussians

import experiments.evaluate as evaluate_module
import experiments.polish as polish_module
import tools.tables as tables_module
from emgs_jax import load_config, save_map
from emgs_jax.back_end.saved_map import load_saved_map, save_places
from emgs_jax.back_end.state import BackEnd
from emgs_jax.config.configure import compose
from emgs_jax.features.text import TextEmbeddings, save_text
from emgs_jax.gaussian_map import new_map
from emgs_jax.io.files import write_json
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.loop_closure.place_recognition import Database, add_keyframe
from emgs_jax.report.results import METRICS_FILE, is_finished
from experiments.evaluate import plan
from experiments.export import export_run
from experiments.polish import polish_run
from experiments.query import query
from experiments.score import score
from experiments.segment import segment
from experiments.view import view
from tests.advice import (
    Said,
    Step,
    check_helps,
    each_remedy,
    edit,
    fetched,
    gone,
    moved,
    put,
    sound_files,
)
from tests.back_end.test_back_end import ring, walked
from tests.report.test_segmentation_table import moved_run, write_truth
from tests.report.written_run import written_run
from tests.scripts.test_evaluate import made_up
from tests.scripts.test_score import SIMILARITY, room, write_system
from tests.scripts.test_tables import ONE_COMMIT, written

GRID = "graph=default", "graph.place_recognition.grid=[8,6]"
PATH, PLY, OUT = "path.txt", "cloud.ply", "out"


def write_peer(root: Path) -> None:
    """Another system's path and cloud of the tiny room."""
    write_system(root, *room())


def path_with(change: Callable[[np.ndarray, np.ndarray], tuple]) -> Step:
    return lambda root, said: save_trajectory_tum(root / PATH, *change(*room()[:2]))


def read_score(root: Path, **keys) -> float:
    words = [f"trajectory={root / PATH}", f"points={root / PLY}", "method=peer", f"out={root / OUT}"]
    return score(tiny_run.compose(*words, *(f"{key}={value}" for key, value in keys.items()), name="score"))[0]


def cloud_of(points: np.ndarray) -> Step:
    return lambda root, said: save_points_ply(root / PLY, points, 0 * points, 0 * points)


SPREAD = np.random.default_rng(0).normal(size=(99, 3))
FAR = np.concatenate([SPREAD, [[1e9, 0, 0]]])
TEXT_PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"
SE3 = {"evaluation.alignment": "se3"}
OF_SCORE = [
    (
        path_with(lambda times, poses: (2 * times, poses)),
        r"3 of 6 poses.*: write the data set's timestamps .* or accept fewer \(min_associated_percent\)",
        *(fetched(PATH), {"min_associated_percent": 50}),
    ),
    (path_with(lambda times, poses: (times + 0.05, poses)), "raise max_time_difference", {"max_time_difference": 0.06}),
    (
        (path_with(lambda times, poses: (times[3:], poses[3:])), {"dataset.stop": 3}),
        r"choose the same frames \(dataset.start, stop, stride\)",
        {"dataset.stop": 6},
    ),
    (path_with(lambda times, poses: (times, np.linalg.inv(poses))), "as world -> camera: expected are"),
    (
        path_with(lambda times, poses: ([*times, *times], [*poses, *SIMILARITY.apply_to_poses(poses)])),
        "keep one path, with all digits of its times",
        *(fetched(PATH), path_with(lambda times, poses: ([*times, *times + 0.001], [*poses, *poses]))),
    ),
    (gone(PATH), "path.txt is no file: give a file with `timestamp tx ty tz qx qy qz qw`"),
    (put(PATH, "1 2 3\n"), "path.txt:1: expected `timestamp tx ty tz qx qy qz qw`"),
    (gone(PLY), "cloud.ply is no file: give a PLY file"),
    (put(PLY, "# nothing\n"), "cloud.ply is no PLY file .*: give a PLY file", fetched(PLY)),
    (cloud_of(SPREAD[:0]), "cloud.ply has no points: write the points of the map as PLY", cloud_of(SPREAD)),
    (cloud_of(FAR), "give the points in metres, and without stray ones", cloud_of(SPREAD)),
    (
        put(PLY, f"{TEXT_PLY}{CORNERS}nan 0 0\n"),
        "1 of 4 points are not finite .*: leave them out of the file",
        put(PLY, f"{TEXT_PLY.replace('4', '3', 1)}{CORNERS}"),
    ),
    (
        (lambda root, said: read_score(root), SE3),
        r"method=NAME of emgs score\), choose another out=FOLDER or move the folder away",
        *({"method": "other"}, {"out": "{root}/elsewhere"}, moved(OUT, "away")),
    ),
    ({"method": "a/b"}, "must be a name that is one folder below .*: choose another", {"method": "ab"}),
]


def read_plan(root: Path, *words: str, **keys) -> int:
    """Jobs of an evaluation of which one has a result, of other settings where the words say so."""
    given = [f"out={root / OUT}", *words, *(f"{key}={value}" for key, value in keys.items())]
    settings = OmegaConf.to_container(compose("suite=smoke", *given, name="evaluate"), resolve=True)
    return len([is_finished(job.folder, OmegaConf.to_container(job.config, resolve=True)) for job in plan(settings)])


def write_finished(root: Path) -> None:
    read_evaluation(root, OUT)


OTHER = {"overrides": "'[slam.em.noise=0.3]'"}
OF_EVALUATION = [
    (
        OTHER,
        r"\(\+variants.NAME=\{KEY:VALUE\} of emgs evaluate, .*, choose another out=FOLDER or move the folder away",
        {"overrides": "'[]'", "+variants.other": "'{{slam.em.noise:0.3}}'"},
        *({"out": "{root}/elsewhere"}, moved(OUT, "away")),
    ),
    ({"overrides": "'[prior.seed=3]'"}, r"give (seeds)=\[…\]", {"overrides": "'[]'", "seeds": "'[3]'"}),
    ({"overrides": "'[dataset=tum]'"}, "give suite=NAME", {"overrides": "'[]'", "suite": "smoke"}),
    (
        {"overrides": "'[prior=multiview_stereo]'", "seeds": "'[0,1]'"},
        r"give one seed, seeds=(\[0\])",
        {"seeds": "'{1}'", "out": "{root}/elsewhere"},
    ),
]


def written_with_points(root: Path) -> None:
    save_points_ply(written_run(root / "run") / "points.ply", SPREAD, SPREAD, np.clip(np.abs(SPREAD), 0, 1))


def read_export(root: Path, **keys) -> list[Path]:
    given = {"formats": "[frustums]"} | keys
    return export_run(
        compose(f"folder={root / 'run'}", *(f"{key}={value}" for key, value in given.items()), name="export")
    )


FRUSTUMS = {"formats": "'[frustums]'"}
OF_EXPORT = [
    ({"formats": "'[obj]'"}, "formats=obj is not known: choose of (colmap), nerfstudio", {"formats": "'[{1}]'"}),
    ({"formats": "'[]'"}, "writes nothing: give (colmap), nerfstudio or frustums", {"formats": "'[{1}]'"}),
    (
        (put("run/colmap/x", ""), {"formats": "'[colmap]'"}),
        "colmap is there already: remove it, or write elsewhere with out=FOLDER",
        *({"out": "{root}/there"}, (gone("run/colmap/x"), lambda root, said: (root / "run/colmap").rmdir())),
    ),
    ({"scale": 2, "length": "'[0,1,2]'"}, "both say how long things are: give one of them", {"scale": "'null'"}),
    ({"length": "'[0,1]'"}, r"length must be \[frame,frame,metres\]", {"length": "'[0,1,2]'"}),
    ({"length": "'[0,0,1]'"}, "at one place: take two that are far apart", {"length": "'[0,5,1]'"}),
    ({"length": "'[0,3,1]'"}, r"frame 3 .*: take another one \(index in frames.jsonl\)", {"length": "'[0,4,1]'"}),
    (
        (gone("run/points.ply"), {"formats": "'[colmap]'"}),
        "lacks points.ply, which formats=colmap needs: run again",
        *(fetched("run/points.ply"), FRUSTUMS),
    ),
    (
        (edit("run/metrics.json", ('"fingerprint": "', '"fingerprint": "0')), {"formats": "'[colmap]'"}),
        r"not those that were mapped. formats=(\[frustums\]) needs no images",
        {"formats": "'{1}'"},
    ),
    ({"images": "large", "formats": "'[colmap]'"}, "images must be one of (used), original", {"images": "{1}"}),
    (gone("run/metrics.json"), "finished run: it lacks metrics.json; run it to its end"),
]


def read_answer(root: Path, words: str | None = "sofa", **keys) -> dict:
    given = {"map": root / "run", "text": words} | keys
    return query(
        compose(*(f"{key}={'null' if value is None else value}" for key, value in given.items()), name="query")
    )


LINE_OF_POSE = "1 0 0 0 0 0 0 1\n"
OF_QUERY = [
    (
        {"words": None},
        "nothing is asked: give text=chair, text=.chair,table. or classes=FILE",
        *({"words": "sofa"}, {"words": "'[sofa,wall]'"}, (put("c.txt", "sofa\n"), {"classes": "{root}/c.txt"})),
    ),
    ({"words": "soaf"}, r"the nearest are (\w+)\.", {"words": "{1}"}),
    ({"words": "xyz"}, r"there are wall, (\w+)\.", {"words": "{1}"}),
    ({"words": "'[sofa,sofa]'"}, "none empty and each once", {"words": "'[sofa,wall]'"}),
    ({"against": "sofa"}, "asked for too: leave it out of one", {"against": "wall"}),
    (
        (put("p.txt", LINE_OF_POSE), {"frame": 1, "pose": "{root}/p.txt"}),
        "both say from where to draw: give one of them",
        *({"frame": None}, {"pose": None}),
    ),
    ({"frame": 77}, r"no pose of frame=77: choose one from (\d) to \d", {"frame": "{1}"}),
    ({"pose": "{root}/p.txt"}, "is no file: give lines `timestamp tx ty tz qx qy qz qw`", put("p.txt", LINE_OF_POSE)),
    ((put("p.txt", "# \n"), {"pose": "{root}/p.txt"}), "has no pose: give lines", put("p.txt", LINE_OF_POSE)),
    ({"map": "{root}/nowhere"}, "is no folder: give the one that a run wrote", {"map": "{root}/run"}),
]
OF_CONFIG = [
    ({"words": ["slam.em=papre"]}, r"with (slam/em=default)$", {"words": "['{1}']"}),
    ({"words": ["em.num_neighbours=4"]}, r"near names: (slam\.em\.num_neighbours)", {"words": "['{1}=4']"}),
    (
        {"words": ["graph=default", "graph.location.patience=2"]},
        r"is called (\S+) now",
        {"words": "[graph=default, '{1}=2']"},
    ),
    ({"words": ["dataset=scannetpp"]}, r"there are apartment, bonn, (colmap)", {"words": "['dataset={1}']"}),
    (
        {"words": ["prior=simulated", "prior/dense=itermvs"]},
        r"is a choice of (prior=\w+) only",
        {"words": "['{1}', prior/dense=itermvs]"},
    ),
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
    put("run/metrics.json", "{}")(root, None)


def read_mapped(root: Path, words: Sequence[str] = GRID, folder: str = "run", mode: str = "extend") -> int:
    return load_saved_map(str(root / folder), mode, load_config(*words).graph, (300.0, 300.0, 160.0, 120.0), 0.01).count


OF_MAP = [
    ({"words": ()}, "needs the keyframes of a back end: add (graph=default)", {"words": f"['{{1}}', '{GRID[1]}']"}),
    ({"mode": "track"}, "map_mode must be one of (extend), (localize)", {"mode": "{1}"}, {"mode": "{2}"}),
    ({"folder": "walk"}, "is no folder: give that of a finished run", {"folder": "run"}),
    (gone("run/metrics.json"), r"the same command with hydra.run.dir=\S+run goes on"),
    (gone("run/places.npz"), "has no places.npz: map it again with graph=default"),
    (put("run/places.npz", b"PK"), "no keyframes to continue from .*: map again with"),
    (
        {"words": ("graph=default",)},
        r"was made with (graph.place_recognition.grid=\[8,6\]): give that here",
        {"words": "['graph=default', '{1}']"},
    ),
    (lambda root, said: write_mapped(root, 99), "are not of one run: map again", lambda root, said: write_mapped(root)),
]


def write_scored(root: Path) -> None:
    write_truth(root / "truth", moved_run(root / "run"))


def read_segmentation(root: Path, **keys) -> str:
    given = {"map": str(root / "run"), "truth": str(root / "truth"), "out": str(root / "out")}
    given |= {"classes": str(root / "truth/classes.txt")} | keys
    return segment(OmegaConf.merge(compose("map=a", "truth=b", name="segment"), given))[1]


TRUE_IDS = "truth/room.txt"
WORDS = TextEmbeddings(("wall", "lamp"), np.eye(2, dtype=np.float32), (), {"prior": "simulated"})
OF_SEGMENT = [
    ({"map": "[{root}/run,{root}/run]"}, "names a folder twice, .*: give each once", {"map": "{root}/run"}),
    ({"scenes": ["a", "b"]}, "give one name for each map", {"scenes": ["room"]}),
    ({"classes": None}, "has ids only: give their class file", {"classes": "{root}/truth/classes.txt"}),
    (
        (moved(TRUE_IDS, "truth/office0.txt"), moved("truth/room_mesh.ply", "truth/office0_mesh.ply")),
        r"lacks room_mesh.ply, room.txt: give the folder with .* or name the scenes \(scenes=(\[office0\])\)",
        {"scenes": "{1}"},
        (fetched(TRUE_IDS), fetched("truth/room_mesh.ply")),
    ),
    (put(TRUE_IDS, "5\n9\n"), "has 2 labels and .*: fetch both files of the same mesh"),
    (put(TRUE_IDS, "wall\n"), "is no list of whole numbers, .*: fetch it again"),
    (put("truth/classes.txt", "5 wall\n"), "give the class file of this data set"),
    (
        put("truth/classes.txt", "5 wall\n9 lamp\n"),
        r"there are wall, (sofa)\. For other words give embeddings \(features.text=FILE of emgs embed\)",
        lambda root, said: put("truth/classes.txt", f"5 wall\n9 {said[1]}\n")(root, said),
        (lambda root, said: save_text(root / "words.npz", WORDS), {"features": "{{text: {root}/words.npz}}"}),
    ),
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
    def run(root, said):
        read_evaluation(root, **keys)

    return run


def of_other_code(root: Path, said: Said) -> None:
    for path in (root / "out").rglob(METRICS_FILE):
        content = json.loads(path.read_text())
        content["provenance"]["versions"]["emgs_jax"] = "0"
        path.write_text(json.dumps(content))


TEN = "[0,1,2,3,4,5,6,7,8,9]"
OF_GATE = [
    (gone("gate.yaml"), "gate.yaml is no file: write one with .* write_gate=FILE", evaluated(write_gate="gate.yaml")),
    (put("gate.yaml", "["), "is no baseline .*: write one with .* write_gate=FILE", evaluated(write_gate="gate.yaml")),
    ({"shard": "1/2"}, "a gate needs the results of all jobs: run once more without shard", {"shard": "1/1"}),
    ({"shard": "0/2", "gate": None}, r"such as (\d/\d), got", {"shard": "'{1}'"}),
    (of_other_code, "now: choose another out=FOLDER, or move them away", *({"out": "there"}, moved("out", "away"))),
    (
        {"gate": None, "write_gate": "new.yaml", "rounded": "again"},
        "must be a folder of results of the same jobs, .*: evaluate into it first",
        (evaluated(out="again", seeds=TEN), {"seeds": f"'{TEN}'"}),
    ),
    (
        (evaluated(out="again"), {"gate": None, "write_gate": "new.yaml", "rounded": "again"}),
        r"at least 5 are needed for tolerances: evaluate seeds=(\[\S+\]) into both folders",
        (lambda root, said: read_evaluation(root, "again", seeds=said[1]), {"seeds": "'{1}'"}),
    ),
]


def write_pages(root: Path) -> None:
    for name in ("page.md", "full.md"):
        put(name, "<!-- table: some -->\nold\n<!-- end -->\n")(root, None)


def read_tables(root: Path, page: str = "page.md", is_dirty: bool = False, out: str = "out") -> bool:
    """Tables of the built-in room; runs only write what they are of."""

    def run(config: DictConfig, folder: Path) -> None:
        path = written(folder.parent, config.prior.seed, ONE_COMMIT | {"dirty": is_dirty})
        content = json.loads(path.read_text())
        content["provenance"]["config"] = OmegaConf.to_container(config, resolve=True)
        write_json(path, content)

    with (
        mock.patch.object(evaluate_module, "run", run),
        mock.patch.object(tables_module, "git_now", lambda: ONE_COMMIT | {"dirty": is_dirty}),
    ):
        config = OmegaConf.to_container(OmegaConf.load(tables_module.CONFIG), resolve=False)
        config |= {"page": str(root / page), "full_page": str(root / "full.md"), "out": str(root / out)}
        config["root"] = "nowhere"
        config["short"]["data"] = ["synthetic"]
        config["tables"] = {"some": [{"data": ["synthetic"], "seeds": [3], "settings": {"default": {}}}]}
        tables_module.tables(config)
    return "old" not in (root / page).read_text()


OF_TABLES = [
    ({"page": "README"}, "give page=FILE and full_page=FILE with the places of the tables", {"page": "page.md"}),
    (put("page.md", "<!-- table: some -->\n"), "not one: write the markers once"),
    ({"is_dirty": True}, "of one commit without changes: commit, ", {"is_dirty": False}),
]


def read_polish(root: Path, folder: str = "run", words: Sequence[str] = ()) -> str:
    """What is looked at before splats are fitted."""
    config = compose(f"folder={root / folder}", *words, name="polish")
    with mock.patch.multiple(polish_module, polish=lambda *_: {"splats": 1}, write_report=lambda *_: None):
        return polish_run(config)


OF_POLISH = [
    ({"words": ["polish=none"]}, "choose (polish=default)", {"words": "['{1}']"}),
    ({"folder": "walk"}, "is no folder: give the one that a run wrote", {"folder": "run"}),
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
    ({}, r"is taken by another program, .* such as port=(\d+)$", {"port": "{1}"}),
    ({"folder": "walk"} | FREE, "give the one that a run wrote, with metrics.json in it", {"folder": "run"}),
    ((gone("run/trajectory.txt"), FREE), "lacks trajectory.txt; run it to its end"),
]
TABLES = {
    "map": (write_mapped, read_mapped, OF_MAP),
    "segment": (write_scored, read_segmentation, OF_SEGMENT),
    "gate": (lambda root: read_evaluation(root, write_gate="gate.yaml"), read_gated, OF_GATE),
    "tables": (write_pages, read_tables, OF_TABLES),
    "polish": (written_with_points, read_polish, OF_POLISH),
    "view": (written_with_points, read_view, OF_VIEW),
    "score": (write_peer, read_score, OF_SCORE),
    "evaluate": (write_finished, read_plan, OF_EVALUATION),
    "export": (written_with_points, read_export, OF_EXPORT),
    "query": (written_with_points, read_answer, OF_QUERY),
    "config": (lambda root: None, lambda root, words: compose(*words), OF_CONFIG),
}


sound = sound_files(TABLES)


@each_remedy(TABLES)
def test_what_a_message_advises_helps(name, cause, message, remedy, sound, tmp_path):
    check_helps(TABLES[name][1], sound(name), cause, message, remedy, tmp_path)
