"""Search for better settings: `python -m experiments.tune tune=gates 'held_out={fresh:{prior.seed:3}}'`.

Trials are asked for in batches, mapped and scored together as in a sweep, and told to Optuna, so that all of them share
one compilation. Only the tuned sequences decide; the best settings are then mapped on those that are held out. The same
command with `hydra.run.dir=` its folder goes on where it was stopped, with the trials that it would have had.
"""

import re
import shlex
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from emgs_jax.config.configure import build_dataset, compose, near
from emgs_jax.config.overrides import written
from emgs_jax.device.clock import Clock
from emgs_jax.io.files import owned, remove_temporaries, write_file
from emgs_jax.mapping.batch import programs
from emgs_jax.report.columns import csv_text
from emgs_jax.report.tuning import DEFAULT, SequenceResults, draw_trials, settings_yaml, table, verdict

from .command import command
from .grid import variant_of
from .search import Space, ask, ends_of, front, open_study, own_setting, read_objectives, read_space, told
from .together import Measured, refuse_other_maps, resumed

Setting = Mapping[str, Any]


def tune(words: Sequence[str], folder: Path) -> list[dict[str, Any]]:
    """Search, and write what was found into `folder`.

    Args:
        folder: of the results; one that holds a part of the same search is continued.

    Returns:
        A flat row for each trial: its number, its values and the means of its objectives over the tuned sequences.

    Raises:
        ValueError: what is searched cannot be, or `folder` holds another search.
    """
    config = compose(*words, name="tune")
    refuse_other_maps(config, "a search")
    space, objectives = read_space(config), read_objectives(config)
    configs = {kind: _sequences(words, config, kind, space) for kind in ("tuned", "held_out")}
    _check_apart(configs["tuned"], configs["held_out"])
    own = own_setting(config, space)
    for key, allowed in space.items():
        if len(programs([variant_of(config, {key: value}).slam for value in ends_of(allowed)])) > 1:
            print(f"{key} shares no program: what has another value of it is compiled or mapped by itself")
    searched = {key: vars(allowed) for key, allowed in space.items()}
    about = {"space": searched, "objectives": objectives, "tuned": list(configs["tuned"]), "seed": config.search_seed}
    with owned(folder), Clock().watching() as clock:
        remove_temporaries(folder)
        study = open_study(folder / "study.jsonl", about, objectives)
        sequences = {
            kind: [Measured(one, folder / kind / name, clock, name, is_asked_again=True) for name, one in some.items()]
            for kind, some in configs.items()
        }
        _search(study, config, space, objectives, own, sequences["tuned"])
        best = front(study, config.best)
        for sequence in sequences["held_out"]:
            _measure(sequence, [own, *(trial.params for trial in best)])
    for sequence in (*sequences["tuned"], *sequences["held_out"]):
        sequence.forget_predictions()
    rows = [_row(trial, sequences["tuned"], objectives) for trial in told(study)]
    _write(folder, rows, sequences, {trial.number: trial.params for trial in best}, own, objectives)
    print(f"{len(rows)} trials in {clock.total_seconds:.1f} s, {clock.compile_seconds:.1f} s of it compilation")
    return rows


def _sequences(words: Sequence[str], config: DictConfig, kind: str, space: Space) -> dict[str, DictConfig]:
    """The configs of the sequences of a kind by name."""
    given = OmegaConf.to_container(config, resolve=False)[kind] or ({"own": {}} if kind == "tuned" else {})
    if not given:
        raise ValueError(
            "held_out names no sequence, so nothing would tell whether the best settings are better elsewhere: "
            "'held_out={fresh:{prior.seed:3}}'"
        )
    found = {}
    for name, changes in given.items():
        if not re.fullmatch(r"\w[\w.-]*", str(name)) or not isinstance(changes, dict):
            raise ValueError(
                f"{kind} must be plain names with overrides, {{NAME:{{KEY:VALUE}}}}, got {name}: {changes}"
            )
        searched = sorted(set(changes) & set(space))
        if searched:
            raise ValueError(f"{kind}.{name} gives {searched[0]} a value, but it is searched: leave it out of either")
        overrides = (f"{key}={written(value)}" for key, value in changes.items())
        found[str(name)] = compose(*words, *overrides, name="tune") if changes else config
    return found


def _check_apart(tuned: Mapping[str, DictConfig], held_out: Mapping[str, DictConfig]) -> None:
    """Raise ValueError where the frames, and the keys of the prior, are those of a tuned sequence."""
    decide = {name: _source(config) for name, config in tuned.items()}
    for name, config in held_out.items():
        source = _source(config)
        same = [other for other, one in decide.items() if one == source]
        if same:
            raise ValueError(f"held_out.{name} is the tuned sequence {same[0]}: hold out another sequence or seed")


def _source(config: DictConfig) -> tuple[Any, Any]:
    """Return the identity of a sequence's input: the data set's fingerprint and the prior's settings."""
    return build_dataset(config).fingerprint(), OmegaConf.to_container(config.prior, resolve=True)


