"""Evaluate data sets × sequences × variants × seeds: `python -m experiments.evaluate suite=smoke seeds=[0,1,2]`.

Finished jobs are skipped, so the same command resumes; a failed job does not stop the others. `out` gets a folder per
job, results.csv, results.json, results.md and report.html.
"""

import contextlib
import copy
import re
import shlex
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.config.configure import check_added, compose, message_of
from emgs_jax.config.overrides import quoted, written
from emgs_jax.config.values import check_values
from emgs_jax.io.files import check_writable, write_file, write_json
from emgs_jax.report.evaluation_page import Found, JobLine, write_evaluation_page
from emgs_jax.report.gate import TOLERANCES, read_gate, regressions, rounding_tolerances, write_gate
from emgs_jax.report.published import published
from emgs_jax.report.tables import Row, average, full_table, paper_table, to_csv
from emgs_jax.runs.provenance import code_now, code_of
from emgs_jax.runs.results import METRICS_FILE, is_finished, read_estimates, read_metrics, result_folder

from .command import command, overrides_of
from .run import run

ERROR_FILE = "error.txt"
SEQUENCE = "dataset.sequence"  # key that a suite's sequences are values of, unless it names another


@dataclass(frozen=True)
class Job:
    """One run."""

    name: str
    dataset: str
    config: DictConfig
    folder: Path


def plan(settings: Mapping[str, Any]) -> Iterator[Job]:
    """All jobs of a resolved conf/evaluate.yaml, by data set."""
    for dataset, data in settings["suite"]["data"].items():
        own = [f"{key}={written(value)}" for key, value in data["overrides"].items()]
        for variant, changes in settings["variants"].items():
            changed = [f"{key}={written(value)}" for key, value in changes.items()]
            _check_free([*settings["overrides"], *changed], dataset, data.get("key", SEQUENCE))
            overrides = [f"dataset={dataset}", *own, *settings["overrides"], *changed]
            common = compose(*overrides)
            check_added(overrides)
            has_seed = "seed" in common.prior
            if not has_seed and len(settings["seeds"]) > 1:
                raise ValueError(f"prior.seed is no key of {common.prior._target_}: give one seed, seeds=[0]")
            for sequence in data["sequences"]:
                for seed in settings["seeds"]:
                    config = copy.deepcopy(common)
                    OmegaConf.update(config, data.get("key", SEQUENCE), sequence)
                    if has_seed:
                        config.prior.seed = seed
                    for part in config:
                        check_values(config, part)
                    folder = result_folder(Path(settings["out"]), dataset, sequence, variant, seed)
                    yield Job(f"{dataset}/{sequence}/{variant}/{seed}", dataset, config, folder)


def _check_free(overrides: Sequence[str], dataset: str, key: str) -> None:
    """Raise ValueError if an override names a key in which the jobs differ."""
    taken = {"dataset": "suite=NAME", key: f"suite.data.{dataset}.sequences=[…]", "prior.seed": "seeds=[…]"}
    for text in overrides:
        if (name := text.lstrip("+~").partition("=")[0]) in taken:
            raise ValueError(f"{text} would have no effect, because every job has its own {name}: give {taken[name]}")


def delegated(arguments: Sequence[str]) -> list[str]:
    """Move arguments that are no key of conf/evaluate.yaml, such as `prior=recorded`, into `overrides`."""
    own = {*compose("suite=smoke", name="evaluate"), "hydra"}
    rest = [text for text in overrides_of(arguments) if re.split(r"[=./@]", text.lstrip("+~"))[0] not in own]
    kept = [text for text in arguments if text not in rest]
    if rest and any(text.startswith("overrides=") for text in kept):
        raise ValueError(
            f"{rest[0]} is for the runs: write it into overrides=[…], or all of those as words of their own"
        )
    # Interpolations are resolved by the runs.
    words = [quoted(text.replace("${", r"\${")) for text in rest]
    return [f"overrides=[{','.join(words)}]", *kept] if rest else kept  # options such as --cfg come last


