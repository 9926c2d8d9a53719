"""The files of a sweep; oracles: rows written by hand, the colours of the picture, what a resumed sweep holds."""

import csv
import json

import numpy as np
import pytest

from emgs_jax.report import sweep_page
from emgs_jax.report.columns import csv_text
from emgs_jax.report.sweep_page import draw, table
from emgs_jax.report.sweeps import SweepResults, read_sweep

ATE, F1 = "trajectory/ate_sim3_m", "reconstruction/f1_5cm_percent"
PROVENANCE = {"data": {"name": "room"}, "prior": {"name": "simulated", "settings": {"seed": 0}}, "config": {"a": 1}}
PROVENANCE |= {"git": {"revision": "aaaa"}, "versions": {"jax": "1"}}
AXES = {"slam.em.noise": [0.5, 1.0], "slam.em.min_std": [0.01, 0.02, 0.03]}


def grid():
    """ATE 1 … 6 cm, F1 10 … 60 %; the last one has no F1."""
    rows = []
    for i, noise in enumerate(AXES["slam.em.noise"]):
        for j, std in enumerate(AXES["slam.em.min_std"]):
            number = 3 * i + j + 1
            row = {"slam.em.noise": noise, "slam.em.min_std": std, ATE: number / 100}
            rows.append(row if number == 6 else row | {F1: 10.0 * number})
    return rows


def test_the_best_of_each_column_is_bold_low_errors_and_high_scores():
    lines = [[text.strip() for text in line.split("|")[1:-1]] for line in table(grid(), [*AXES], "room").splitlines()]
    assert lines[0] == [*AXES, "ATE [cm]", "F1@.05 [%]"]
    assert lines[2] == ["0.5", "0.01", "**1.00**", "10.0"]
    assert lines[6] == ["1.0", "0.02", "5.00", "**50.0**"]
    assert lines[7] == ["1.0", "0.03", "6.00", "–"]
    assert sum(text.startswith("**") for line in lines for text in line) == 2


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """`draw`: what it says, and its figure."""
    figures, figure = [], sweep_page.Figure
    monkeypatch.setattr(sweep_page, "Figure", lambda **look: figures.append(figure(**look)) or figures[-1])
    return lambda rows, axes, data="room": (draw(tmp_path / "map.png", rows, axes, "a sweep", data), figures)


@pytest.mark.parametrize(("data", "unit"), [("room", "cm"), ("colmap", ".01 units")])
def test_the_picture_has_the_value_of_each_setting_at_its_place_as_means_over_other_axes(drawn, data, unit, tmp_path):
    rows = [row | {"slam.window_size": size, ATE: row[ATE] * size} for row in grid() for size in (1, 3)]
    reason, (figure,) = drawn(rows, AXES | {"slam.window_size": [1, 3]}, data)
    assert reason is None and figure.get_suptitle() == "a sweep, means over slam.window_size"
    ate, f1 = (panel for panel in figure.axes if panel.images)
    assert (ate.get_title(), f1.get_title()) == (f"ATE [{unit}]", "F1@.05 [%]")
    assert (ate.get_ylabel(), ate.get_xlabel()) == tuple(AXES)
    ticks = [[text.get_text() for text in texts] for texts in (ate.get_yticklabels(), ate.get_xticklabels())]
    assert ticks == [[str(value) for value in values] for values in AXES.values()]
    np.testing.assert_allclose(ate.images[0].get_array(), 2.0 * np.array([[1, 2, 3], [4, 5, 6]]))
    np.testing.assert_allclose(f1.images[0].get_array().filled(np.nan), [[10, 20, 30], [40, 50, np.nan]])
    assert (tmp_path / "map.png").read_bytes()[:4] == b"\x89PNG"


def test_without_two_axes_or_without_truth_there_is_no_picture_but_a_reason(drawn):
    assert "two axes" in drawn(grid(), {"slam.em.noise": [0.5, 1.0], "slam.em.min_std": [0.01]})[0]
    reason, figures = drawn([{name: row[name] for name in AXES} for row in grid()], AXES)
    assert "no ground truth" in reason and not figures


def test_brighter_is_better_in_the_picture_of_either_kind_of_metric(drawn):
    """The same numbers as an error and as a score: the bright end is the other one, and its text is dark."""
    rows = [{name: row[name] for name in AXES} | {ATE: row[ATE], F1: row[ATE]} for row in grid()]
    _, (figure,) = drawn(rows, AXES)
    for axes, bright in zip(figure.axes[:2], ("1.00", "0.1"), strict=True):
        (image,), texts = axes.images, [(text.get_text(), text.get_color()) for text in axes.texts]
        light = image.cmap(image.norm(image.get_array()))[..., :3].mean(-1)
        assert (light[0, 0] > light[1, 2] + 0.1) == (bright == "1.00")
        assert [text for text, color in texts if color == "black"][:1] == [bright] and len(texts) == 6


def test_results_are_there_again_when_a_sweep_goes_on_and_rows_come_in_the_order_asked_for(tmp_path):
    first, second = {"slam.em.noise": 0.5}, {"slam.em.noise": 1.0}
    results = SweepResults(tmp_path, PROVENANCE)
    assert first not in results
    results.add([first, second], [{ATE: 0.1}, {ATE: float("nan")}])
    again = SweepResults(tmp_path, PROVENANCE)
    assert first in again and second in again and {"slam.em.noise": 2.0} not in again
    assert again.rows([second, first]) == [
        {"setting": 0, "slam.em.noise": 1.0, ATE: None},
        {"setting": 1, "slam.em.noise": 0.5, ATE: 0.1},
    ]
    assert read_sweep(tmp_path / "sweep.json")["provenance"] == PROVENANCE


@pytest.mark.parametrize("key", PROVENANCE)
def test_sweeps_of_other_data_priors_or_settings_are_not_mixed(key, tmp_path):
    SweepResults(tmp_path, PROVENANCE).add([{"a": 1}], [{ATE: 0.1}])
    changed = json.loads(json.dumps(PROVENANCE))
    changed[key] |= {"more": 7}
    with pytest.raises(ValueError, match=rf"sweep.json holds another sweep \({key}.more was None, now it is 7"):
        SweepResults(tmp_path, changed)


def test_a_metric_that_a_setting_lacks_is_empty_in_the_csv():
    lines = list(csv.DictReader(csv_text(grid()).splitlines()))
    assert [line[F1] for line in lines] == ["10.0", "20.0", "30.0", "40.0", "50.0", ""]
    assert [float(line[ATE]) for line in lines] == [row[ATE] for row in grid()]
