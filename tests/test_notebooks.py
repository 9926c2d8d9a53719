"""The notebooks: how they are kept, and that each runs from a new folder and finds what its stages promise."""

import ast
import html
import json
from pathlib import Path

import numpy as np
import pytest
from listening import compiled
from scipy.spatial.transform import Rotation
from tiny_run import TINY

from tools.notebooks import OUTPUTS_OF, code_digest

pytestmark = pytest.mark.xdist_group("tiny")

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))
IDS = [path.stem for path in NOTEBOOKS]
READINGS = "slam.em.support=printed slam.em.noise=0"
MUTE = "slam.em.feature_weight=0.0 slam.refinement.cosine_weight=0.0"
MAX_BYTES = 300_000
EM_GATES = "max_mahalanobis_sq", "max_log_gap"


def cells(path: Path) -> list[dict]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def code(path: Path) -> list[str]:
    return ["".join(cell["source"]) for cell in cells(path) if cell["cell_type"] == "code"]


def execute(number: int, overrides: str, monkeypatch, folder: Path) -> dict:
    """Run the code cells one after the other in a new folder; returns their variables."""
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("NOTEBOOK_OVERRIDES", overrides)
    monkeypatch.delenv("NOTEBOOK_FOLDER", raising=False)
    variables = {"__name__": "__main__"}
    for row, text in enumerate(code(NOTEBOOKS[number - 1])):
        exec(compile(text, f"{NOTEBOOKS[number - 1].name}, code cell {row}", "exec"), variables)
        matplotlib.pyplot.close("all")
    return variables


