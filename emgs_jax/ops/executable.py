"""Functions that are compiled separately, and the one place that decides how their executables are called."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Call = Callable[..., Any]  # of a function made by `eqx.filter_jit`, and its arguments

_call: ContextVar[Call] = ContextVar("_call", default=lambda jitted, *arguments: jitted(*arguments))


def executable(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a function: `eqx.filter_jit` for positional arguments, called through `calling`."""
    jitted = eqx.filter_jit(function)

    @wraps(function)
    def run(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        if named:
            raise TypeError(f"{jitted} takes its arguments by position, not {', '.join(named)}")
        return _call.get()(jitted, *arguments)

    return run


@contextmanager
def calling(call: Call) -> Generator[None]:
    """In this context and thread, replace `jitted(*arguments)` of every executable by `call(jitted, *arguments)`.

    With it the host lists what a step compiles, before the first one.
    """
    before = _call.set(call)
    try:
        yield
    finally:
        _call.reset(before)
