"""The values of a config before anything is made of them: each is of the kind and in the range that its field declares.

A field declares its range where it stands (`ops.ranges`, `traced`, `static`, `choice`); what kind it is its annotation
says, as for the parameters of a class that is no dataclass.
"""

import dataclasses
import inspect
import math
import numbers
import re
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any

from hydra.utils import get_class
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf

from emgs_jax.ops.ranges import Range

_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


@dataclasses.dataclass(frozen=True)
class Declared:
    """Values that a field allows: plain kinds, the kinds of a list's elements, the range, the names.

    A field with `is_node` has fields of its own. A list has `length` elements, any number where it is 0.
    """

    kinds: frozenset[type]
    elements: frozenset[type] = frozenset()
    range: Range | None = None
    choices: tuple[str, ...] = ()
    is_node: bool = False
    length: int = 0


def check_values(config: DictConfig, key: str) -> None:
    """Raise ValueError with the full key where a value at or below a node with `_target_` is not what is declared."""
    node = OmegaConf.select(config, key)
    if not isinstance(node, DictConfig):
        return
    fields = declared(get_class(node["_target_"])) if "_target_" in node else {}
    for name in node:
        own = _origin(config, f"{key}.{name}")
        value = OmegaConf.select(config, own, default=MISSING)  # also where a value has yet to be given
        is_plain = name in fields and bool(fields[name].kinds or fields[name].elements or fields[name].choices)
        if isinstance(value, DictConfig) and not is_plain:
            check_values(config, own)
        elif name in fields and value != MISSING:
            check_value(own, value, fields[name])


def _origin(config: DictConfig, key: str) -> str:
    """The key where a value stands that is only referred to, which is the one to change."""
    while True:
        parent, _, name = key.rpartition(".")
        node = OmegaConf.select(config, parent) if parent else config
        if not OmegaConf.is_interpolation(node, name):
            return key
        found = re.fullmatch(r"\$\{(\w[\w.]*)\}", str(OmegaConf.to_container(node, resolve=False)[name]))
        if found is None:
            return key
        key = found[1]


def check_value(key: str, value: Any, field: Declared) -> None:
    """Raise ValueError where the value of `key` is not what its field declares."""
    if field.is_node:
        raise ValueError(f"{key}={_shown(value)} would stand in the place of all its keys: give {key}.KEY=VALUE")
    if field.choices:
        if value not in field.choices:
            raise ValueError(f"{key} must be one of {', '.join(field.choices)}; got {_shown(value)}")
        return
    if not field.kinds and not field.elements:
        return
    is_list = isinstance(value, ListConfig | list | tuple) and bool(field.elements)
    items, kinds = (value, field.elements) if is_list else ([value], field.kinds)
    has_length = not (is_list and field.length) or len(value) == field.length
    if not (has_length and all(_fits(item, kinds, field.range) for item in items)):
        raise ValueError(
            f"{key} must be {_expected(field)}, got {_shown(value)}{_advice(value)}: "
            "give such a value, or none for the one of conf/"
        )


def _fits(value: Any, kinds: frozenset[type], ends: Range | None) -> bool:
    if value is None or isinstance(value, bool | str):
        return type(value) in kinds
    if not isinstance(value, numbers.Real) or not kinds & {int, float}:
        return False
    if float not in kinds and not isinstance(value, numbers.Integral):
        return False
    return math.isfinite(value) if ends is None else ends.low <= value <= ends.high  # nan is in no range


def _expected(field: Declared) -> str:
    """Words for what would be right."""
    ends = "" if field.range is None else f" from {_end(field.range.low)} to {_end(field.range.high)}"
    kinds = field.kinds - {int} if float in field.kinds else field.kinds
    words = [name + ends * (kind in (int, float)) for kind, name in _NAMES.items() if kind in kinds]
    if field.elements:
        what = "numbers or text" if str in field.elements else "numbers" if float in field.elements else "whole numbers"
        count = f"{field.length} " if field.length else ""
        words.append(f"a list […, …] of {count}{what}{ends}")
    return " or ".join(words + ["null"] * (type(None) in kinds))


def _end(value: float) -> str:
    return f"{value:.0f}" if abs(value) < 1e12 and value == round(value) else f"{value:g}"


def _shown(value: Any) -> str:
    if isinstance(value, ListConfig):
        value = OmegaConf.to_container(value)
    return "null" if value is None else repr(value)


def _advice(value: Any) -> str:
    """Infinity is .inf in YAML and inf on the command line, where .inf is text."""
    is_spelled = isinstance(value, str) and value.lower().lstrip("+-") == ".inf"
    return ", which is text (on the command line infinity is written inf)" if is_spelled else ""


def field_of(config: DictConfig, key: str) -> Declared:
    """Return the declaration of the field at a dotted key of a composed config; its parent has a `_target_`."""
    parent, _, name = key.rpartition(".")
    return declared(get_class(OmegaConf.select(config, parent)["_target_"]))[name]


def declared(cls: type) -> dict[str, Declared]:
    """Return the declarations of the fields of a dataclass, or of the parameters of another class, by name."""
    if not dataclasses.is_dataclass(cls):
        parameters = inspect.signature(cls).parameters
        return {name: _of_hint(parameter.annotation) for name, parameter in parameters.items()}
    return {field.name: _of_field(field) for field in dataclasses.fields(cls)}


def _of_field(field: dataclasses.Field) -> Declared:
    about = field.metadata
    if "choices" in about:
        return Declared(frozenset({str}), choices=about["choices"])
    found = dataclasses.replace(_of_hint(field.type), range=about.get("range"))
    if "range" in about and not (found.kinds or found.elements):  # a traced one is annotated as the array it becomes
        return dataclasses.replace(found, kinds=frozenset({float}))
    return dataclasses.replace(found, is_node=found.range is None and dataclasses.is_dataclass(field.type))


def _of_hint(hint: Any) -> Declared:
    """Plain kinds that a hint allows, and those of a list's elements; none where it allows anything else."""
    plain, elements, lengths = set(), set(), set()
    for part in _parts(hint):
        origin, arguments = typing.get_origin(part), typing.get_args(part)
        if part in _NAMES or part is type(None):
            plain.add(part)
        elif origin in (tuple, list, Sequence) and arguments:
            found = {kind for argument in arguments if argument is not ... for kind in _parts(argument)}
            if not found <= {int, float, str} or found == {str}:
                return Declared(frozenset())
            elements |= found
            lengths.add(len(arguments) if origin is tuple and ... not in arguments else 0)
        elif origin is not Callable:  # a function stands in no config
            return Declared(frozenset())
    return Declared(frozenset(plain), frozenset(elements), length=lengths.pop() if len(lengths) == 1 else 0)


def _parts(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union; of any other hint itself."""
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