def test_there_are_five_notebooks_in_the_order_of_reading():
    assert IDS == ["01_one_step", "02_readings", "03_threshold_sweep", "04_own_images", "05_semantics"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_a_notebook_has_at_most_15_cells_and_all_outputs_of_its_own_code_or_none(path):
    """`python -m tools.notebooks` writes them: in one go, without errors, in few bytes, and of no machine."""
    own = [cell for cell in cells(path) if cell["cell_type"] == "code"]
    written = json.loads(path.read_text(encoding="utf-8"))["metadata"].get(OUTPUTS_OF)
    shown = json.dumps([cell["outputs"] for cell in own])
    assert len(cells(path)) <= 15 and path.stat().st_size < MAX_BYTES
    if written is None:
        assert not any(cell["outputs"] or cell["execution_count"] for cell in own)
        return
    assert written == code_digest(cells(path)), "its code has changed: run it again"
    assert [cell["execution_count"] for cell in own] == list(range(1, len(own) + 1))
    assert {output["output_type"] for cell in own for output in cell["outputs"]} <= {
        *("stream", "display_data", "execute_result")
    }
    assert not any(word in shown for word in ("/tmp", "/home", "/root", str(path.parents[1])))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_the_first_cell_asks_the_question_and_functions_are_short(path):
    first = cells(path)[0]
    title = first["source"][0].strip()
    assert first["cell_type"] == "markdown" and title.startswith("# ") and title.endswith("?")
    functions = [node for text in code(path) for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    assert not [node.name for node in functions if node.end_lineno - node.lineno >= 5]


@pytest.mark.slow
def test_one_step_taken_apart_is_the_step(monkeypatch, tmp_path):
    """Oracle: `slam.step` on the same state and prediction."""
    found = execute(1, " ".join(TINY), monkeypatch, tmp_path)
    whole, counts = found["info"], found["counts"]
    np.testing.assert_allclose(
        whole.T_world_camera.as_matrix(), found["T"].as_matrix(), atol=1e-3
    )  # its own index of the map
    assert int(counts.num_fused) > 100 and abs(int(whole.em.num_fused) - int(counts.num_fused)) <= 5
    grown = int(whole.num_gaussians) - int(found["state"].map.gaussians.valid.sum())
    assert abs(grown - int(found["refined"].num_fresh)) <= 10


@pytest.mark.weekly
def test_the_readings_are_compared_seed_by_seed(monkeypatch, tmp_path):
    monkeypatch.setenv("NOTEBOOK_READINGS", READINGS)
    found = execute(2, " ".join(TINY), monkeypatch, tmp_path)
    assert {word for word, _ in found["rows"]} == {"", *READINGS.split()}
    ate = found["values"]("slam.em.noise=0", "trajectory/ate_sim3_m") - found["values"]("", "trajectory/ate_sim3_m")
    assert len(np.unique(ate)) == 3
    shown = found["line"]("slam.em.noise=0", True)[1]
    assert shown == f"{100 * ate.mean():+.2f} ± {100 * ate.std(ddof=1):.2f}"


@pytest.mark.weekly
def test_the_heat_maps_show_the_metrics_of_each_setting_at_its_place_and_all_share_a_program(monkeypatch, tmp_path):
    with compiled() as names:
        found = execute(3, " ".join(TINY), monkeypatch, tmp_path)
    assert names.count("_fuse") <= 1  # 0 where another test needed it, too
    drawn, folder = found["values"]("trajectory/ate_sim3_m"), tmp_path / "outputs" / "threshold_sweep"
    for number, place in enumerate(np.ndindex(drawn.shape)):
        metrics = json.loads((folder / str(number) / "metrics.json").read_text())
        em = metrics["provenance"]["config"]["slam"]["em"]
        values = [found["axes"][f"slam.em.{key}"][at] for key, at in zip(EM_GATES, place, strict=True)]
        assert [em[key] if em[key] is not None else np.inf for key in EM_GATES] == values
        assert drawn[place] == metrics["trajectory/ate_sim3_m"]
    assert len(np.unique(drawn)) > 4


@pytest.mark.weekly
def test_own_images_become_a_map_of_the_room_that_they_show(monkeypatch, tmp_path):
    """Oracle: the true path of the camera, up to the scale that images do not tell."""
    small = "slam.window_size=4 dataset.size=[160,120] slam.submap.map_capacity=4096 slam.submap.submap_capacity=2048"
    found = execute(4, small, monkeypatch, tmp_path)
    truth = np.array([found["room"][row].T_world_camera[:3, 3] for row in range(len(found["room"]))])
    path = np.loadtxt(found["results"] / "trajectory.txt")[:, 1:4]
    truth, path = truth - truth[0], path - path[0]
    aligned = Rotation.align_vectors(truth, path)[0].apply(path)
    scale = (aligned * truth).sum() / (path**2).sum()
    np.testing.assert_allclose(scale * aligned, truth, atol=0.1 * np.linalg.norm(truth, axis=1).max())
    assert found["metrics"]["frames/lost"] == 0 and found["valid"].sum() > 100
    assert html.unescape(found["report"].data).count((found["results"] / "report.html").read_text()) == 1


@pytest.mark.weekly
def test_wrong_features_cost_classes_and_move_geometry_only_where_they_have_a_weight(monkeypatch, tmp_path):
    """Oracle: where nothing looks at features but the layers' sign, wrong ones move nothing but that."""
    monkeypatch.setenv("NOTEBOOK_CHANGES", "slam.em.feature_weight=20")
    # The prior is exact: 1 cm of error over 40 cm of path turns a noisy map until classes fall beside their things.
    found = execute(5, " ".join((*TINY, MUTE, "prior.level=0.0")), monkeypatch, tmp_path)
    shares, seeds, rows = found["shares"], found["seeds"], found["rows"]
    assert set(rows) == {(share, seed) for share in shares for seed in seeds}
    for seed in seeds:
        mute, loud = ([rows[share, seed][place] for share in shares] for place in (0, 1))
        accuracy = [row["segmentation/accuracy_percent"] for row in mute]
        assert accuracy[0] > 94 and accuracy[-1] < accuracy[0] - 10
        assert len({row["trajectory/ate_sim3_m"] for row in mute}) == 1
        # What is not fused is new, and stays tentative until something is fused into it.
        assert loud[-1]["map/num_tentative"] > 1.3 * mute[-1]["map/num_tentative"]
