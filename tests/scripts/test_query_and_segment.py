"""Both commands on a run of the built-in room with its true classes; oracle: where the true depth has them."""

import json
import shutil
from pathlib import Path

import numpy as np
import own_process
import pytest
from tiny_run import dataset

from emgs_jax.config import configure
from emgs_jax.data.backprojection import backproject
from emgs_jax.io.files import owned
from emgs_jax.runs.files import claim_folder
from experiments.export import export_run
from experiments.polish import polish_run
from experiments.query import query
from experiments.report import report
from experiments.segment import segment

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]


def true_points(name: str) -> np.ndarray:
    """What all frames see of a class, in the world."""
    number = dataset().classes.index(name)
    found = []
    for frame in dataset():
        points = backproject(frame.depth, dataset().intrinsics)[(frame.labels == number) & (frame.depth > 0)]
        found.append(points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3])
    return np.concatenate(found)


def test_the_one_chair_and_the_one_picture_are_found_where_they_are(exact_run, tmp_path):
    """Pixels are 2 to 3 cm apart there, and a Gaussian stands for a cluster of some twenty."""
    words = f"map={exact_run[0]}", "text=[chair,picture]", f"out={tmp_path}"
    found = query(configure.compose(*words, name="query"))
    for word in found["words"]:
        points = true_points(word["word"])
        objects = word["instances"]  # back and seat of the chair are seen apart
        np.testing.assert_allclose(objects[0]["center_m"], points.mean(0), atol=0.15)
        counts = [one["num_gaussians"] for one in objects]
        centers = np.array([one["center_m"] for one in objects])
        np.testing.assert_allclose(np.average(centers, axis=0, weights=counts), points.mean(0), atol=0.1)
        assert sum(counts) < 0.2 * found["features"]["num_gaussians"]


def test_a_map_that_kept_its_own_unit_is_not_asked_in_metres(exact_run, tmp_path, capsys):
    """Symptom: a saved map of an own unit that was continued with predictions in metres."""
    folder = shutil.copytree(exact_run[0], tmp_path / "run")
    for unit, said in ((True, ") m, "), (False, ") units, ")):
        metrics = json.loads((folder / "metrics.json").read_text())
        metrics["provenance"]["is_metric"] = unit
        (folder / "metrics.json").write_text(json.dumps(metrics))
        query(configure.compose(f"map={folder}", "text=chair", f"out={tmp_path / said[2]}", name="query"))
        assert said in capsys.readouterr().out


def test_segment_says_of_labelled_frames_what_the_run_itself_said(exact_run, tmp_path):
    folder, metrics = exact_run
    config = configure.compose(f"map={folder}", "truth=frames", f"out={tmp_path}", name="segment")
    found, said = segment(config)
    for key, name in (("miou", "miou"), ("fmiou", "fmiou"), ("acc", "mean_recall")):
        np.testing.assert_allclose(found["total"][key], metrics[f"segmentation/{name}_percent"], rtol=1e-12)
    assert found["scenes"][0]["num_true_points"] >= metrics["segmentation/num_points"]
    assert "| ours | **simulated** | ovo |" in said
    fewer = tmp_path / "run"
    shutil.copytree(folder, fewer)
    metrics["provenance"]["config"]["dataset"]["stop"] = 4
    (fewer / "metrics.json").write_text(json.dumps(metrics))
    config.map = str(fewer)
    with pytest.raises(ValueError, match="the frames of .* cannot be read again. .* there are 4 now, and 6"):
        segment(config)


def test_a_command_says_what_it_did_and_nothing_of_its_libraries(exact_run, tmp_path):
    shutil.copytree(exact_run[0], tmp_path / "run")
    done = own_process.run("experiments.cli", "report", str(tmp_path / "run"))
    assert done.stderr == "" and done.stdout.startswith(f"{tmp_path}/run/report.html") and done.stdout.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "write"),
    [("polish", polish_run), ("export", export_run), ("report", lambda config: report(Path(config.folder)))],
)
def test_a_run_that_cannot_be_written_into_is_named_before_the_work(name, write, exact_run, tmp_path, monkeypatch):
    """Of a disk that is read-only `emgs polish` spoke after it had fitted the splats, and of a file that never was."""
    folder = shutil.copytree(exact_run[0], tmp_path / "run")
    config = configure.compose(f"folder={folder}", name=name)
    if name != "report":  # which is one short write at the end
        monkeypatch.setattr(f"experiments.{name}.images_of", lambda run: (list(run.poses), ""))
        with owned(folder), pytest.raises(ValueError, match="another program is writing into .*run"):
            write(config)
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(ValueError, match=f"^folder={folder}: {folder} is no folder that can be written to"):
        write(config)


def test_a_new_run_in_the_folder_moves_the_answer_away(tmp_path):
    names = ["metrics.json", "query.json", "semantic.npz"]
    for name in names:
        (tmp_path / name).write_text("")
    claim_folder(tmp_path)
    assert sorted(path.name for path in (tmp_path / "previous-1").iterdir()) == names
