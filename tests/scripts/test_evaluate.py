"""The batch: what runs, what is skipped, what failures and interruptions leave; oracle: a run that is made up."""

import contextlib
import csv
import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import own_process
import pytest
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from tiny_run import CONF, TINY

import experiments.evaluate
from emgs_jax.config.configure import compose, groups
from emgs_jax.report.gate import TOLERANCES, read_gate
from emgs_jax.runs.provenance import RESULT_FORMAT, git_now, write_metrics
from emgs_jax.runs.results import METRICS_FILE
from experiments.command import clear_errors

pytestmark = pytest.mark.slow

THIS_CODE = {"git": git_now(), "versions": {"emgs_jax": importlib.metadata.version("emgs_jax")}}


def composed(*words: str) -> dict:
    return OmegaConf.to_container(compose(*words, name="evaluate"), resolve=True, throw_on_missing=True)


def jobs_of(*words: str) -> list:
    return list(experiments.evaluate.plan(composed(*words)))


def made_up(config: DictConfig, folder: Path) -> None:
    """A run that only writes what it is of: metrics, of a room and a seed."""
    block = {"format": RESULT_FORMAT, "protocol": config.evaluation.protocol, "simulated": True} | THIS_CODE
    block |= {"prior": {"name": "simulated"}, "config": OmegaConf.to_container(config, resolve=True)}
    block["data"] = {"name": "synthetic", "sequence": f"room{config.dataset.seed}"}
    ate = 0.01 * (1 + config.dataset.seed) + 0.001 * config.prior.seed
    write_metrics(folder / METRICS_FILE, {"trajectory/ate_sim3_m": ate, "provenance": block})


@pytest.fixture
def evaluate(tmp_path, monkeypatch):
    """`evaluate("seeds=[0,1]", …)`: problems of an evaluation of two rooms whose runs only write what they are of.

    `evaluate.runs` holds the room and seed of each run; `evaluate.broken` maps a room to the error that its runs raise,
    those of `evaluate.late` after they have written their metrics.
    """

    def run(config, folder):
        evaluation.runs.append((config.dataset.seed, config.prior.seed))
        is_broken = config.dataset.seed in evaluation.broken
        if is_broken and config.dataset.seed not in evaluation.late:
            raise evaluation.broken[config.dataset.seed]
        made_up(config, folder)
        if is_broken:
            raise evaluation.broken[config.dataset.seed]

    def evaluation(*overrides):
        evaluation.runs.clear()
        rooms = "suite.data.synthetic.sequences=[0,1]"
        words = "suite=smoke", rooms, f"out={tmp_path / 'out'}", *overrides
        return experiments.evaluate.evaluate(composed(*words))

    evaluation.runs, evaluation.broken, evaluation.late, evaluation.out = [], {}, set(), tmp_path / "out"
    monkeypatch.setattr(experiments.evaluate, "run", run)
    return evaluation


def test_every_sequence_is_run_with_every_seed_and_variant_and_what_is_finished_is_skipped(evaluate):
    """Results that the command does not name stay, and never enter its tables: they may have other settings."""
    wide = "+variants.wide={slam.window_size:7}"
    assert evaluate("seeds=[0,2]", wide) == []
    assert evaluate.runs == [(0, 0), (0, 2), (1, 0), (1, 2)] * 2
    configs = {
        path.relative_to(evaluate.out).parent.as_posix(): json.loads(path.read_text())["provenance"]["config"]
        for path in evaluate.out.rglob(METRICS_FILE)
    }
    assert {name: config["slam"]["window_size"] for name, config in configs.items()} == {
        f"synthetic/{room}/{variant}/{seed}": size
        for room in (0, 1)
        for variant, size in (("default", 4), ("wide", 7))
        for seed in (0, 2)
    }
    kept = evaluate.out / "synthetic/0/default/0" / METRICS_FILE
    before = kept.read_bytes()
    assert evaluate("seeds=[0,1]") == [] and evaluate.runs == [(0, 1), (1, 1)] and kept.read_bytes() == before
    lines = list(csv.DictReader((evaluate.out / "results.csv").open()))
    assert {(line["seed"], line["variant"]) for line in lines} == {("0", "default"), ("1", "default")}
    with pytest.raises(ValueError, match=r"window_size was 4, now it is 7.*\+variants.NAME"):
        evaluate("seeds=[0,3]", 'overrides=["slam.window_size=7"]')
    assert evaluate.runs == []
    kept.write_bytes(before.replace(b'"format": %d' % RESULT_FORMAT, b'"format": -1'))
    with pytest.raises(ValueError, match="written by another version"):
        evaluate("seeds=[0,3]")
    assert evaluate.runs == []


