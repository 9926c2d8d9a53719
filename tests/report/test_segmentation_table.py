"""A map against a labelled mesh; oracle: a hand-made run that is moved by a known similarity."""

import json
from functools import cache

import numpy as np
import pytest
from hand_run import random_similarity
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.evaluation.segmentation import confusion_matrix, transfer_labels
from emgs_jax.io.map_file import load_map
from emgs_jax.io.ply import structured, write_ply
from emgs_jax.io.trajectory import to_tum
from emgs_jax.report.segmentation_table import Counting
from emgs_jax.runs.finished_run import read_run
from experiments.segment import segment
from tests.written_run import written_run

pytestmark = pytest.mark.slow


CLASSES = "5 wall\n9 sofa\n"
TO_TRUTH = random_similarity(np.random.default_rng(3), 2.5)


def write_truth(folder, run, wrong: int = 0, shift=(0.0, 0.0, 0.0)):
    """Vertices at the centres of the map's Gaussians in the frame of the truth; `wrong` sofas are called wall."""
    folder.mkdir(exist_ok=True)
    means = np.asarray(load_map(run / "map.npz").gaussians.means, np.float64)
    ids = np.where(means[:, 2] == 1.0, 9, 5)
    ids[np.flatnonzero(ids == 9)[:wrong]] = 5
    points = TO_TRUTH.apply(means) + shift
    write_ply(folder / "room_mesh.ply", structured(points.astype(np.float32), ["x", "y", "z"]))
    (folder / "room.txt").write_text("\n".join(map(str, ids)) + "\n")
    (folder / "classes.txt").write_text(CLASSES)
    return ids


def moved_run(folder):
    """True poses are the estimated ones, moved."""
    written_run(folder)
    poses = read_run(folder).poses
    poses[2, 1, 3] += 0.2  # a straight path leaves the roll about it open
    text = (folder / "trajectory.txt").read_text().splitlines()
    text[3] = " ".join([text[3].split()[0], *(f"{value:.9f}" for value in to_tum(poses[2]))])
    (folder / "trajectory.txt").write_text("\n".join(text) + "\n")
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    for line, pose in zip(lines, TO_TRUTH.apply_to_poses(poses), strict=True):
        line["true_pose"] = to_tum(pose)
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


@pytest.fixture
def run(tmp_path):
    return moved_run(tmp_path / "run")


@cache
def composed(*words):
    return compose("map=a", "truth=b", *words, name="segment")


def scored(run, folder, *words, **values):
    given = {"map": str(run), "truth": str(folder), "classes": str(folder / "classes.txt"), "out": str(folder / "out")}
    return segment(OmegaConf.merge(composed(*words), given | values))


def test_a_map_in_another_frame_and_scale_is_brought_to_the_truth(run, tmp_path):
    ids = write_truth(tmp_path / "truth", run)
    found, said = scored(run, tmp_path / "truth")
    assert found["total"]["miou"] == found["total"]["acc"] == 100.0
    (scene,) = found["scenes"]
    np.testing.assert_allclose(scene["alignment"]["scale"], 2.5, rtol=1e-6)
    assert scene["median_distance_to_map_m"] < 1e-4 and scene["num_true_points"] == len(ids)
    assert (scene["placed_by"], scene["scene"], found["truth"]) == ("trajectory", "room", str(tmp_path / "truth"))
    assert "| ours | **simulated** | ovo | one matrix of 1 | trajectory | 100.0 | 100.0 | 100.0 | 1.2 |" in said
    assert (
        "| MonoEM-GS | quoted: MonoEM-GS, Table III | of OMCL and OVO | 8 of Replica | – | 31.5 | 63.2 | 47.4 |" in said
    )
    assert (tmp_path / "truth" / "out" / "segmentation_ovo.md").read_text() == said
    assert json.loads((tmp_path / "truth" / "out" / "segmentation_ovo.json").read_text())["classes"] == ["wall", "sofa"]


def test_wrong_labels_count_as_the_matrix_says(run, tmp_path):
    """Twenty vertices of the sofa are called wall; one neighbour votes."""
    ids = write_truth(tmp_path / "truth", run, wrong=20)
    found, _ = scored(run, tmp_path / "truth", num_neighbours=1)
    walls, sofas = (ids == 5).sum(), (ids == 9).sum()
    np.testing.assert_array_equal(found["scenes"][0]["confusion"], [[walls - 20, 20, 0], [0, sofas, 0]])
    iou = (walls - 20) / walls, sofas / (sofas + 20)
    np.testing.assert_allclose(found["total"]["miou"], 100 * np.mean(iou))
    np.testing.assert_allclose(found["by_class"]["wall"]["iou_percent"], 100 * iou[0])
    np.testing.assert_allclose(found["total"]["acc"], 100 * np.mean([(walls - 20) / walls, 1]))


