"""Oracles: the same results pass, results moved by a known amount pass or fail on the right side of the tolerance."""

import dataclasses
import json
from pathlib import Path

import pytest

from emgs_jax.report.gate import read_gate, regressions, rounding_tolerances, write_gate
from emgs_jax.report.tables import Row
from emgs_jax.runs.results import Estimate

ATE, F1 = "trajectory/ate_sim3_m", "reconstruction/f1_20cm_percent"
TOLERANCES = {ATE: {"direction": "lower", "tolerance": 0.01}, F1: {"direction": "higher", "tolerance": 1.0}}


def a_row(ate=0.05, f1=90.0, **changes):
    values = {ATE: ate, F1: f1, "time/total_seconds": 3.0}
    row = Row("tum", "default", "ours", "simulated", True, "paper/sim3", ("xyz",), (0, 1), values, {})
    return dataclasses.replace(row, **changes)


@pytest.fixture
def baseline(tmp_path):
    """As written from `a_row()` and read back."""
    raw = dataclasses.replace(a_row(ate=0.5, f1=10.0), kind="raw prior")
    write_gate(tmp_path / "gate.yaml", [raw, a_row(), raw], TOLERANCES)
    return read_gate(tmp_path / "gate.yaml")


def test_a_written_baseline_holds_our_rows_and_passes_with_the_same_results_as_json_too(tmp_path, baseline):
    assert list(baseline) == ["tum/xyz/default"]
    assert baseline["tum/xyz/default"]["metrics"] == {
        ATE: {"value": 0.05, "direction": "lower", "tolerance": 0.01},
        F1: {"value": 90.0, "direction": "higher", "tolerance": 1.0},
    }
    assert regressions(baseline, [a_row()]) == []
    (tmp_path / "gate.json").write_text(json.dumps({"format": 1, "baseline": baseline}))
    assert read_gate(tmp_path / "gate.json") == baseline


def test_what_is_said_above_a_baseline_stays_when_it_is_written_anew(tmp_path):
    path = tmp_path / "gate.yaml"
    write_gate(path, [a_row()], TOLERANCES)
    plain = path.read_text()
    path.write_text("# how it was made\n# and when\n" + plain + "# a remark\n")
    write_gate(path, [a_row()], TOLERANCES)
    assert path.read_text() == "# how it was made\n# and when\n" + plain


@pytest.mark.parametrize(
    ("ate", "f1", "worse"),
    [(0.059, 90, []), (0.061, 90, [ATE]), (0.05, 88.9, [F1]), (0.0, 100, []), (0.07, 80, [ATE, F1])],
)
def test_only_what_is_worse_than_the_tolerance_is_a_regression(baseline, ate, f1, worse):
    lines = regressions(baseline, [a_row(ate, f1)])
    assert [next(key for key in TOLERANCES if key in line) for line in lines] == worse
    if worse == [ATE]:
        assert lines[0] == f"tum/xyz/default: {ATE} is 0.061, baseline 0.05 (lower is better, tolerance 0.01)"


def test_a_missing_result_is_a_regression(baseline):
    assert "no result" in regressions(baseline, [])[0]
    assert "no result" in regressions(baseline, [a_row(protocol="paper/se3")])[0]
    assert "results of the seeds [0]" in regressions(baseline, [a_row(seeds=(0,))])[0]
    for value in (None, float("nan")):
        lines = regressions(baseline, [a_row(ate=value)])
        assert len(lines) == 1 and ATE in lines[0]


@pytest.mark.parametrize(
    "content",
    [
        "[",
        "format: 7\nbaseline: {}",
        "just text",
        "format: 1\nbaseline: {a: {protocol: p, seeds: [0], metrics: {m: {value: 1, direction: up, tolerance: 0}}}}",
        "format: 1\nbaseline: {a: {protocol: p, seeds: [0], metrics: {m: {value: 1, direction: lower}}}}",
        "format: 1\nbaseline: {a: {seeds: [0], metrics: {}}}",
    ],
)
def test_a_file_that_is_no_baseline_is_refused_with_a_remedy(tmp_path, content):
    (tmp_path / "gate.yaml").write_text(content)
    with pytest.raises(ValueError, match=r"gate.yaml is no baseline.*write_gate=FILE"):
        read_gate(tmp_path / "gate.yaml")


def test_a_baseline_of_nothing_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no result of ours"):
        write_gate(tmp_path / "new.yaml", [], TOLERANCES)


def estimates(ates, f1s, kind="ours", variant="default"):
    return [
        Estimate(Path(), "tum", "xyz", variant, kind, seed, "simulated", True, "paper/sim3", None, {ATE: ate, F1: f1})
        for seed, (ate, f1) in enumerate(zip(ates, f1s, strict=True))
    ]


def test_tolerances_are_four_deviations_of_what_rounding_does_to_the_mean_of_the_baselines_seeds():
    """The seeds differ by metres, each from itself by 2 cm up or down: 4 · .02 / √4 = .04; F1 by nothing."""
    first = estimates([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [50.0] * 6)
    again = estimates([1.02, 1.98, 3.02, 3.98, 5.02, 5.98], [50.0] * 6)
    noise = [*estimates([9.0] * 6, [9.0] * 6, "raw prior"), *estimates([9.0] * 6, [9.0] * 6, variant="paper")]
    found = rounding_tolerances(TOLERANCES, [*noise, *first], [*reversed(again), *noise[:6]], num_seeds=4)
    assert found == {ATE: {"direction": "lower", "tolerance": 0.04}, F1: TOLERANCES[F1]}
    assert rounding_tolerances(TOLERANCES, first, first, 4) == TOLERANCES
