"""Text to token numbers as CLIP does it: byte-level pairs, merged in the order of a vocabulary file.

CLIP cleans its text with ftfy first. What of that matters for names is done here: composed characters, straight quotes,
ligatures as letters, full-width characters as usual ones, and HTML's entities. Text that was decoded wrongly stays so.
"""

import gzip
import html
import re
import unicodedata
import zlib
from itertools import groupby
from pathlib import Path

import numpy as np

# Letters and all numbers but digits, a digit, or neither; Python has no class for letters alone.
WORDS = re.compile(r"'s|'t|'re|'ve|'m|'ll|'d|[^\W\d_]+|\d|(?:[^\s\w]|_)+", re.IGNORECASE)
NARROWED = re.compile("[\u0132\u0133\u0149\u01c4-\u01cc\u01f1-\u01f3\u3000\ufb00-\ufb06\uff01-\uffef]")
QUOTES = str.maketrans(dict.fromkeys("‘’‚‛ʼ", "'") | dict.fromkeys("“”„‟", '"'))
END_OF_WORD = "</w>"


class Tokenizer:
    """Numbers of a vocabulary, which has a number per byte, per byte that ends a word, per merge, and two marks.

    Args:
        path: CLIP's `bpe_simple_vocab_16e6.txt.gz`: after its first line, one pair a line, most frequent first.
        num_tokens: size of the text model's table; it says how many pairs of the file are in use.
    """

    def __init__(self, path: Path, num_tokens: int, length: int) -> None:
        symbols = list(byte_symbols().values())
        num_merges = num_tokens - 2 * len(symbols) - 2
        merges = _read_merges(path, num_merges)
        names = [*symbols, *(symbol + END_OF_WORD for symbol in symbols), *(left + right for left, right in merges)]
        self._number = {name: number for number, name in enumerate(names)}
        self._rank = {pair: rank for rank, pair in enumerate(merges)}
        self._start, self._end, self._length = num_tokens - 2, num_tokens - 1, length

    def __call__(self, texts: list[str]) -> np.ndarray:
        """Return int64 (texts, length): start, text, end, zeros; a text that is too long is cut before the end."""
        rows = np.zeros((len(texts), self._length), np.int64)
        for row, text in zip(rows, texts, strict=True):
            numbers = [self._number[part] for word in words_of(text) for part in self._parts(word)]
            numbers = [self._start, *numbers[: self._length - 2], self._end]
            row[: len(numbers)] = numbers
        return rows

    def _parts(self, word: str) -> list[str]:
        """Merge the symbols of a word, always the pair that comes first in the vocabulary."""
        symbols = byte_symbols()
        parts = [symbols[byte] for byte in word.encode()]
        parts[-1] += END_OF_WORD
        while len(parts) > 1:
            pair = min(zip(parts, parts[1:], strict=False), key=lambda pair: self._rank.get(pair, len(self._rank)))
            if pair not in self._rank:
                break
            merged: list[str] = []
            for part in parts:
                # A part that was just merged is longer than either of the pair, so it is not merged twice.
                if merged and (merged[-1], part) == pair:
                    merged[-1] += part
                else:
                    merged.append(part)
            parts = merged
        return parts


def words_of(text: str) -> list[str]:
    """Return the parts of a text that are merged each by itself: words, single numbers, runs of signs."""
    cleaned = " ".join(clean(text).lower().split())
    return [part for word in WORDS.findall(cleaned) for part in _without_numbers(word)]


def clean(text: str) -> str:
    """Return the text with what looks like one character as one, and without the signs of a typesetter."""
    narrow = "".join(_narrow(sign) for sign in html.unescape(html.unescape(text)).translate(QUOTES))
    return unicodedata.normalize("NFC", narrow)


def _narrow(sign: str) -> str:
    """Return a ligature of Latin letters or a full- or half-width character as the usual ones."""
    return unicodedata.normalize("NFKC", sign) if NARROWED.match(sign) else sign


def _without_numbers(word: str) -> list[str]:
    """Cut a word at its numbers, each of which stands alone: ² in m² is one, and a letter to Python's expressions."""
    if not any(unicodedata.category(sign) in ("No", "Nl") for sign in word):
        return [word]
    parts: list[str] = []
    for is_number, signs in groupby(word, lambda sign: unicodedata.category(sign).startswith("N")):
        run = "".join(signs)
        parts += [*run] if is_number else [run]
    return parts


def byte_symbols() -> dict[int, str]:
    """Return a visible character for every byte: itself where it is printable, else one from 256 on.

    The printable ones come first, in order of their number: CLIP's vocabulary counts them so.
    """
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    others = [byte for byte in range(256) if byte not in printable]
    return {byte: chr(byte) for byte in printable} | {byte: chr(256 + rank) for rank, byte in enumerate(others)}


def _read_merges(path: Path, count: int) -> list[tuple[str, str]]:
    try:
        lines = gzip.decompress(path.read_bytes()).decode("utf-8").splitlines()[1 : count + 1]
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise ValueError(f"{path} is no vocabulary of CLIP, or damaged ({error}): fetch it again") from error
    merges = [tuple(line.split()) for line in lines]
    if count < 0 or len(merges) != count or any(len(pair) != 2 for pair in merges):
        raise ValueError(f"{path} must hold {count} pairs, the text model's, after its first line: fetch it again")
    return merges