def evaluate(settings: Mapping[str, Any], command_line: str = "") -> list[str]:
    """Run this shard's unfinished jobs and write the tables; return the problems. The page names the `command_line`."""
    out, part, whole = Path(settings["out"]), *_shard(settings["shard"])
    if whole > 1 and (settings["gate"] or settings["write_gate"]):
        raise ValueError("a gate needs the results of all jobs: run once more without shard")
    baseline = read_gate(settings["gate"]) if settings["gate"] else {}
    if settings["rounded"] and not (settings["write_gate"] and read_estimates(Path(settings["rounded"]))):
        raise ValueError(
            f"rounded={settings['rounded']} must be a folder of results of the same jobs, for write_gate=FILE: "
            "evaluate into it first, by other instructions of the processor"
        )
    if settings["write_gate"]:
        check_writable(Path(settings["write_gate"]).parent, f"write_gate={settings['write_gate']}")
    jobs = list(plan(settings))
    if not jobs:
        raise ValueError("there is nothing to evaluate: give one seed or more, seeds=[0]")
    read_estimates(out)  # fails before the evaluation begins
    ours = jobs[(part - 1) * len(jobs) // whole : part * len(jobs) // whole]  # neighbours share executables
    open_jobs = [job for job in ours if not _is_finished(job)]
    finished, now = [job for job in jobs if (job.folder / METRICS_FILE).is_file()], code_now()
    if older := [job.name for job in finished if code_of(read_metrics(job.folder / METRICS_FILE)["provenance"]) != now]:
        said = f"{len(older)} of {len(jobs)} results are of other code ({older[0]}{', …' * (len(older) > 1)})"
        if baseline:
            raise ValueError(f"{said}, and a gate needs the current code: choose another out=FOLDER, or move them away")
        print(f"{said}: they are kept (move them away to compute them again)")
    print(f"shard {part}/{whole}: {len(open_jobs)} of its {len(ours)} jobs to do, {len(jobs)} in all")
    failures: dict[str, str] = {}
    try:
        _run_all(open_jobs, failures)
    finally:
        rows, found = _write_tables(out, jobs, failures)
        worse = regressions(baseline, rows)
        write_evaluation_page(out, found._replace(gate=settings["gate"], regressions=worse), command_line)
    if settings["write_gate"]:
        tolerances = TOLERANCES | settings["tolerances"]
        if settings["rounded"]:
            rounded = read_estimates(Path(settings["rounded"]))
            tolerances = rounding_tolerances(tolerances, read_estimates(out), rounded, len(settings["seeds"]))
        write_gate(settings["write_gate"], rows, tolerances)
    problems = [f"{name}: {message}" for name, message in failures.items()]
    return problems + [f"regression: {line}" for line in worse]


def _run_all(jobs: Sequence[Job], failures: dict[str, str]) -> None:
    for number, job in enumerate(jobs):
        tqdm.write(f"{number + 1}/{len(jobs)} {job.name}")
        if number and job.dataset != jobs[number - 1].dataset:
            jax.clear_caches()  # executables of other shapes only use memory
        try:
            job.folder.mkdir(parents=True, exist_ok=True)
            # Written first, as a job may be killed or fill the disk; a job also includes what follows metrics.json.
            write_file(job.folder / ERROR_FILE, "the job has begun and not ended\n")
            run(job.config, job.folder)
            (job.folder / ERROR_FILE).unlink(missing_ok=True)
        except Exception as error:  # the other jobs go on
            failures[job.name] = message_of(error)
            tqdm.write(f"failed: {failures[job.name]}")
            with contextlib.suppress(OSError):
                write_file(job.folder / ERROR_FILE, "".join(traceback.format_exception(error)))


def _is_finished(job: Job) -> bool:
    """Test whether a job has its result and ended."""
    settings = OmegaConf.to_container(job.config, resolve=True)
    return not (job.folder / ERROR_FILE).exists() and is_finished(job.folder, settings)


def _shard(text: str) -> tuple[int, int]:
    part, _, whole = str(text).partition("/")
    if not (part.isdigit() and whole.isdigit() and 1 <= int(part) <= int(whole)):
        raise ValueError(f"shard must be n/m with n from 1 to m, such as 2/4, got {text!r}")
    return int(part), int(whole)


def _write_tables(out: Path, jobs: Sequence[Job], failures: Mapping[str, str]) -> tuple[list[Row], Found]:
    """Write results.csv, results.json and results.md of these jobs and of scored systems; return rows and page."""
    folders = {job.folder for job in jobs}
    estimates = [item for item in read_estimates(out) if item.kind == "scored" or item.folder in folders]
    totals, rows = average(estimates, each_sequence=False), average(estimates, each_sequence=True)
    done = {item.folder for item in estimates}
    missing = {job.name: failures.get(job.name, "to do") for job in jobs if job.folder not in done}
    quoted = published("reconstruction")
    shown = [*rows, *(row for row in totals if len(row.sequences) > 1)]
    unfinished = "".join(f"- not finished: {name}: {reason}\n" for name, reason in missing.items())
    text = "\n".join(filter(None, [paper_table(totals, quoted), full_table(shown) if rows else "", unfinished]))
    out.mkdir(parents=True, exist_ok=True)
    for name, content in (("results.csv", to_csv(estimates)), ("results.md", text)):
        write_file(out / name, content)
    write_json(out / "results.json", {"rows": rows, "totals": totals, "published": quoted, "missing": missing})
    print(text)
    lines = [JobLine(job.name, job.folder, missing.get(job.name, "")) for job in jobs]
    return rows, Found(lines, shown, estimates)


@command("evaluate", delegated)
def main(config: DictConfig) -> None:
    """Evaluate; the exit status is 1 if a job fails or a metric gets worse."""
    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    given = HydraConfig.get().overrides.task  # in which overrides=[…] is quoted twice
    words = [*(word for word in given if not word.startswith(("shard=", "overrides="))), *settings["overrides"]]
    problems = evaluate(settings, shlex.join(["emgs", "evaluate", *words]))
    if problems:
        raise ValueError("\n       ".join([f"problems: {len(problems)}", *problems]))


if __name__ == "__main__":
    main()
