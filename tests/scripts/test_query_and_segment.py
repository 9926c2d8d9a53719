"""Both commands on a run of the built-in room with its true classes; oracle: where the true depth has them."""

import json
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from tiny_run import CONF, compose, dataset

import experiments.run
from emgs_jax.data.backprojection import backproject
from emgs_jax.running import configure
from experiments.query import query
from experiments.segment import segment

pytestmark = pytest.mark.slow


@cache
def exact_run() -> Path:
    folder = Path(mkdtemp())
    experiments.run.run(compose("prior.level=0"), folder)
    return folder


def true_points(name: str) -> np.ndarray:
    """What all frames see of a class, in the world."""
    number = dataset().classes.index(name)
    found = []
    for frame in dataset():
        points = backproject(frame.depth, dataset().intrinsics)[(frame.labels == number) & (frame.depth > 0)]
        found.append(points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3])
    return np.concatenate(found)


@pytest.mark.parametrize("name", ["chair", "picture"])
def test_the_one_chair_and_the_one_picture_are_found_where_they_are(name, tmp_path):
    """Pixels are 2 to 3 cm apart there, and a Gaussian stands for a cluster of some twenty."""
    found = query(configure.compose(f"map={exact_run()}", f"text={name}", f"out={tmp_path}", name="query"))
    points = true_points(name)
    objects = found["words"][0]["instances"]  # back and seat of the chair are seen apart
    np.testing.assert_allclose(objects[0]["center_m"], points.mean(0), atol=0.15)
    counts = [one["num_gaussians"] for one in objects]
    centers = np.array([one["center_m"] for one in objects])
    np.testing.assert_allclose(np.average(centers, axis=0, weights=counts), points.mean(0), atol=0.1)
    assert sum(counts) < 0.2 * found["features"]["num_gaussians"]


def test_segment_says_of_labelled_frames_what_the_run_itself_said(tmp_path):
    found, said = segment(configure.compose(f"map={exact_run()}", "truth=frames", f"out={tmp_path}", name="segment"))
    metrics = json.loads((exact_run() / "metrics.json").read_text())
    for key, name in (("miou", "miou"), ("fmiou", "fmiou"), ("acc", "mean_recall")):
        np.testing.assert_allclose(found["total"][key], metrics[f"segmentation/{name}_percent"], rtol=1e-12)
    assert found["scenes"][0]["num_true_points"] >= metrics["segmentation/num_points"]
    assert "| ours | **simulated** | ovo |" in said


def test_frames_without_labels_or_that_are_gone_are_named(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(exact_run(), folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["provenance"]["config"]["dataset"]["stop"] = 4
    (folder / "metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(
        ValueError, match="truth=frames: the frames of .* cannot be read again. .* there are 4 now, and 6"
    ):
        segment(configure.compose(f"map={folder}", "truth=frames", f"out={tmp_path}", name="segment"))


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["query", "text=chari"], "error: 'chari' is no word of"),
        (["query", "text=chair", "margins=2"], "error: margins is no key of the config; near names: margin"),
        (
            ["segment", "truth=nowhere", "protocol=omcl"],
            "error: protocol=omcl is no option of protocol: there are concept",
        ),
        (["segment", "truth=nowhere"], "error: truth=nowhere has ids only: give their class file"),
    ],
)
def test_the_programs_end_with_one_line(command, message, tmp_path):
    name, *words = command
    words += [f"map={exact_run()}", f"out={tmp_path}"]
    done = subprocess.run(
        [sys.executable, "-m", "experiments.cli", name, *words],
        cwd=CONF.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and done.stderr.startswith(message), done.stderr
    assert "Traceback" not in done.stderr


def test_a_command_says_what_it_did_and_nothing_of_its_libraries():
    words = [sys.executable, "-m", "experiments.cli", "report", str(exact_run())]
    done = subprocess.run(words, cwd=CONF.parent, capture_output=True, text=True, check=True)
    assert done.stderr == "" and done.stdout.startswith(f"{exact_run()}/report.html") and done.stdout.count("\n") == 1


def test_a_new_run_in_the_folder_moves_the_answer_away(tmp_path):
    from emgs_jax.report.run_files import claim_folder

    for name in ("query.json", "semantic.npz", "metrics.json"):
        (tmp_path / name).write_text("")
    claim_folder(tmp_path)
    assert sorted(path.name for path in (tmp_path / "previous-1").iterdir()) == [
        "metrics.json",
        "query.json",
        "semantic.npz",
    ]
