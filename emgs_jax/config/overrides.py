"""Quote words of the command line for Hydra's grammar: what it cannot parse is text."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

KEY = re.compile(r"(?:\+{1,2}|~)?[A-Za-z_][\w./@:-]*=")
# Keys whose values are names, even if they look like numbers: as the last part of a key, and as the whole key.
NAMES, WHOLE_NAMES = ("root", "sequence", "folder", "model", "trajectory"), ("map", "out")
HOME = re.compile(r"(^|[,\[] ?)~(?=/)")  # zsh does not expand it, others not in quotes
PLAIN = re.compile(r"[A-Za-z_][\w./-]*|/[\w./-]*")  # text that needs no quotes, except for WORDS
WORDS = {"null", "none", "true", "false", "nan", "inf", "on", "off", "yes", "no"}


def readable(arguments: Sequence[str]) -> list[str]:
    """Quote every value that Hydra would misread: names of existing files or folders, and text beyond its grammar.

    A number stays one, unless its key takes a name (folders may be numbered). `~/` is expanded.
    """
    return [_readable(word) if KEY.match(word) else word for word in arguments]


def parsed(word: str) -> Override | None:
    """Parse a word as Hydra does; None if it is no override."""
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None


def _readable(word: str) -> str:
    word = re.sub(r"^masks=", "masks.folder=", word)
    key = KEY.match(word)[0]
    value = HOME.sub(lambda found: f"{found[1]}{Path.home()}", word[len(key) :])
    word = key + value
    found = parsed(word)
    if found is None:
        whole = f"{key}{_quoted_items(value)}" if value[:1] + value[-1:] == "[]" and not _is_there(value) else ""
        return whole if whole and parsed(whole) is not None else f"{key}{quoted(value)}"
    is_name = key[:-1].rpartition(".")[2] in NAMES or key[:-1] in WHOLE_NAMES
    is_number = isinstance(found.value(), int | float | bool)
    is_text = is_name if is_number else _is_there(value) and found.value() != value
    return f"{key}{quoted(value)}" if is_text else word


def _is_there(value: str) -> bool:
    try:
        return value != "" and value == value.strip("\"'") and Path(value).expanduser().exists()
    except (OSError, ValueError):  # too long, or with a zero byte
        return False


def _quoted_items(value: str) -> str:
    """Quote those items of a list that Hydra cannot read."""
    items = (item.strip() for item in value[1:-1].split(","))
    return f"[{','.join(item if parsed(f'x=[{item}]') is not None else quoted(item) for item in items)}]"


def written(value: Any) -> str:
    """Write a value as Hydra's grammar reads it back."""
    if isinstance(value, list | tuple):
        return f"[{','.join(written(item) for item in value)}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{written(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        return value if PLAIN.fullmatch(value) and value.lower() not in WORDS else quoted(value)
    return json.dumps(value) if value is None or isinstance(value, bool) else str(value)


def quoted(value: str) -> str:
    """Quote text for Hydra's grammar."""
    return QuotedString(value, Quote.single).with_quotes()
