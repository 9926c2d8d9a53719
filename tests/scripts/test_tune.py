"""The search; oracles: metrics that are a known function of the setting, a search that nobody stops, a run's config."""

import csv
import math
import shlex
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tiny_run import TINY

import experiments.together
import experiments.tune
from emgs_jax.config.configure import compose
from experiments.command import check_arguments
from experiments.search import ask, front, open_study, own_setting, read_objectives, read_space

pytestmark = pytest.mark.slow

optuna = pytest.importorskip("optuna")
GATE, GAP = "slam.em.max_mahalanobis_sq", "slam.em.max_log_gap"
ATE, F1 = "trajectory/ate_sim3_m", "reconstruction/f1_5cm_percent"
SPACE = f"space={{{GATE}:{{low:1,high:20,log:true}},{GAP}:[4.0,8.0,.inf]}}".replace(".inf", "inf")
OTHER = "held_out={other:{prior.seed:3}}"
WORDS = (*TINY, SPACE, OTHER, "chunk=3", "trials=8", "startup=3", "best=2")


def known_metrics(seed: int, setting: dict) -> dict:
    """Best at 7 for the path and at 3 for the cloud; the other seed would have it the other way round."""
    gate, gap = setting[GATE], 0.1 * (setting[GAP] != 8.0)
    path, cloud = ((math.log(gate / best) ** 2 + gap) for best in ((7, 3) if seed == 0 else (3, 7)))
    return {ATE: 0.01 + 0.01 * path, F1: 90 - cloud, f"raw_prior/{ATE}": 0.05}


@pytest.fixture
def measured(monkeypatch):
    """The chunks that are measured, as (seed of the prior, settings); after `measured.stop_after` of them Ctrl-C."""

    class Chunks(list):
        stop_after = None

    chunks = Chunks()

    def measure(work, prior, chunk, bar):
        if chunks.stop_after is not None and len(chunks) == chunks.stop_after:
            raise KeyboardInterrupt
        seed = work.prior.provenance.settings["seed"]
        chunks.append((seed, [variant.setting for variant in chunk]))
        return [known_metrics(seed, variant.setting) for variant in chunk]

    monkeypatch.setattr(experiments.together, "map_and_score", measure)
    monkeypatch.setattr(experiments.together, "new_scorer", lambda *_: None)
    monkeypatch.setattr(experiments.together, "replayed", lambda prior, *_: prior)
    return chunks