def test_the_shards_do_every_job_once_and_are_parts_of_a_whole(evaluate):
    """One after the other, so that each sees other jobs finished: what is whose must not depend on it."""
    done = []
    for part in (1, 2, 3):
        assert evaluate("seeds=[0,1]", f"shard={part}/3") == []
        done += evaluate.runs
    assert done == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_a_job_that_fails_does_not_stop_the_others_and_is_named_at_the_end(evaluate, capsys):
    evaluate.broken[0] = OSError("frame 3 is gone")
    assert evaluate("seeds=[0]") == ["synthetic/0/default/0: frame 3 is gone"]
    assert evaluate.runs == [(0, 0), (1, 0)]
    assert "- not finished: synthetic/0/default/0: frame 3 is gone" in (evaluate.out / "results.md").read_text()
    page = (evaluate.out / "report.html").read_text()
    assert "not finished: frame 3 is gone" in page and "1 of 2 runs are finished" in page and "SIMULATED" in page
    assert "room1" in capsys.readouterr().out
    note = evaluate.out / "synthetic/0/default/0" / experiments.evaluate.ERROR_FILE
    assert "OSError: frame 3 is gone" in note.read_text()
    # the same command tries again
    evaluate.broken.clear()
    assert evaluate("seeds=[0]") == [] and evaluate.runs == [(0, 0)]
    assert not note.exists() and "not finished" not in (evaluate.out / "results.md").read_text()


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_a_job_that_fails_after_its_metrics_are_there_is_not_finished(evaluate, error):
    evaluate.broken[0], evaluate.late = error, {0}
    with contextlib.suppress(KeyboardInterrupt):
        assert evaluate("seeds=[0]") == ["synthetic/0/default/0: no space left"]
    evaluate.broken.clear()
    assert evaluate("seeds=[0]") == [] and (0, 0) in evaluate.runs
    assert evaluate("seeds=[0]") == [] and evaluate.runs == []


def test_an_interrupted_evaluation_has_the_tables_of_what_is_finished_and_resumes(evaluate):
    evaluate.broken[1] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        evaluate("seeds=[0,1]")
    lines = list(csv.DictReader((evaluate.out / "results.csv").open()))
    assert [(line["sequence"], line["seed"]) for line in lines] == [("room0", "0"), ("room0", "1")]
    summary = json.loads((evaluate.out / "results.json").read_text())
    assert summary["missing"] == {"synthetic/1/default/0": "to do", "synthetic/1/default/1": "to do"}
    evaluate.broken.clear()
    assert evaluate("seeds=[0,1]") == [] and evaluate.runs == [(1, 0), (1, 1)]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+variants.wide={slam.window_size:2.5}", r"slam\.window_size must be a whole number from 1 to 1000, got 2\.5"),
        ("seeds=[0,1.5]", r"prior\.seed must be a whole number, got 1\.5"),
        ("+variants={../..:{}}", "variant or method must be a name"),
        ("+variants.other={prior.seed:7}", r"prior.seed=7 would have no effect, .*: give seeds=\["),
    ],
)
def test_a_value_or_name_that_is_refused_ends_the_evaluation_before_it_begins(evaluate, override, message):
    with pytest.raises(ValueError, match=message):
        evaluate(override)
    assert evaluate.runs == [] and not evaluate.out.exists()


def test_the_gate_passes_with_the_same_results_and_names_what_is_worse(evaluate, tmp_path):
    gate = tmp_path / "gate.yaml"
    assert evaluate("seeds=[0,1]", f"write_gate={gate}") == []
    assert evaluate("seeds=[0,1]", f"gate={gate}") == [] and evaluate.runs == []
    baseline = yaml.safe_load(gate.read_text())
    baseline["baseline"]["synthetic/room1/default"]["metrics"]["trajectory/ate_sim3_m"]["value"] = 0.01
    gate.write_text(yaml.safe_dump(baseline))
    (problem,) = evaluate("seeds=[0,1]", f"gate={gate}")
    assert problem.startswith("regression: synthetic/room1/default: trajectory/ate_sim3_m is 0.0205, baseline 0.01")
    page = (evaluate.out / "report.html").read_text()
    assert "1 is worse than the gate allows" in page and "trajectory/ate_sim3_m is 0.0205, baseline 0.01" in page


@pytest.mark.parametrize(
    "other", [{"git": {"revision": "f" * 40, "dirty": False}}, {"git": None, "versions": {"emgs_jax": "0.0.1"}}]
)
def test_results_of_other_code_are_named_and_pass_no_gate(evaluate, tmp_path, capsys, other):
    """After an update the gate passed at once: with the results of before."""
    gate = tmp_path / "gate.yaml"
    assert evaluate(f"write_gate={gate}") == [] and "other code" not in capsys.readouterr().out
    (path,) = evaluate.out.glob("synthetic/1/*/0/metrics.json")
    metrics = json.loads(path.read_text())
    metrics["provenance"] |= other
    path.write_text(json.dumps(metrics))
    with pytest.raises(ValueError, match=r"1 of 2 results are of other code \(synthetic/1/default/0\), and a gate "):
        evaluate(f"gate={gate}")
    assert evaluate() == [] and evaluate.runs == [] and "they are kept" in capsys.readouterr().out
    path.unlink()
    assert evaluate(f"gate={gate}") == [] and evaluate.runs == [(1, 0)]


