"""Check the values of a config against the declarations of fields or parameters.

The type is the annotation; a field declares its range or choices (`ops.ranges`, `traced`, `static`, `choice`).
"""

import dataclasses
import inspect
import math
import numbers
import re
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hydra.utils import get_class
from omegaconf import MISSING, DictConfig, OmegaConf

from emgs_jax.ops.ranges import Range

_NAMES = {bool: "true or false", str: "text", types.NoneType: "null"}


class Declared(NamedTuple):
    """What a field allows: its annotation, range and choices."""

    hint: Any
    range: Range | None = None
    choices: tuple[str, ...] = ()

    @property
    def kinds(self) -> set[type]:
        """Plain types that a value may have; none if any value may."""
        return {part for part in _parts(self.hint) if part in (int, float, *_NAMES)}


def check_keys(config: DictConfig, cls: type) -> None:
    """Raise ValueError if a value of a config is not what a class declares."""
    for key, field in declared(cls).items():
        if not OmegaConf.is_missing(config, key):
            check_value(key, config[key], field)


def check_values(config: DictConfig, key: str) -> None:
    """Raise ValueError, with the full key, if a value at or below a node is not what its `_target_` declares."""
    node = OmegaConf.select(config, key)
    if not isinstance(node, DictConfig):
        return
    fields = declared(get_class(node["_target_"])) if "_target_" in node else {}
    for name in node:
        own = f"{key}.{name}"
        if found := re.fullmatch(r"\$\{(\w[\w.]*)\}", str(OmegaConf.to_container(node, resolve=False)[name])):
            own = found[1]  # the key that is referred to
        value = MISSING if OmegaConf.is_missing(node, name) else node[name]
        if isinstance(value, DictConfig) and (name not in fields or not _is_plain(fields[name])):
            check_values(config, own)
        elif name in fields and value != MISSING:
            check_value(own, value, fields[name])


def check_value(key: str, value: Any, field: Declared) -> None:
    """Raise ValueError if the value of `key` is not what its field declares."""
    value = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    shown = "null" if value is None else repr(value)
    if isinstance(value, str) and value.lstrip("+-").lower() == ".inf":
        shown += ", which is text (on the command line infinity is written inf)"
    if field.choices:
        if value not in field.choices:
            raise ValueError(f"{key} must be one of {', '.join(field.choices)}; got {shown}")
    elif dataclasses.is_dataclass(field.hint):
        raise ValueError(f"{key}={shown} would replace all of its keys: give {key}.KEY=VALUE")
    elif not _fits(value, field.hint, field.range):
        raise ValueError(
            f"{key} must be {' or '.join(_words(field))}, got {shown}: give such a value, or leave the key out"
        )


def declared(cls: type) -> dict[str, Declared]:
    """The declarations of a dataclass's fields, or of another class's parameters."""
    if not dataclasses.is_dataclass(cls):
        return {name: Declared(found.annotation) for name, found in inspect.signature(cls).parameters.items()}
    return {field.name: _of_field(field) for field in dataclasses.fields(cls)}


def field_of(config: DictConfig, key: str) -> Declared:
    """The declaration of the field at a dotted key of a composed config."""
    parent, _, name = key.rpartition(".")
    return declared(get_class(OmegaConf.select(config, parent)["_target_"]))[name]


def _of_field(field: dataclasses.Field) -> Declared:
    found = Declared(field.type, field.metadata.get("range"), tuple(field.metadata.get("choices", ())))
    is_array = found.range is not None and not found.kinds and not _is_list(field.type)
    return found._replace(hint=float) if is_array else found  # a traced field is annotated as an array


def _fits(value: Any, hint: Any, ends: Range | None) -> bool:
    """Test whether a value has a hint's type and is in the range; any value fits a hint beyond YAML."""
    parts = _parts(hint)
    if len(parts) > 1:
        return any(_fits(value, part, ends) for part in parts)
    if hint in _NAMES:
        return type(value) is hint
    if hint in (int, float):
        kind = numbers.Integral if hint is int else numbers.Real
        if not isinstance(value, kind) or isinstance(value, bool):
            return False
        return math.isfinite(value) if ends is None else ends.low <= value <= ends.high  # nan is in no range
    if _is_list(hint):
        items = [part for part in typing.get_args(hint) if part is not ...]
        is_open = typing.get_origin(hint) is not tuple or ... in typing.get_args(hint)
        if value is None:
            return items == [str]  # names of classes, filled in later
        if not isinstance(value, list | tuple) or not (is_open or len(value) == len(items)):
            return False
        return all(_fits(item, items[0] if is_open else items[n], ends) for n, item in enumerate(value))
    return callable(value) if typing.get_origin(hint) is Callable else True


def _words(field: Declared) -> list[str]:
    """Describe each type that would be right."""
    low, high = ("", "") if field.range is None else map(_end, field.range)
    ends = f" from {low} to {high}" if low else ""
    kinds = field.kinds
    found = [f"{'a number' if float in kinds else 'a whole number'}{ends}"] if kinds & {int, float} else []
    for part in filter(_is_list, _parts(field.hint)):
        items = {kind for item in typing.get_args(part) for kind in _parts(item)}
        is_open = typing.get_origin(part) is not tuple or ... in typing.get_args(part)
        count = "" if is_open else f"{len(typing.get_args(part))} "
        what = "numbers or text" if {str, float} <= items else "text" if str in items else "numbers"
        found.append(f"a list […, …] of {count}{'whole numbers' if items == {int} else what}{ends}")
    return found + [words for kind, words in _NAMES.items() if kind in kinds]


def _end(value: float) -> str:
    return f"{value:.0f}" if abs(value) < 1e12 and value == round(value) else f"{value:g}"


def _is_plain(field: Declared) -> bool:
    return bool(field.kinds or field.choices) or any(map(_is_list, _parts(field.hint)))


def _is_list(hint: Any) -> bool:
    return typing.get_origin(hint) in (tuple, list, Sequence)


def _parts(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union, or the hint itself."""
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
