"""Shared by the commands: Hydra, the compilation cache, and errors as one clear line."""

import argparse
import contextlib
import logging
import os
import re
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emgs_jax.config.configure import CONF, check_added, compose, first_of_sweep, message_of
from emgs_jax.config.overrides import KEY, quoted, readable
from emgs_jax.config.values import check_keys
from emgs_jax.device.settings import check_platforms, leave_memory_to_torch, use_compilation_cache
from emgs_jax.io.files import check_writable, owned

from .console import Console, speak_on
from .interrupt import clear_interrupt
from .keys import KEYS

RUN = "config"  # conf/config.yaml
# Libraries that log missing accelerators and threads at INFO. A level of the logger "jax" before JAX is imported would
# become jaxlib's, which then logs an error for each cached executable.
TALKATIVE = ("jax._src", "numexpr", "websockets")
WRONG_INPUT = (ValueError, OSError, InstantiationException, OmegaConfBaseException)


def command(
    name: str, rewritten: Callable[[list[str]], list[str]] = list
) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make a program of a function of conf/`name`.yaml, composed with the command line after `rewritten`."""

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
        job = job_of(name, task)

        def main() -> None:
            speak_on()
            if {"-h", "--help"} & {*sys.argv[1:]}:
                print(help_of(name))
                return
            with clear_interrupt():
                with clear_errors():
                    sys.argv[1:] = readable(rewritten(readable(sys.argv[1:])))
                    check_arguments(name, sys.argv[1:])
                hydra.main(version_base="1.3", config_path=str(CONF.resolve()), config_name=name)(job)()

        main.__doc__ = task.__doc__
        return main

    return decorate


def job_of(name: str, task: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Make a job for Hydra and its launchers of a function of conf/`name`.yaml."""

    @wraps(task)
    def job(config: DictConfig) -> Any:
        if not HydraConfig.get().verbose:
            for library in TALKATIVE:
                logging.getLogger(library).setLevel(logging.WARNING)
        with kept_words(HydraConfig.get().job_logging), clear_errors(), nothing_left():
            check_missing(name, config)
            if name in KEYS:
                check_keys(config, KEYS[name])
            check_out(config)
            leave_memory_to_torch(config)
            check_platforms()
            leave_float32()
            if "compilation_cache" in config:
                use_compilation_cache(config.compilation_cache)
            return task(config)

    return job


def leave_float32() -> None:
    """Undo JAX_ENABLE_X64, and say so: maps are made in float32."""
    if os.environ.get("JAX_ENABLE_X64", "").lower() in ("1", "true", "yes", "on", "y", "t"):
        import jax  # noqa: PLC0415 (not all commands need it)

        jax.config.update("jax_enable_x64", False)
        print("JAX_ENABLE_X64 is set, and is of no effect here: maps are made in float32")


@contextlib.contextmanager
def kept_words(logging: DictConfig) -> Iterator[None]:
    """Copy a job's output, and how it failed, to Hydra's log file, if there is one."""
    path = log_of(logging)
    if path is None:
        yield
        return
    with open(path, "a", buffering=1, encoding="utf-8") as file:
        try:
            with contextlib.redirect_stdout(Console(sys.stdout, file)):
                yield
        except SystemExit as end:
            file.write(f"{end}\n")
            raise
        except BaseException:
            file.write(traceback.format_exc())
            raise


def log_of(logging: DictConfig) -> Path | None:
    """Hydra's log file, or None."""
    path = OmegaConf.select(logging, "handlers.file.filename")
    return None if path is None else Path(path)


def help_of(name: str) -> str:
    """The help in conf/`name`.yaml: its first comment, and its own choices and keys."""
    text = (CONF / f"{name}.yaml").read_text(encoding="utf-8")
    if name == RUN:  # has too many keys
        return OmegaConf.create(text).hydra.help.template
    head, text = re.sub(r"^hydra:\n(?:(?:  .*)?\n)*", "", text, flags=re.MULTILINE).split("defaults:\n")
    own = re.sub(r"^  - (?!\w+: ).*\n", "", text, flags=re.MULTILINE)  # without files and Hydra's settings
    choices = re.sub(r"^  - ", "", own, flags=re.MULTILINE)
    needed = "".join(f" {key}=…" for key in re.findall(r"^  - (\w+): \?\?\?", own, re.MULTILINE))
    more = f"emgs {name}{needed} --cfg job shows every key with its value."
    if f"  - {RUN}\n" in text:
        more += "\nEvery choice and key of a run is one here too: emgs run --help"
    return "\n\n".join([re.sub("^# ", "", head, flags=re.MULTILINE).strip(), choices.strip(), more])


def words_of(arguments: list[str]) -> argparse.Namespace:
    """Parse a command line as Hydra does: options, and in `overrides` all other words."""
    return get_args_parser().parse_intermixed_args(arguments)


