"""Text to token numbers as CLIP does it: byte-level pairs, merged in the order of a vocabulary file.

CLIP cleans its text with ftfy first. What of that matters for names is done here: composed characters, straight quotes,
ligatures as letters, full-width characters as usual ones, and HTML's entities. Text that was decoded wrongly stays so.
"""

import gzip
import html
import re
import unicodedata
import zlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tokenizers.pre_tokenizers import PreTokenizer

WORDS = r"(?i)'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"  # letters, one number, or neither
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
        from tokenizers import models

        symbols = list(byte_symbols().values())
        merges = _read_merges(path, num_tokens - 2 * len(symbols) - 2)
        names = [*symbols, *(symbol + END_OF_WORD for symbol in symbols), *(left + right for left, right in merges)]
        numbers = {name: number for number, name in enumerate(names)}
        self._pairs = models.BPE(vocab=numbers, merges=merges, end_of_word_suffix=END_OF_WORD)
        self._start, self._end, self._length = num_tokens - 2, num_tokens - 1, length

    def __call__(self, texts: list[str]) -> np.ndarray:
        """Return int64 (texts, length): start, text, end, zeros; a text that is too long is cut before the end."""
        from tokenizers.pre_tokenizers import ByteLevel

        rows, as_bytes = np.zeros((len(texts), self._length), np.int64), ByteLevel(False, use_regex=False)
        for row, text in zip(rows, texts, strict=True):
            words = (as_bytes.pre_tokenize_str(word)[0][0] for word in words_of(text))
            numbers = [token.id for word in words for token in self._pairs.tokenize(word)]
            numbers = [self._start, *numbers[: self._length - 2], self._end]
            row[: len(numbers)] = numbers
        return rows


def words_of(text: str) -> list[str]:
    """Return the parts of a text that are merged each by itself: words, single numbers, runs of signs."""
    cleaned = " ".join(clean(text).lower().split())
    return [word for word, _ in _splitter().pre_tokenize_str(cleaned)]


@cache
def _splitter() -> "PreTokenizer":
    from tokenizers import Regex
    from tokenizers.pre_tokenizers import Split

    return Split(Regex(WORDS), "removed", invert=True)


def clean(text: str) -> str:
    """Return the text with what looks like one character as one, and without the signs of a typesetter."""
    narrow = "".join(_narrow(sign) for sign in html.unescape(html.unescape(text)).translate(QUOTES))
    return unicodedata.normalize("NFC", narrow)


def _narrow(sign: str) -> str:
    """Return a ligature of Latin letters or a full- or half-width character as the usual ones."""
    return unicodedata.normalize("NFKC", sign) if NARROWED.match(sign) else sign


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
