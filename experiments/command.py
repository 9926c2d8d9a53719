"""Shared parts of the commands: Hydra, the compilation cache, and an error that is one clear line."""

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

from emgs_jax.config.configure import CONF, compose, first_of_sweep, message_of
from emgs_jax.config.overrides import KEY, quoted, readable
from emgs_jax.config.values import check_keys
from emgs_jax.device.settings import check_platforms, leave_memory_to_torch, use_compilation_cache
from emgs_jax.io.files import check_writable, owned

from .console import Console, speak_on
from .interrupt import clear_interrupt
from .keys import KEYS

RUN = "config"  # conf/config.yaml, whose help lists every choice, by Hydra
# Libraries that log at INFO which accelerators and threads are not there. A level of the logger "jax" that is set
# before JAX is imported becomes the level of jaxlib, too, which then logs an error for each executable from the cache.
TALKATIVE = ("jax._src", "numexpr", "websockets")
WRONG_INPUT = (ValueError, OSError, InstantiationException, OmegaConfBaseException)


def command(
    name: str, rewritten: Callable[[list[str]], list[str]] = list
) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make a program of a function of conf/`name`.yaml with the command line's overrides, `rewritten` if need be."""

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
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


def leave_float32() -> None:
    """Turn off what JAX_ENABLE_X64 turns on, and say so: maps are made in float32."""
    if os.environ.get("JAX_ENABLE_X64", "").lower() in ("1", "true", "yes", "on", "y", "t"):
        import jax  # noqa: PLC0415 (not all commands need it)

        jax.config.update("jax_enable_x64", False)
        print("JAX_ENABLE_X64 is set, and is of no effect here: maps are made in float32")


@contextlib.contextmanager
def kept_words(logging: DictConfig) -> Iterator[None]:
    """Keep what a job says, how it failed included, in the file that Hydra has for its log; without one nowhere."""
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
    """The file of Hydra's log; None where it keeps none."""
    path = OmegaConf.select(logging, "handlers.file.filename")
    return None if path is None else Path(path)


def help_of(name: str) -> str:
    """Return the help in conf/`name`.yaml: its first comment, and its own choices and keys as they stand there."""
    text = (CONF / f"{name}.yaml").read_text(encoding="utf-8")
    if name == RUN:  # which says what matters of its many keys
        return OmegaConf.create(text).hydra.help.template
    head, text = re.sub(r"^hydra:\n(?:(?:  .*)?\n)*", "", text, flags=re.MULTILINE).split("defaults:\n")
    own = re.sub(r"^  - (?!\w+: ).*\n", "", text, flags=re.MULTILINE)  # neither files nor what Hydra is told
    choices = re.sub(r"^  - ", "", own, flags=re.MULTILINE)
    needed = "".join(f" {key}=…" for key in re.findall(r"^  - (\w+): \?\?\?", own, re.MULTILINE))
    more = f"emgs {name}{needed} --cfg job shows every key with its value."
    if f"  - {RUN}\n" in text:
        more += "\nEvery choice and key of a run is one here too: emgs run --help"
    return "\n\n".join([re.sub("^# ", "", head, flags=re.MULTILINE).strip(), choices.strip(), more])


def words_of(arguments: list[str]) -> argparse.Namespace:
    """A command line as Hydra takes it apart: its options, and in `overrides` all other words."""
    return get_args_parser().parse_intermixed_args(arguments)


def overrides_of(arguments: list[str]) -> list[str]:
    """The words KEY=VALUE."""
    return [word for word in words_of(arguments).overrides if "=" in word]


def first_words(key: str, is_list: bool = False) -> Callable[[list[str]], list[str]]:
    """Return what makes a key of the first word, or with `is_list` of all up to the first override or option."""

    def rewrite(arguments: list[str]) -> list[str]:
        count = next((n for n, word in enumerate(arguments) if word.startswith("-") or KEY.match(word)), len(arguments))
        words = [quoted(word) for word in arguments[: count if is_list else min(count, 1)]]
        value = f"[{','.join(words)}]" if is_list else "".join(words)
        return [f"{key}={value}", *arguments[len(words) :]] if words else arguments

    return rewrite


def check_arguments(name: str, arguments: list[str]) -> None:
    """Raise ValueError with near names where an override names no key or option, and where a word is no override."""
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
    # Of Hydra's own keys one has options of the user in it.
    own = [o for o in parsed if not o.key_or_group.startswith("hydra") or o.key_or_group == "hydra.searchpath"]
    for override in parsed:
        run = str(override.value())
        if override.key_or_group == "hydra.run.dir" and "$" not in run:  # Hydra tells it by a traceback
            check_writable(Path(run), f"hydra.run.dir={run}")
    overrides = [first_of_sweep(override) for override in own]
    if folder is not None and not any(o.key_or_group == "hydra.searchpath" for o in own):
        overrides.append(f"hydra.searchpath=[{quoted(f'file://{Path(folder).resolve()}')}]")
    compose(*overrides, name=name)


def name_of(name: str) -> str:
    """The command of conf/`name`.yaml."""
    return "run" if name == RUN else name


def check_missing(name: str, config: DictConfig) -> None:
    """Raise ValueError where one of conf/`name`.yaml's own keys has to be given and is not."""
    lines = (CONF / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    for line in lines:
        if (found := re.match(r"(\w+): \?\?\?(?: # (.*))?", line)) and OmegaConf.is_missing(config, found[1]):
            what = f" ({found[2]})" if found[2] else ""
            raise ValueError(f"{found[1]} is not given{what}: emgs {name_of(name)} {found[1]}=…")


def check_out(config: DictConfig) -> None:
    """Raise ValueError where what `out` names could not be written in the end; it may be a file."""
    if isinstance(out := config.get("out"), str):
        is_file = Path(out).suffix == ".npz"
        check_writable(Path(out).parent if is_file else Path(out), f"out={out}")


@contextlib.contextmanager
def nothing_left() -> Iterator[None]:
    """Remove the folder that Hydra made where nothing came of the command: it has no result.

    Where it held anything before, another program is in it, or Hydra keeps no log and so made none, all of it stays.
    """
    hydra = HydraConfig.get()
    folder, log = Path(hydra.runtime.output_dir), log_of(hydra.job_logging)

    def is_bare() -> bool:
        return log is not None and {path.name for path in folder.iterdir()} <= {log.name, ".hydra"}

    # In a multirun Hydra writes there at the end.
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
    """End the program with the message of what is wrong with the input; HYDRA_FULL_ERROR=1 shows the traceback.

    In a multirun the error goes on to Hydra, which reports it after the other jobs; an exit would end them too.
    """
    try:
        yield
    except WRONG_INPUT as error:
        is_multirun = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
        if is_multirun or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        raise SystemExit(f"error: {message_of(error)}\n(HYDRA_FULL_ERROR=1 shows where it was raised)") from None
