"""CLIP's tokenizer: byte pairs, merged in the order of a vocabulary file.

Of ftfy, with which CLIP cleans its text first, names need composed characters and straight quotes.
"""

import gzip
import zlib
from pathlib import Path

import numpy as np

WORDS = r"'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"  # letters, one number, or neither
QUOTES = ("[‘’‚‛ʼ]", "'"), ("[“”„‟]", '"')
END_OF_WORD = "</w>"


class Tokenizer:
    """Tokens of a vocabulary: a number per byte, per byte that ends a word, per merge, and two marks.

    Args:
        path: CLIP's `bpe_simple_vocab_16e6.txt.gz`: after its first line a pair a line, most frequent first.
        num_tokens: size of the text model's table, which tells how many pairs are in use.
    """

    def __init__(self, path: Path, num_tokens: int, length: int) -> None:
        from tokenizers import Regex, models, normalizers, pre_tokenizers
        from tokenizers import Tokenizer as Pipeline

        symbols = byte_symbols()
        merges = _read_merges(path, num_tokens - 2 * len(symbols) - 2)
        names = [*symbols, *(symbol + END_OF_WORD for symbol in symbols), *(left + right for left, right in merges)]
        numbers = {name: number for number, name in enumerate(names)}
        self._pipeline = Pipeline(models.BPE(vocab=numbers, merges=merges, end_of_word_suffix=END_OF_WORD))
        straight = [normalizers.Replace(Regex(signs), sign) for signs, sign in QUOTES]
        self._pipeline.normalizer = normalizers.Sequence([*straight, normalizers.NFC(), normalizers.Lowercase()])
        words = pre_tokenizers.Split(Regex(WORDS), "removed", invert=True)
        self._pipeline.pre_tokenizer = pre_tokenizers.Sequence(
            [words, pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)]
        )
        self._start, self._end, self._length = num_tokens - 2, num_tokens - 1, length

    def __call__(self, texts: list[str]) -> np.ndarray:
        """Encode as int64 (texts, length): start, text, end, zeros; a longer text is cut before its end mark."""
        rows = np.zeros((len(texts), self._length), np.int64)
        for row, text in zip(rows, self._pipeline.encode_batch(texts), strict=True):
            numbers = [self._start, *text.ids[: self._length - 2], self._end]
            row[: len(numbers)] = numbers
        return rows


def byte_symbols() -> list[str]:
    """A visible character for every byte, in CLIP's order: printable bytes as themselves, then the others from 256."""
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    return [chr(byte) for byte in printable] + [chr(256 + rank) for rank in range(256 - len(printable))]


def _read_merges(path: Path, count: int) -> list[tuple[str, str]]:
    try:
        lines = gzip.decompress(path.read_bytes()).decode("utf-8").splitlines()[1 : count + 1]
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise ValueError(f"{path} is no vocabulary of CLIP, or damaged ({error}): fetch it again") from error
    merges = [tuple(line.split()) for line in lines]
    if count < 0 or len(merges) != count or any(len(pair) != 2 for pair in merges):
        raise ValueError(f"{path} must hold {count} pairs, the text model's, after its first line: fetch it again")
    return merges
