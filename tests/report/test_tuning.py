"""What a search leaves; oracles: results written by hand, YAML that is read back."""

from dataclasses import replace

import pytest
import yaml

from emgs_jax.report.tuning import SequenceResults, draw_trials, settings_yaml, table, verdict

ATE, F1, OTHER = "trajectory/ate_sim3_m", "reconstruction/f1_5cm_percent", "map/num_gaussians"
OBJECTIVES = {ATE: "minimize", OTHER: "maximize"}


def results(name: str, is_held_out: bool, default: float, trial: float, raw: float | None = 0.05) -> SequenceResults:
    raws = {} if raw is None else {f"raw_prior/{ATE}": raw}
    metrics = {"default": {ATE: default, F1: 50.0, OTHER: 100} | raws, "trial 7": {ATE: trial, F1: 40.0, OTHER: 120}}
    return SequenceResults(name, "tum", is_held_out, True, metrics)


ALL = [results("a", False, 0.02, 0.01), results("b", False, 0.04, 0.01), results("c", True, 0.03, 0.06)]


def lines_of(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]


def test_what_is_held_out_stands_apart_with_the_prior_the_default_and_the_best():
    lines = lines_of(table(ALL, OBJECTIVES))
    assert lines[0][3:5] == ["ATE [cm]", OTHER] and "F1@.05 [%]" in lines[0]
    others = [replace(result, data="colmap") for result in ALL[:2]]
    assert lines_of(table([*others, ALL[2]], OBJECTIVES))[0][3] == "ATE [cm or .01 units]"
    rows = [line[:5] for line in lines[2:]]
    assert rows[:3] == [
        ["tuned", "a, simulated", "raw prior", "5.00", "–"],
        ["tuned", "a, simulated", "default", "2.00", "100.0000"],
        ["tuned", "a, simulated", "trial 7", "**1.00**", "**120.0000**"],
    ]
    means = [row for row in rows if row[1] == "mean of 2"]
    assert [row[3] for row in means] == ["5.00", "3.00", "**1.00**"]
    assert [row[3] for row in rows if row[0] == "**held out**"] == ["5.00", "**3.00**", "6.00"]
    assert [row[0] for row in rows] == ["tuned"] * 9 + ["**held out**"] * 3
    rows = lines_of(table([results("a", True, 0.02, 0.01, raw=0.001)], OBJECTIVES))[2:]
    assert [row[3] for row in rows] == ["0.10", "2.00", "**1.00**"], (
        "the prior alone, which is better still, is not ours"
    )


def test_a_mean_that_some_sequence_lacks_is_none():
    rows = lines_of(table([ALL[0], results("b", False, 0.04, 0.01, raw=None), ALL[2]], OBJECTIVES))[2:]
    assert [row[2] for row in rows if row[1] == "mean of 2"] == ["default", "trial 7"]


def test_the_verdict_counts_on_how_many_held_out_sequences_each_objective_is_better():
    (line,) = verdict([*ALL, results("d", True, 0.03, 0.02)], OBJECTIVES).values()
    assert line == (
        f"held out, trial 7 against the default: {ATE} 0.03 → 0.04, better on 1 of 2; "
        f"{OTHER} 100 → 120, better on 2 of 2"
    )
    (line,) = verdict(ALL, {"nothing": "minimize"}).values()
    assert line.endswith("nothing has no value")


def test_settings_are_an_option_for_the_whole_config():
    text = settings_yaml({"slam.em.noise": 2.0, "slam.em.max_log_gap": float("inf"), "slam.fit.min_std": 0.1}, ["why"])
    assert text.splitlines()[:2] == ["# @package _global_", "# why"]
    assert yaml.safe_load(text) == {
        "slam": {"em": {"noise": 2.0, "max_log_gap": float("inf")}, "fit": {"min_std": 0.1}}
    }


@pytest.mark.parametrize("objectives", [OBJECTIVES, {ATE: "minimize"}])
def test_the_picture_shows_trials_that_have_a_value_or_says_that_there_is_none(tmp_path, objectives):
    rows = [{"trial": 0, ATE: 0.02, OTHER: 100}, {"trial": 1, ATE: None, OTHER: 100}]
    assert draw_trials(tmp_path / "tune.png", rows, objectives, {0: "default"}, "a search", ["tum"]) is None
    assert (tmp_path / "tune.png").read_bytes()[:4] == b"\x89PNG"
    assert draw_trials(tmp_path / "no.png", rows[1:], objectives, {}, "", ["tum"]) == "no trial has all objectives"
