"""The table of effects; oracle: sweeps written by hand, whose differences are known."""

import json
from pathlib import Path

import numpy as np
import pytest

from emgs_jax.report.sweeps import SweepResults
from experiments.effects import read_effects, spread, table

REPETITIONS = ["prior.seed", "dataset.start"]
ATE, F1 = "trajectory/ate_sim3_m", "reconstruction/f1_5cm_percent"


def write_sweep(folder: Path, seed: int, errors: dict[tuple[float, float], float], noise: float = 1.0) -> None:
    """A sweep over two keys with the own values (8, inf); `errors` gives the ATE of some of its settings."""
    config = {"em": {"near": 8.0, "far": None, "noise": noise}, "prior": {"seed": seed}}  # None: JSON has no infinity
    data, prior = {"name": "room", "sequence": "0"}, {"name": "simulated", "settings": {"level": 1.0, "seed": seed}}
    settings = [{"em.near": near, "em.far": far} for near, far in errors]
    metrics = [{ATE: error, F1: 50.0} for error in errors.values()]
    folder.mkdir(exist_ok=True)
    SweepResults(folder, {"data": data, "prior": prior, "config": config}).add(settings, metrics)


def test_an_effect_is_the_difference_from_the_sweeps_own_config_in_one_key(tmp_path):
    write_sweep(tmp_path / "0", 0, {(8.0, "inf"): 0.10, (4.0, "inf"): 0.13, (8.0, 2.0): 0.09, (4.0, 2.0): 0.50})
    write_sweep(tmp_path / "1", 1, {(8.0, "inf"): 0.20, (4.0, "inf"): 0.21})
    effects = read_effects(tmp_path, REPETITIONS)
    assert [(e.key, e.value, e.own) for e in effects] == [
        (None, None, None),
        ("em.near", 4.0, 8.0),
        ("em.far", 2.0, "inf"),  # and nothing of the setting that differs in both
    ]
    for effect, wanted in zip(effects, ([0.10, 0.20], [0.03, 0.01], [-0.01]), strict=True):
        np.testing.assert_allclose(effect.metrics[ATE], wanted)
    assert effects[1].metrics[F1] == [0.0, 0.0]
    text = table(effects).splitlines()
    assert text[2].startswith("| room 0, prior simulated 1 | unchanged | 2 | 15.00 ± 7.07 |")
    assert text[3].startswith("| room 0, prior simulated 1 | em.near=4.0 (from 8.0) | 2 | +2.00 ± 1.41 |")


def test_sweeps_with_another_config_or_of_other_code_are_not_averaged_with_these(tmp_path):
    for number, noise in enumerate((1.0, 0.5, 1.0)):
        write_sweep(tmp_path / str(number), number // 2, {(8.0, "inf"): 0.10, (4.0, "inf"): 0.13}, noise)
    path = tmp_path / "2" / "sweep.json"
    sweep = json.loads(path.read_text())
    sweep["provenance"]["git"] = {"revision": "bbbb"}
    path.write_text(json.dumps(sweep))
    effects = read_effects(tmp_path, REPETITIONS)
    assert [len(effect.metrics[ATE]) for effect in effects] == [1] * 6
    assert effects[0].data != effects[2].data


def test_the_config_itself_stands_first_wherever_a_grid_has_it(tmp_path):
    """Its line stood below those of values that an axis names before the config's own."""
    write_sweep(tmp_path / "0", 0, {(4.0, "inf"): 0.13, (8.0, 2.0): 0.09, (8.0, "inf"): 0.10})
    assert [effect.key for effect in read_effects(tmp_path, REPETITIONS)] == [None, "em.near", "em.far"]


def test_a_copy_of_a_sweep_is_no_repetition(tmp_path):
    """Symptom: the same seed three times was 'all of at least three agree', in bold."""
    for number in range(2):
        write_sweep(tmp_path / str(number), 0, {(8.0, "inf"): 0.10, (4.0, "inf"): 0.13})
    with pytest.raises(ValueError, match="1.sweep.json is the same sweep as .*0.sweep.json, and would count"):
        read_effects(tmp_path, REPETITIONS)


def test_the_se3_table_shows_the_metrics_of_that_alignment(tmp_path):
    write_sweep(tmp_path, 0, {(8.0, "inf"): 0.10})
    (effect,) = read_effects(tmp_path, REPETITIONS)
    effect.metrics.update({"trajectory/ate_se3_m": [0.30], "reconstruction_se3/f1_5cm_percent": [40.0]})
    assert table([effect]).splitlines()[2].split(" | ")[3:] == ["10.00", "–", "–", "–", "50.0", "– |"]
    assert table([effect], "se3").splitlines()[2].split(" | ")[3:] == ["30.00", "–", "–", "–", "40.0", "– |"]


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([0.01, 0.02, 0.03], "**+2.0 ± 1.0**"),
        ([-0.01, 0.02, 0.02], "+1.0 ± 1.7"),
        ([0.01, 0.03], "+2.0 ± 1.4"),
        ([0.02], "+2.0"),
        ([], "–"),
    ],
)
def test_a_difference_is_bold_where_three_repetitions_agree_on_its_sign(numbers, text):
    assert spread(numbers, 100.0, 1, is_difference=True) == text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no sweep.json below .*experiments.sweep -m"),
        ("{", "is damaged .* make it again"),
        ('{"format": "emgs_jax.running.batch", "version": 99}', "not a sweep of version 1"),
    ],
)
def test_a_folder_without_readable_sweeps_is_refused_with_the_remedy(content, message, tmp_path):
    if content is not None:
        (tmp_path / "sweep.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_effects(tmp_path, REPETITIONS)


def test_a_sweep_without_its_own_config_is_refused(tmp_path):
    write_sweep(tmp_path, 0, {(4.0, "inf"): 0.13})
    with pytest.raises(ValueError, match="lacks its own config's values .*one_at_a_time"):
        read_effects(tmp_path, REPETITIONS)
