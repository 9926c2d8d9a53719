"""Damages: what happens to files on disks, in transfers and under editors, and what people mistype."""

from collections.abc import Callable

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]

WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "-0", "1e6", "1e30", "1e-30", "2.5", "99999999999999999999", "0x10"),
    *("", "abc", "None", "null", "true", "[]", "{}", "[1,2]", "é", "\x00", "1,5", "1_000", "+-1", '"', "..", "1e", "#"),
)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(0, len(data))] if data else data


def empty(data: bytes, rng: np.random.Generator) -> bytes:
    return b""


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    array = np.frombuffer(data, np.uint8).copy()
    if len(array):
        rows = rng.integers(0, len(array), rng.integers(1, 9))
        array[rows] ^= np.uint8(1) << rng.integers(0, 8, len(rows)).astype(np.uint8)
    return array.tobytes()


def overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    """A block of zeros, of ones or of noise, as after a power cut."""
    start = int(rng.integers(0, max(len(data), 1)))
    length = int(rng.integers(1, 600))
    blocks = (bytes(length), b"\xff" * length, rng.bytes(length))
    return (data[:start] + blocks[rng.integers(3)] + data[start + length :])[: len(data)]


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(0, len(data) + 1))
    return data[:start] + rng.bytes(int(rng.integers(1, 40))) + data[start:]


def delete(data: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(0, max(len(data), 1)))
    return data[:start] + data[start + int(rng.integers(1, 200)) :]


def append(data: bytes, rng: np.random.Generator) -> bytes:
    return data + (data if rng.integers(2) else rng.bytes(100))


def number_in_header(data: bytes, rng: np.random.Generator) -> bytes:
    """One of the first numbers becomes another one: counts, shapes, versions, sizes."""
    start = int(rng.integers(0, min(len(data), 400) or 1))
    for place in range(start, min(len(data), start + 400)):
        if data[place : place + 1].isdigit():
            return data[:place] + str(rng.integers(0, 10**9)).encode() + data[place + 1 :]
    return data


def _lines(data: bytes) -> list[bytes]:
    return data.split(b"\n")


def drop_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = _lines(data)
    del lines[rng.integers(len(lines))]
    return b"\n".join(lines)


def double_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = _lines(data)
    row = rng.integers(len(lines))
    return b"\n".join([*lines[:row], lines[row], *lines[row:]])


def shuffle_lines(data: bytes, rng: np.random.Generator) -> bytes:
    lines = _lines(data)
    return b"\n".join(lines[row] for row in rng.permutation(len(lines)))


def change_word(data: bytes, rng: np.random.Generator) -> bytes:
    lines = _lines(data)
    row = rng.integers(len(lines))
    words = lines[row].split(b" ")
    words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))].encode()
    lines[row] = b" ".join(words)
    return b"\n".join(lines)


def drop_word(data: bytes, rng: np.random.Generator) -> bytes:
    lines = _lines(data)
    row = rng.integers(len(lines))
    words = lines[row].split(b" ")
    del words[rng.integers(len(words))]
    lines[row] = b" ".join(words)
    return b"\n".join(lines)


def change_value(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace what stands after a colon or an equals sign, as in JSON and YAML, by a word; else change any word."""
    places = [place for place in range(len(data)) if data[place : place + 1] in (b":", b"=")][:2000]
    if not places:
        return change_word(data, rng)
    start = places[rng.integers(len(places))] + 1
    end = start
    while end < len(data) and data[end : end + 1] not in (b",", b"}", b"\n", b"]"):
        end += 1
    return data[:start] + b" " + WORDS[rng.integers(len(WORDS))].encode() + data[end:]


def windows_text(data: bytes, rng: np.random.Generator) -> bytes:
    """A byte order mark and other line ends: what some editors leave, and no damage at all."""
    return b"\xef\xbb\xbf" + data.replace(b"\n", b"\r\n")


def other_encoding(data: bytes, rng: np.random.Generator) -> bytes:
    return data.decode("latin-1").encode("utf-16")


BYTES: tuple[Damage, ...] = (truncate, empty, flip_bits, overwrite, insert, delete, append, number_in_header)
TEXT: tuple[Damage, ...] = (
    *(truncate, empty, flip_bits, overwrite, insert, drop_line, double_line, shuffle_lines),
    *(change_word, change_word, drop_word, change_value, change_value, windows_text, other_encoding),
)