def test_a_prior_without_a_seed_is_evaluated_with_one(evaluate):
    recorded = 'overrides=["prior=recorded","prior.folder=predictions/\\${dataset.seed}"]'
    jobs = jobs_of("suite=smoke", recorded)
    assert [job.config.prior.folder for job in jobs] == ["predictions/0"]


def test_the_committed_baseline_holds_every_metric_of_the_suite_and_the_protocol_of_its_name():
    baseline = read_gate(CONF.parent / "tools" / "gate.yaml")
    assert {name: entry["protocol"] for name, entry in baseline.items()} == {"synthetic/room0/default": "paper/sim3"}
    for entry in baseline.values():
        directions = {key: rule["direction"] for key, rule in entry["metrics"].items()}
        assert directions == {key: rule["direction"] for key, rule in TOLERANCES.items()}


@pytest.mark.parametrize("name", groups()["suite"])
def test_every_suite_makes_jobs_that_know_their_sequence_and_name_no_path_of_a_machine(name):
    assert "/" not in yaml.safe_load((CONF / "suite" / f"{name}.yaml").read_text()).get("root", "???")
    keys = {"smoke": [], "learned": ["root", "weights"]}.get(name, ["root"])
    jobs = jobs_of(f"suite={name}", *(f"suite.{key}=some folder" for key in keys))
    sequences = [job.config.dataset.get("sequence", job.config.dataset.get("seed")) for job in jobs]
    count = {"seven_scenes": 7, "tum": 9, "tum_loops": 3, "replica": 8, "slices": 4, "smoke": 1, "learned": 1}[name]
    num_variants = 5 if name == "learned" else 1
    assert len({job.folder for job in jobs}) == num_variants * len(set(sequences)) == num_variants * count
    assert all(job.config.dataset.get("root", "some folder").startswith("some folder") for job in jobs)


@pytest.mark.parametrize(("mode", "error"), [(RunMode.RUN, SystemExit), (RunMode.MULTIRUN, ValueError)])
def test_an_error_in_a_multirun_goes_to_hydra_so_that_the_other_jobs_run(monkeypatch, mode, error):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    running = OmegaConf.create({"hydra": {"mode": mode}})
    monkeypatch.setattr(HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr(HydraConfig, "get", lambda: running.hydra)
    with pytest.raises(error, match="what is wrong"), clear_errors():
        raise ValueError("what is wrong")


def test_words_that_are_no_key_of_an_evaluation_go_to_its_runs_as_they_are():
    """Written into overrides=[…] by hand they had to be quoted twice."""
    words = ["prior=recorded", "prior.folder='my predictions/${dataset.sequence}'", "dataset.size=[160,120]"]
    own = ["suite=tum", "-m", "suite.root=it", "hydra/launcher=joblib", "+variants.wide={slam.window_size:7}"]
    assert experiments.evaluate.delegated(["--cfg", "job", *own]) == ["--cfg", "job", *own]
    arguments = experiments.evaluate.delegated([*words[:1], *own, *words[1:]])
    assert arguments[1:] == own and experiments.evaluate.delegated(own) == own
    given = [text for text in arguments if text[0] != "-" and not text.startswith(("hydra", "suite.root"))]
    jobs = jobs_of(*given, "suite.root='some folder'")
    for job in jobs:
        sequence = job.config.dataset.sequence
        assert job.config.prior.folder == f"my predictions/{sequence}" and job.config.dataset.root == "some folder"
        assert job.config.dataset.size == [160, 120]
    assert [job.config.slam.window_size for job in jobs] == [10] * 9 + [7] * 9
    with pytest.raises(ValueError, match="prior=recorded is for the runs"):
        experiments.evaluate.delegated(["prior=recorded", "overrides=['prior.seed=1']"])


@pytest.mark.slow
def test_the_exit_status_says_that_a_job_failed(tmp_path):
    done = own_process.run("experiments.evaluate", "suite=tum", f"suite.root={tmp_path}", f"out={tmp_path / 'out'}")
    assert done.returncode == 1
    assert "problems: 9" in done.stderr and "freiburg1_xyz does not exist" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.weekly
@pytest.mark.parametrize("launcher", ["basic", "joblib", "submitit_local"])
def test_shards_run_on_the_launchers_of_hydra(tmp_path, launcher):
    """One shard fails: the other one's result is there, and the command says what is wrong."""
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher.removesuffix('_local')}_launcher")
    out, tiny = tmp_path / "out", "overrides=[" + ",".join(f"'{word}'" for word in TINY) + "]"
    words = ("-m", f"hydra/launcher={launcher}", "shard=1/2,2/2", "suite=smoke", tiny, f"out={out}")
    command = [sys.executable, "-m", "experiments.evaluate", *words, "suite.data.synthetic.sequences=[-1,0]"]
    done = subprocess.run(command, cwd=CONF.parent, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 1, done.stderr
    assert "dataset.seed must be 0 or more" in done.stderr + done.stdout
    assert [path.parent.relative_to(out).as_posix() for path in out.rglob(METRICS_FILE)] == ["synthetic/0/default/0"]
    assert (out / "results.md").is_file() and not Path(CONF.parent / "multirun.yaml").exists()
