"""pycolmap, which is loaded when it is needed, and its options and names as a config writes them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any


def load() -> ModuleType:
    """The module; ValueError where it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(
            "poses of images are found by pycolmap, which is not installed (for Linux on ARM there is no wheel): "
            "install it from source, or bring predictions with poses (prior=files)"
        ) from error
    return pycolmap


@contextmanager
def quiet() -> Iterator[None]:
    """COLMAP logs nothing but what ends it."""
    logging = load().logging
    before = logging.minloglevel
    logging.minloglevel = logging.Level.FATAL.value
    try:
        yield
    finally:
        logging.minloglevel = before


def options_of(name: str, *given: Mapping[str, Any]) -> Any:
    """An options object of pycolmap with values put into it; the last ones win.

    Raises:
        ValueError: COLMAP knows no such option, or not this value; the message names those that there are.
    """
    options = getattr(load(), name)()
    for values in given:
        try:
            options.mergedict(_plain(values))
        except (AttributeError, TypeError, ValueError, RuntimeError) as error:
            known = ", ".join(sorted(options.todict()))
            raise ValueError(
                f"prior.structure.options: {name} of pycolmap does not take {dict(values)} "
                f"({str(error).splitlines()[0]}): its options are {known}"
            ) from error
    return options


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _plain(value) if isinstance(value, Mapping) else value for key, value in values.items()}


def member(kinds: str, name: str, key: str) -> Any:
    """The value of one of pycolmap's enumerations by its name in any case; `key` names it in errors."""
    members = {name.lower(): value for name, value in getattr(load(), kinds).__members__.items() if name != "UNDEFINED"}
    if name.lower() not in members:
        raise ValueError(f"prior.structure.{key}={name} is unknown: pycolmap has {', '.join(members)}")
    return members[name.lower()]