def test_the_search_finds_what_is_known_to_be_better_and_begins_with_the_configs_own_setting(measured, tmp_path):
    rows = experiments.tune.tune([*WORDS, "trials=24", f"objectives=[minimize {ATE}]"], tmp_path)
    assert [row["trial"] for row in rows] == list(range(24))
    assert (rows[0][GATE], rows[0][GAP]) == (4.6, 8.0)
    best = min(rows, key=lambda row: row[ATE])
    assert best[ATE] < 0.0101 < rows[0][ATE] and best[GAP] == 8.0
    late = [abs(math.log(row[GATE] / 7)) for row in rows[12:]]
    assert sum(late) / len(late) < 0.6  # a uniform draw of the logarithm is .83 off on average


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder, rows and chunks of a search that nobody stopped; made by the first test that asks."""
    found = []

    def search(measured) -> tuple[Path, list[dict], list]:
        if not found:
            folder = tmp_path_factory.mktemp("whole") / "a, b=c"
            found.append((folder, experiments.tune.tune(WORDS, folder), [*measured]))
            measured.clear()
        return found[0]

    return search


def test_what_is_held_out_is_measured_after_the_search_and_decides_nothing(measured, whole):
    folder, rows, chunks = whole(measured)
    assert [seed for seed, _ in chunks] == [0, 0, 0, 3] and chunks[-1][1][0] == {GATE: 4.6, GAP: 8.0}
    with open(folder / "trials.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    best = [row for row, line in zip(rows, lines, strict=True) if line["is_best"] == "True"]
    assert all(not (other[ATE] < row[ATE] and other[F1] > row[F1]) for row in best for other in rows)
    held_out = {setting[GATE] for setting in chunks[-1][1]}
    assert best and held_out == {4.6, *(row[GATE] for row in best)}
    text = (folder / "tune.md").read_text()
    assert "| **held out** | other, simulated | default |" in text and "| tuned | own, simulated | raw prior |" in text
    assert (folder / "tune.png").read_bytes()[:4] == b"\x89PNG"


def test_the_best_are_options_that_a_run_takes_whatever_else_is_chosen(measured, whole):
    folder, _, chunks = whole(measured)
    files = sorted((folder / "best").iterdir())
    assert 1 <= len(files) <= 2
    for path in files:
        line = path.read_text().splitlines()[1]
        words = shlex.split(line.removeprefix("# ").removesuffix(" …"))[2:]
        check_arguments("config", words)
        config = compose("experiment=smoke", *words)
        setting = {GATE: config.slam.em.max_mahalanobis_sq, GAP: config.slam.em.max_log_gap}
        assert str(setting) in [str(one) for one in chunks[-1][1]] and config.slam.window_size == 4


def stopped(monkeypatch, measured, folder: Path, place: int | str) -> None:
    """A search that ends early: after so many chunks, or in the middle of a batch as trial `place` is told."""
    tell, numbers = optuna.Study.tell, []

    def told(study, number, *values, **state):
        if f"trial {number}" == place and not numbers:
            numbers.append(number)
            raise KeyboardInterrupt
        return tell(study, number, *values, **state)

    measured.stop_after = place if isinstance(place, int) else None
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(optuna.Study, "tell", told)
        experiments.tune.tune(WORDS, folder)
    measured.stop_after = None


def test_a_search_that_is_stopped_goes_on_with_the_trials_of_one_that_is_not(measured, tmp_path, monkeypatch, whole):
    """In the second batch, and as it is told: what was told of it must not change the rest of it, or the next one."""
    folder, rows, _ = whole(measured)
    for place in (1, "trial 4"):
        stopped(monkeypatch, measured, tmp_path, place)
    assert experiments.tune.tune(WORDS, tmp_path) == rows
    for name in ("trials.csv", "tune.md"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
    measured.clear()
    assert experiments.tune.tune(WORDS, tmp_path) == rows and not measured  # and once more changes nothing


def test_more_trials_go_on_another_search_is_not_mixed_in_and_one_that_was_told_nothing_begins_anew(
    measured, tmp_path, monkeypatch
):
    stopped(monkeypatch, measured, tmp_path, 0)
    with_few = [*WORDS, f"{GATE}=40", "trials=4"]  # the default is not in the space: it is measured, and is no trial
    rows = experiments.tune.tune(with_few, tmp_path)
    assert all(1 <= row[GATE] <= 20 for row in rows) and measured[0][1][0][GATE] == measured[-1][1][0][GATE] == 40
    assert "| default |" in (tmp_path / "tune.md").read_text()
    assert experiments.tune.tune([*with_few, "trials=6"], tmp_path)[:4] == rows
    with pytest.raises(ValueError, match=rf"holds another search \(space.{GATE}.high was 20.0, now it is 10.0"):
        experiments.tune.tune([*with_few, f"space={{{GATE}:{{low:1,high:10,log:true}}}}"], tmp_path)


def test_a_metric_that_is_none_is_named_and_a_trial_without_a_value_fails_and_the_others_go_on(
    measured, tmp_path, monkeypatch
):
    with pytest.raises(ValueError, match=f"trajectory/ate_sim_m of own is no metric; near names: {ATE}"):
        experiments.tune.tune([*WORDS, "objectives=[minimize trajectory/ate_sim_m]"], tmp_path / "other")
    measure = experiments.together.map_and_score

    def lost(work, prior, chunk, bar):
        found = measure(work, prior, chunk, bar)
        return [m | {ATE: None} if v.setting[GAP] == 4.0 else m for m, v in zip(found, chunk, strict=True)]

    monkeypatch.setattr(experiments.together, "map_and_score", lost)
    rows = experiments.tune.tune([*WORDS, "trials=12"], tmp_path)
    missing = [row for row in rows if row[GAP] == 4.0]
    assert len(rows) == 12 and missing and all(row[ATE] is None for row in missing)
    assert "is_best" in (tmp_path / "trials.csv").read_text().splitlines()[0]


def told_trials(path, space, own, values, objectives):
    """A study whose first trials have these values."""
    study = open_study(path / "study.jsonl", {}, objectives)
    for trial, value in zip(ask(study, space, own, len(values), 0, 9), values, strict=True):
        study.tell(trial.number, value)
    return study


def test_the_front_has_what_nothing_beats_and_is_thinned_evenly_and_one_objective_has_one_best(tmp_path):
    values = [(3.0, 3.0), (1.0, 1.0), (2.0, 2.0), (5.0, 2.5), (4.0, 4.0), (5.0, 5.0), (2.5, 1.0)]
    space = {GATE: optuna.distributions.FloatDistribution(0.0, 10.0)}, {GATE: 1.0}
    study = told_trials(tmp_path, *space, values, {ATE: "minimize", F1: "maximize"})
    unbeaten = [
        number
        for number, (a, b) in sorted(enumerate(values), key=lambda item: item[1])
        if not any(c <= a and d >= b and (c, d) != (a, b) for c, d in values)
    ]
    assert [trial.number for trial in front(study, 9)] == unbeaten == [1, 2, 0, 4, 5]
    assert [trial.number for trial in front(study, 3)] == [1, 0, 5]
    (tmp_path / "one").mkdir()
    study = told_trials(tmp_path / "one", *space, [3.0, 9.0, 1.0, 2.0], {F1: "maximize"})
    assert [trial.number for trial in front(study, 5)] == [1]


def test_whole_numbers_stay_whole(tmp_path):
    key = "slam.em.num_neighbours"
    space = read_space(compose(f"space={{{key}:{{low:4,high:32,log:true}}}}", name="tune"))
    study = open_study(tmp_path / "study.jsonl", {}, {F1: "maximize"})
    drawn = [trial.params[key] for trial in ask(study, space, {key: 8}, 5, 0, 9)]
    assert drawn[0] == 8 and all(type(value) is int and 4 <= value <= 32 for value in drawn)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([f"space={{{GATE}:{{low:-1,high:2}}}}"], rf"{GATE} must be a number from 0 to inf, got -1"),
        ([f"space={{{GATE}:{{low:1,high:inf}}}}"], "cannot be drawn up to inf: give a finite end"),
        ([f"space={{{GATE}:{{low:0,high:1,log:true}}}}"], "low above 0 with log: true"),
        ([f"space={{{GATE}:[3,-4]}}"], rf"{GATE} must be a number from 0 to inf, got -4"),
        (["space={slam.em.support:{low:0,high:1}}"], r"write slam.em.support: \[printed, normalized\]"),
        ([SPACE], r"held_out names no sequence.*'held_out=\{fresh:\{prior\.seed:3\}\}'"),
        ([SPACE, "held_out={same:{on_bad_frame:skip}}"], "held_out.same is the tuned sequence own"),
        ([SPACE, "held_out={../up:{prior.seed:3}}"], "plain names"),
        ([SPACE, f"held_out={{other:{{{GATE}:3}}}}"], "gives .* a value, but it is searched"),
        ([SPACE, "held_out={other:{prior.sed:3}}"], r"prior\.sed is no key of the config; near names: prior\.seed"),
        ([SPACE, OTHER, "graph=default"], "graph= is for run and evaluate: a search steps"),
    ],
)
def test_what_cannot_be_searched_is_refused_with_the_remedy_and_nothing_is_written(measured, tmp_path, words, message):
    with pytest.raises(ValueError, match=message):
        experiments.tune.tune([*TINY, *words], tmp_path / "out")
    assert not measured and not (tmp_path / "out").exists()


def test_without_optuna_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ValueError, match=r'needs Optuna: pip install "emgs_jax\[tune\]"'):
        experiments.tune.tune(WORDS, tmp_path)


@pytest.mark.parametrize("name", ["gates", "weights"])
def test_every_space_of_conf_holds_the_configs_own_values(name, tmp_path):
    config = compose(f"tune={name}", name="tune")
    space = read_space(config)
    study = open_study(tmp_path / "study.jsonl", {}, {F1: "maximize"})
    (first,) = ask(study, space, own_setting(config, space), 1, 0, 9)
    assert first.params == {key: OmegaConf.select(config, key) for key in space}
    assert list(read_objectives(config).values()) == ["minimize", "maximize"]
