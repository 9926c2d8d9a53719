"""Information in the names of image files: the file that a list means, the order of the files, and their times."""

import itertools
import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from emgs_jax.data.timestamps import UNITS, unit_of

# 20261127_142233, 2026-11-27 14.22.33.250: year, month, day, hour, minute, second and maybe milliseconds.
DATE = re.compile(r"(?<!\d)(20\d\d)([-_.]?)(\d\d)\2(\d\d)[-_.T ]?(\d\d)([-_.:]?)(\d\d)\6(\d\d)(?:[-_.]?(\d{3}))?(?!\d)")
PARTS = re.compile(r"(\d{10})[-_](\d{9})$")  # seconds since 1970 and nanoseconds, as drivers of ROS write them


MAX_KINDS, MIN_NUMBERS = 4, 3  # of images in one folder that are told apart by their names
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
OTHER_SUFFIXES = (".heic", ".heif", ".avif", ".jxl", ".gif", ".exr", ".hdr", ".ppm", ".pgm", ".dng", ".cr2", ".cr3")
OTHER_SUFFIXES += (".nef", ".arw", ".raf", ".orf", ".rw2", ".raw")


def find_image(folder: Path, name: str) -> Path:
    """The image that a list in `folder` names: as it stands, with Windows' backslashes, or without its ending.

    Where none of them is there it is the file of that name, which then cannot be read.
    """
    written = folder / name
    for path in dict.fromkeys((written, folder / name.replace("\\", "/"))):
        if is_file(path):
            return path
        for suffix in IMAGE_SUFFIXES:
            for ended in (path.with_name(path.name + suffix), path.with_name(path.name + suffix.upper())):
                if is_file(ended):
                    return ended
    return folder / name.replace("\\", "/")


def check_one_kind(paths: Sequence[Path]) -> None:
    """ValueError where images in their order are several of each number: colours and depths, images and masks."""
    numbers = [tuple(re.findall(r"[0-9]+", path.stem)) for path in paths]
    kinds = {re.sub(r"[0-9]+", "#", path.name): path for path in paths}
    repeats = [row for row, pair in enumerate(itertools.pairwise(numbers)) if pair[0] and pair[0] == pair[1]]
    if 2 <= len(kinds) <= MAX_KINDS and len({*numbers}) >= MIN_NUMBERS and len(repeats) >= 0.4 * (len(paths) - 1):
        a, b = (paths[repeats[0] + place].name for place in (0, 1))
        raise ValueError(
            f"{paths[0].parent} has images of {len(kinds)} kinds that have the same numbers, such as {a} and {b}: a "
            "sequence is of one kind, so move the others (depths, masks, a second camera) into another folder"
        )


def unread_note(folder: Path) -> str | None:
    """Words about the pictures of a folder that are of no format that is read."""
    endings = [path.suffix.lower() for path in folder.iterdir() if not path.name.startswith(".")]
    found = {ending: endings.count(ending) for ending in OTHER_SUFFIXES if ending in endings}
    if not found:
        return None
    counts = ", ".join(f"{count} {ending}" for ending, count in found.items())
    return f"{folder} has {counts}, which are not read: convert them to jpg or png"


def is_file(path: Path) -> bool:
    """Test whether a file exists; False also for a name that no file can have (too long, or with a zero byte)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def natural_key(path: Path) -> list[list[tuple[int, int, str]]]:
    """Sort key under which frame2 comes before frame10, and all of a folder before all of the next."""

    def key(name: str) -> list[tuple[int, int, str]]:
        parts = re.split(r"([0-9]+)", name.casefold())
        return [(1, int(p), p) if p and p[0] in "0123456789" else (0, 0, p) for p in parts]

    return [key(name) for name in path.parts]


def times_of(paths: Sequence[Path]) -> tuple[list[float], str | None]:
    """Seconds of image files in their order, and a note where their names are not read as they stand.

    They are the numbers in the names where they ascend, else the positions of the files. Of clocks in milliseconds,
    microseconds or nanoseconds they are seconds (see `unit_of`), and of a date and time of day those since 1970 (UTC).
    """
    names = [path.stem for path in paths]
    dates = [_date(name) for name in names]
    if _ascend(dates):
        return dates, "times are the dates in the names of the images"
    numbers = [last_number(name) for name in names]
    if not _ascend(numbers):
        return [float(i) for i in range(len(paths))], None
    unit = unit_of(np.array(numbers, np.float64))
    note = None if unit == "seconds" else f"times are the names of the images, in {unit}"
    return [number / UNITS[unit] for number in numbers], note


def last_number(name: str) -> int | float | None:
    """The last number in a file name without suffix: 'frame-000012.color' gives 12, '1341841.25' gives 1341841.25."""
    if parts := PARTS.search(name):
        return int(parts[1]) + int(parts[2]) / 10**9
    found = re.findall(r"[0-9]+(?:\.[0-9]+)?", name)
    if not found:
        return None
    return float(found[-1]) if "." in found[-1] or len(found[-1]) > 300 else int(found[-1])


def _ascend(times: Sequence[float | None]) -> bool:
    is_known = all(time is not None and math.isfinite(time) for time in times)
    return is_known and all(b > a for a, b in zip(times, times[1:], strict=False))


def _date(name: str) -> float | None:
    """Seconds since 1970 of the date and time of day in a name; None where there is none."""
    found = DATE.search(name)
    if found is None:
        return None
    year, _, month, day, hour, _, minute, second, fraction = found.groups()
    try:
        date = datetime(*map(int, (year, month, day, hour, minute, second)), tzinfo=UTC)
    except ValueError:
        return None
    return date.timestamp() + int(fraction or 0) / 1000
