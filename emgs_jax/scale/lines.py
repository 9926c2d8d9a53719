"""Files of numbers, a row a line."""

from collections.abc import Iterator
from pathlib import Path


def words_of(path: Path) -> Iterator[tuple[int, str, list[str]]]:
    """Yield number, text and words of each line that is neither empty nor a comment; commas separate, too."""
    for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1):
        words = line.replace(",", " ").replace(";", " ").split()
        if words and not words[0].startswith("#"):
            yield number, line, words


def numbers_in(words: list[str]) -> list[float] | None:
    """Return the words as numbers; None if one is no number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None