def overrides_of(arguments: list[str]) -> list[str]:
    """The words KEY=VALUE."""
    return [word for word in words_of(arguments).overrides if "=" in word]


def first_words(key: str, is_list: bool = False) -> Callable[[list[str]], list[str]]:
    """Make a function that assigns a key the first word, or with `is_list` all up to the first override or option."""

    def rewrite(arguments: list[str]) -> list[str]:
        count = next((n for n, word in enumerate(arguments) if word.startswith("-") or KEY.match(word)), len(arguments))
        words = [quoted(word) for word in arguments[: count if is_list else min(count, 1)]]
        value = f"[{','.join(words)}]" if is_list else "".join(words)
        return [f"{key}={value}", *arguments[len(words) :]] if words else arguments

    return rewrite


def check_arguments(name: str, arguments: list[str]) -> None:
    """Raise ValueError, with near names, if an override names no key or option, or a word is no override."""
    given = words_of(arguments)
    folder = given.config_dir
    if folder is not None and not Path(folder).is_dir():
        raise ValueError(f"--config-dir {folder} is no folder: give one with options such as dataset/my.yaml")
    for word in given.overrides:
        if "=" not in word and not word.startswith("~"):
            raise ValueError(
                f"{word!r} is no KEY=VALUE: put a value with spaces into quotes ('KEY=VALUE'); "
                f"emgs {name_of(name)} --help lists the keys"
            )
    try:
        parsed = OverridesParser.create().parse_overrides([word for word in given.overrides if "=" in word])
    except HydraException as error:
        raise ValueError(f"{str(error).splitlines()[0]}: write each as KEY=VALUE, in quotes: 'KEY=VALUE'") from error
    # Of Hydra's own keys the search path has options of the user.
    own = [o for o in parsed if not o.key_or_group.startswith("hydra") or o.key_or_group == "hydra.searchpath"]
    for override in parsed:
        run = str(override.value())
        if override.key_or_group == "hydra.run.dir" and "$" not in run:  # Hydra would print a traceback
            check_writable(Path(run), f"hydra.run.dir={run}")
    overrides = [first_of_sweep(override) for override in own]
    if folder is not None and not any(o.key_or_group == "hydra.searchpath" for o in own):
        overrides.append(f"hydra.searchpath=[{quoted(f'file://{Path(folder).resolve()}')}]")
    compose(*overrides, name=name)
    check_added(overrides, name)


def name_of(name: str) -> str:
    """The command that conf/`name`.yaml belongs to."""
    return "run" if name == RUN else name


def check_missing(name: str, config: DictConfig) -> None:
    """Raise ValueError if a required key of conf/`name`.yaml is missing."""
    for line in (CONF / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if (found := re.match(r"(\w+): \?\?\?(?: # (.*))?", line)) and OmegaConf.is_missing(config, found[1]):
            what = f" ({found[2]})" if found[2] else ""
            raise ValueError(f"{found[1]} is not given{what}: emgs {name_of(name)} {found[1]}=…")


def check_out(config: DictConfig) -> None:
    """Raise ValueError if `out`, a folder or an .npz file, could not be written."""
    if isinstance(out := config.get("out"), str):
        is_file = Path(out).suffix == ".npz"
        check_writable(Path(out).parent if is_file else Path(out), f"out={out}")


@contextlib.contextmanager
def nothing_left() -> Iterator[None]:
    """Remove the folder that Hydra made if the command failed without a result.

    It stays if it held anything before, if another program uses it, or if Hydra keeps no log and so made none.
    """
    hydra = HydraConfig.get()
    folder, log = Path(hydra.runtime.output_dir), log_of(hydra.job_logging)

    def is_bare() -> bool:
        return log is not None and {path.name for path in folder.iterdir()} <= {log.name, ".hydra"}

    # After a multirun Hydra writes there.
    is_new = hydra.mode != RunMode.MULTIRUN and is_bare() and not log.stat().st_size
    try:
        yield
    except WRONG_INPUT:
        with contextlib.suppress(OSError, ValueError), owned(folder):
            if is_new and is_bare():
                shutil.rmtree(folder / ".hydra", ignore_errors=True)
                log.unlink()
                for place in (folder, *(parent for parent in folder.parents if Path.cwd() in parent.parents)):
                    if place != Path.cwd():
                        place.rmdir()  # ends at the first that has something else
        raise


@contextlib.contextmanager
def clear_errors() -> Iterator[None]:
    """End the program with the message of an error in the input; HYDRA_FULL_ERROR=1 shows the traceback.

    In a multirun Hydra reports the error after the other jobs, which an exit would end too.
    """
    try:
        yield
    except WRONG_INPUT as error:
        is_multirun = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
        if is_multirun or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        raise SystemExit(f"error: {message_of(error)}\n(HYDRA_FULL_ERROR=1 shows where it was raised)") from None