def test_a_map_beside_the_truth_is_placed_by_its_points(run, tmp_path):
    """Sideways along the walls nothing holds it, so the truth is off along their normal, by a third of the cells."""
    normal = TO_TRUTH.rotation @ [0.0, 0.0, 1.0]
    write_truth(tmp_path / "truth", run, shift=0.06 * normal)
    by_path, _ = scored(run, tmp_path / "truth")
    by_points, said = scored(run, tmp_path / "truth", alignment="points")
    np.testing.assert_allclose(by_path["scenes"][0]["median_distance_to_map_m"], 0.06, rtol=1e-3)
    assert by_points["scenes"][0]["median_distance_to_map_m"] < 1e-3
    np.testing.assert_allclose(by_points["scenes"][0]["icp"]["translation"], 0.06 * normal, atol=1e-3)
    assert "| points | 100.0 |" in said


def test_two_scenes_are_one_matrix_and_have_a_line_each(run, tmp_path):
    truth = tmp_path / "truth"
    ids = write_truth(truth, run)
    for name in ("room_mesh.ply", "room.txt"):
        (truth / name.replace("room", "hall")).write_bytes((truth / name).read_bytes())
    (truth / "hall.txt").write_text("\n".join(["5"] * len(ids)) + "\n")
    found, said = scored(run, truth, map=[str(run)] * 2, scenes=["room", "hall"])
    assert "one matrix of 2" in said and "| hall |" in said
    sofas = (ids == 9).sum()
    np.testing.assert_allclose(found["total"]["acc"], 100 * np.mean([1 - sofas / (2 * len(ids) - sofas), 1]))


def test_ovo_counts_by_hand():
    """Vertices: wall → wall twice; chair → chair; chair → table; table → lamp. Unknown: not counted.

    IoU: wall 2/2, chair 1/2, table 0/2, lamp 0/1 (only predicted: counts, with recall 0).
    """
    classes = ("wall", "chair", "table", "lamp")
    given = [[0] * 5, [1, 1, 1, 2, 2], [2, 2, 2, 2, -1], [3, 3, 1, -1, -1], [0, 0, 0, 1, 1]]
    points = np.array([[place + 1e-3 * offset, 0.0, 0.0] for place in range(5) for offset in (-2, -1, 0, 1, 2)])
    true = np.array([[0.0, 0, 0], [0.0, 1e-4, 0], [1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0], [4.0, 0, 0]])
    labels = transfer_labels(points, np.ravel(given), true, 5)
    confusion = confusion_matrix(np.array([0, 0, 1, 1, 2, -1]), labels, 4)
    np.testing.assert_array_equal(confusion, [[2, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0]])
    found = Counting(5, ()).metrics(confusion, classes)
    np.testing.assert_allclose([*found.values()], [100 * 1.5 / 4, 100 * (2 + 2 * 0.5) / 5, 100 * 1.5 / 4])
    np.testing.assert_allclose(Counting(5, ("wall", "door")).metrics(confusion, classes)["miou"], 100 * 0.5 / 3)


def test_points_of_an_ignored_class_do_not_count(run, tmp_path):
    write_truth(tmp_path / "truth", run, wrong=20)
    found, _ = scored(run, tmp_path / "truth", ignored=["wall", "door"], num_neighbours=1)
    assert found["scenes"][0]["confusion"][0].sum() == 0 and found["total"]["acc"] == 100.0


def test_what_is_missing_or_does_not_fit_is_named(run, tmp_path):
    truth, blind = tmp_path / "truth", written_run(tmp_path / "blind", has_truth=False)
    write_truth(truth, run)

    def refused(message, run=run, **values):
        with pytest.raises(ValueError, match=message):
            scored(run, truth, **values)

    refused("class file .*nowhere.yaml does not exist", classes="nowhere.yaml")
    refused("truth=frames has the data set's names: leave it out", truth="frames")
    refused("frames.jsonl has no true pose to place the map by", blind)
