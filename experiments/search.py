"""The search of `tune`: what a key may be, and a study of Optuna that asks for settings and is told what they came to.

Every trial is drawn with a seed of its own from the trials before it, and written in one piece: a search that goes on
asks what one asks that nobody stopped.
"""

import contextlib
import math
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import near
from emgs_jax.config.values import Declared, check_value, field_of
from emgs_jax.io.files import changes, jsonable
from emgs_jax.io.packages import extra

from .grid import Value, stage_keys

if TYPE_CHECKING:
    import optuna

DIRECTIONS = ("minimize", "maximize")
_EXAMPLE = "'space={slam.em.max_log_gap:{low:2,high:32,log:true}}'"
Space = Mapping[str, Any]  # key -> a distribution of Optuna


def ends_of(allowed: Any) -> tuple[Value, ...]:
    """Two values of a distribution that tell whether all of them share a program."""
    return allowed.choices[:2] if hasattr(allowed, "choices") else (allowed.low, allowed.high)


def read_space(config: DictConfig) -> Space:
    """The search space of a composed config.

    Raises:
        ValueError: there is none, a key is no key of a stage, or an end or value is not what its field declares; or
            Optuna is not installed.
    """
    space, known = OmegaConf.to_container(config)["space"], stage_keys(config)
    if not space:
        raise ValueError(f"there is nothing to search: choose a space with tune=gates, or {_EXAMPLE}")
    for key in space:
        if key not in known:
            raise ValueError(f"space: {key} is no key of a stage; {near(key, known)}")
    return {key: _read(key, given, field_of(config, key)) for key, given in space.items()}


def _read(key: str, given: Any, field: Declared) -> Any:
    distributions = _optuna().distributions
    if isinstance(given, list):
        if len(given) < 2 or not all(isinstance(value, Value) for value in given) or len(set(given)) < len(given):
            raise ValueError(f"space: {key} must have two or more different numbers or names, got {given!r}")
        for value in given:
            check_value(key, value, field)
        return distributions.CategoricalDistribution(given)
    if not isinstance(given, dict) or not {"low", "high"} <= set(given) <= {"low", "high", "log"}:
        raise ValueError(f"space: {key} must be a range {{low: …, high: …, log: true}} or a list, got {given!r}")
    if field.choices or not field.kinds & {int, float}:
        raise ValueError(f"space: {key} has names as values: write {key}: [{', '.join(field.choices or '…')}]")
    low, high, log = given["low"], given["high"], given.get("log", False)
    for end in (low, high):
        check_value(key, end, field)
        if not math.isfinite(end):
            raise ValueError(f"space: {key} cannot be drawn up to {end}: give a finite end, or a list with .inf in it")
    if not low < high or (log and low <= 0) or not isinstance(log, bool):
        raise ValueError(f"space: {key} needs low < high, and low above 0 with log: true; got {given!r}")
    if float not in field.kinds:
        return distributions.IntDistribution(low, high, log)
    return distributions.FloatDistribution(float(low), float(high), log)


def own_setting(config: DictConfig, space: Space) -> dict[str, Any]:
    """The config's own values of what is searched, as a trial would have them."""
    found = {key: OmegaConf.select(config, key) for key in space}
    numbers = {key for key, allowed in space.items() if isinstance(getattr(allowed, "low", None), float)}
    return {key: float(value) if key in numbers and value is not None else value for key, value in found.items()}


def read_objectives(config: DictConfig) -> dict[str, str]:
    """Metric -> `minimize` or `maximize`; raises ValueError where an objective says neither."""
    lines = OmegaConf.to_container(config)["objectives"]
    found = {}
    for line in lines if isinstance(lines, list) else []:
        direction, _, key = str(line).partition(" ")
        if direction not in DIRECTIONS or not key.strip() or key.strip() in found:
            raise ValueError(f"objectives: {line!r} must be minimize METRIC or maximize METRIC, each metric once")
        found[key.strip()] = direction
    if not found:
        raise ValueError("objectives must be a list such as [minimize trajectory/ate_sim3_m], got " + repr(lines))
    return found


def open_study(path: Path, about: Mapping[str, Any], objectives: Mapping[str, str]) -> "optuna.Study":
    """The study in a file, or a new one; one that was told nothing yet is begun anew.

    Args:
        path: JSON lines, of Optuna's journal.
        about: what is searched and on what; a study of anything else is not gone on with.
        objectives: metric -> direction.

    Raises:
        ValueError: Optuna is not installed, or the file holds another search.
    """
    optuna, about = _optuna(), jsonable(about)
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(path)))
    name, directions = "emgs", list(objectives.values())
    study = optuna.create_study(storage=storage, study_name=name, directions=directions, load_if_exists=True)
    known = study.user_attrs.get("about", {})
    if known != about and told(study):
        raise ValueError(
            f"{path} holds another search ({changes(known, about)[0]}): go on with the same words, or search in "
            "another folder (hydra.run.dir=…)"
        )
    if known != about:
        optuna.delete_study(study_name=name, storage=storage)
        study = optuna.create_study(storage=storage, study_name=name, directions=directions)
        study.set_user_attr("about", about)
    return study


def _optuna() -> ModuleType:
    optuna = extra("optuna", "the search needs Optuna", "tune")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def told(study: "optuna.Study") -> list["optuna.trial.FrozenTrial"]:
    """Trials that are finished, in their order."""
    return [trial for trial in study.trials if trial.state.is_finished()]


def ask(
    study: "optuna.Study", space: Space, own: Mapping[str, Any], end: int, seed: int, startup: int
) -> list["optuna.trial.FrozenTrial"]:
    """Trials that are to be measured next: new ones until there are `end`, and those that were asked for before.

    Args:
        own: the config's values; the first trial, where they are in the space.
        startup: trials before the search learns.
    """
    optuna = _optuna()
    new = partial(optuna.trial.create_trial, state=(running := optuna.trial.TrialState.RUNNING))
    if not study.trials:
        with contextlib.suppress(ValueError):  # they are not in the space
            study.add_trial(new(params=dict(own), distributions=dict(space)))
    while (number := len(study.trials)) < end:
        params = _drawn(optuna, study, space, [seed, number], startup)
        study.add_trial(new(params=params, distributions=dict(space)))
    return list(study.get_trials(states=(running,)))


def _drawn(
    optuna: ModuleType, study: "optuna.Study", space: Space, seeds: Sequence[int], startup: int
) -> dict[str, Any]:
    """Values of a new trial; drawn in a copy, because asking the file would write them one by one."""
    seed = int(np.random.SeedSequence(seeds).generate_state(1)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # of multivariate and constant_liar
        sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=startup, multivariate=True, constant_liar=True)
    copy = optuna.create_study(directions=study.directions, sampler=sampler)
    copy.add_trials(study.trials)
    return copy.ask(dict(space)).params


def front(study: "optuna.Study", count: int) -> list["optuna.trial.FrozenTrial"]:
    """At most `count` trials of which no other is better in everything, from the best in the first objective on.

    Of more than that, those are taken that are evenly spread over the order. Of equal settings the first one counts.
    """
    sign = 1 if study.directions[0].name == "MINIMIZE" else -1
    ordered = sorted(study.best_trials, key=lambda trial: (sign * trial.values[0], trial.number))
    found = list({repr(sorted(trial.params.items())): trial for trial in reversed(ordered)}.values())[::-1]
    rows = sorted({round(row) for row in np.linspace(0, len(found) - 1, min(count, len(found)))})
    return [found[row] for row in rows]