def _search(
    study: Any,
    config: DictConfig,
    space: Space,
    objectives: Mapping[str, str],
    own: Setting,
    sequences: Sequence[Measured],
) -> None:
    """Ask, measure and tell, batch by batch, until there are all trials."""
    while (done := len(told(study))) < config.trials:
        end = min((done // config.chunk + 1) * config.chunk, config.trials)
        batch = ask(study, space, own, end, config.search_seed, config.startup)
        if done:
            tqdm.write(f"{done} of {config.trials} trials are done")
        for sequence in sequences:
            _measure(sequence, [own, *(trial.params for trial in batch)])
        _check_metrics(objectives, sequences, own)
        for trial in batch:
            row = _row(trial, sequences, objectives)
            values = [row[key] for key in objectives]
            if None in values:
                study.tell(trial.number, state=type(trial.state).FAIL)
            else:
                study.tell(trial.number, values)


def _measure(sequence: Measured, settings: Sequence[Setting]) -> None:
    """Map and score those of the settings that are not there yet, all of them together."""
    new = {repr(setting): setting for setting in settings if setting not in sequence}
    sequence.measure([variant_of(sequence.config, setting) for setting in new.values()])


def _check_metrics(objectives: Mapping[str, str], sequences: Sequence[Measured], own: Setting) -> None:
    """Raise ValueError where an objective is no number of the default on some sequence."""
    for sequence in sequences:
        (metrics,) = sequence.rows([own])
        numbers = {key for key, value in metrics.items() if isinstance(value, int | float)}
        for key in objectives:
            if key not in numbers:
                what = "has no value with the default" if key in metrics else f"is no metric; {_near(key, numbers)}"
                raise ValueError(f"objectives: {key} of {sequence.name} {what}")


def _near(key: str, known: set[str]) -> str:
    return near(key.replace("/", "."), sorted(name.replace("/", ".") for name in known)).replace(".", "/")


def _row(trial: Any, sequences: Sequence[Measured], objectives: Mapping[str, str]) -> dict[str, Any]:
    """Number, values and objectives of a trial: means over the sequences, None where one has no value."""
    found = [sequence.rows([trial.params])[0] for sequence in sequences]
    values = {key: [metrics.get(key) for metrics in found] for key in objectives}
    means = {key: None if None in numbers else statistics.fmean(numbers) for key, numbers in values.items()}
    return {"trial": trial.number} | trial.params | means


def _write(
    folder: Path,
    rows: Sequence[Mapping[str, Any]],
    sequences: Mapping[str, Sequence[Measured]],
    best: Mapping[int, Setting],
    own: Setting,
    objectives: Mapping[str, str],
) -> None:
    """Write trials.csv, tune.md, tune.png and a file for each of the best; print the table."""
    named = {DEFAULT: own} | {f"trial {number}": setting for number, setting in best.items()}
    results = [
        SequenceResults(
            sequence.name,
            sequence.dataset.name,
            kind == "held_out",
            sequence.prior.provenance.is_simulated,
            dict(zip(named, sequence.rows(list(named.values())), strict=True)),
        )
        for kind, some in sequences.items()
        for sequence in some
    ]
    lines = verdict(results, objectives)
    text = "\n".join([table(results, objectives), *(f"- {line}" for line in lines.values()), ""])
    trials = [{**row, "is_best": row["trial"] in best} for row in rows]
    write_file(folder / "trials.csv", csv_text(trials))
    write_file(folder / "tune.md", text)
    _write_best(folder, best, lines)
    numbers = {row["trial"]: DEFAULT for row in rows if all(row[key] == own[key] for key in own)}
    marks = numbers | {number: f"trial {number}" for number in best}
    title, data = "means over the tuned sequences", {sequence.dataset.name for sequence in sequences["tuned"]}
    no_picture = draw_trials(folder / "tune.png", rows, objectives, marks, title, data)
    if no_picture:
        print(f"no tune.png: {no_picture}")
    print(text)


def _write_best(folder: Path, best: Mapping[int, Setting], lines: Mapping[str, str]) -> None:
    """An option of Hydra for each of the best; those of a shorter search go."""
    (folder / "best").mkdir(exist_ok=True)
    for path in (folder / "best").glob("trial_*.yaml"):
        path.unlink()
    place = f"file://{folder.resolve()}"
    place = place if re.fullmatch(r"[\w./:-]+", place) else written(place)
    for number, setting in best.items():
        path = folder / "best" / f"trial_{number}.yaml"
        command_line = shlex.join(["emgs", "run", f"hydra.searchpath=[{place}]", f"+best={path.stem}"])
        write_file(path, settings_yaml(setting, [f"{command_line} …", lines[f"trial {number}"]]))


@command("tune")
def main(config: DictConfig) -> None:
    """Search, and say where the results are."""
    with resumed() as folder:
        tune(list(HydraConfig.get().overrides.task), folder)
    print(f"everything is in {folder}")


if __name__ == "__main__":
    main()
