"""What names of image files tell: the file that a list means, the order of the files, and their times."""

import itertools
import math
import re
from collections import defaultdict
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from emgs_jax.data.timestamps import MIN_CLOCK, UNITS, unit_of

# 20261127_142233, 2026-11-27 14.22.33.250: year, month, day, hour, minute, second and maybe milliseconds.
DATE = re.compile(r"(?<!\d)(20\d\d)([-_.]?)(\d\d)\2(\d\d)[-_.T ]?(\d\d)([-_.:]?)(\d\d)\6(\d\d)(?:[-_.]?(\d{3}))?(?!\d)")
PARTS = re.compile(r"(\d{10})[-_](\d{9})$")  # seconds since 1970 and nanoseconds, as drivers of ROS write them
DECIMAL = re.compile(r"(.*?)(?<![0-9.])([0-9]+)(?:\.([0-9]+))?$")  # a name that ends with a number

MAX_TAKEN = 64  # images whose EXIF is read, evenly spread
MAX_KINDS, MIN_NUMBERS = 4, 3  # kinds of images in one folder, and their numbers, to report a mixture
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
OTHER_SUFFIXES = (".heic", ".heif", ".avif", ".jxl", ".gif", ".exr", ".hdr", ".ppm", ".pgm", ".dng", ".cr2", ".cr3")
OTHER_SUFFIXES += (".nef", ".arw", ".raf", ".orf", ".rw2", ".raw")


def find_image(folder: Path, name: str) -> Path:
    """The image that a list in `folder` names, maybe with backslashes or without its ending; it may not exist."""
    endings = "", *IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES)
    for written in dict.fromkeys((name, name.replace("\\", "/"))):
        for ending in endings:
            if is_file(path := folder / f"{written}{ending}"):
                return path
    return folder / name.replace("\\", "/")


def frame_name(number: int) -> str:
    """The name of a frame that has no file of its own, as in a video."""
    return f"{number:06d}"


def check_one_kind(paths: Sequence[Path]) -> None:
    """Raise ValueError if several kinds of images have the same numbers, such as images and masks."""
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
    """Describe pictures in a folder whose format is not read; None if there are none."""
    endings = [path.suffix.lower() for path in folder.iterdir() if not path.name.startswith(".")]
    found = {ending: endings.count(ending) for ending in OTHER_SUFFIXES if ending in endings}
    if not found:
        return None
    counts = ", ".join(f"{count} {ending}" for ending, count in found.items())
    return f"{folder} has {counts}, which are not read: convert them to jpg or png"


def is_file(path: Path) -> bool:
    """Test whether a file exists; False too for an impossible name (too long, or with a zero byte)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def natural_key(path: Path) -> list[list[tuple[int, int, str]]]:
    """Sort key: frame2 before frame10, a before a(0), as a burst is named, and each folder together."""

    def key(name: str) -> list[tuple[int, int, str]]:
        parts = re.split(r"([0-9]+)", name.casefold())
        return [(1, int(p), p) if p and p[0] in "0123456789" else (0, 0, p) for p in parts]

    return [key(name) for name in (*path.parts[:-1], path.stem, path.suffix)]


def natural_order(paths: Sequence[Path]) -> tuple[list[int], str | None]:
    """Rows of image files in natural order, and a note if that is the order of decimal numbers.

    Seconds without trailing zeros are decimal: 2.05 comes before 2.1. A counter after a point has such zeros: 1.10
    follows 1.9.
    """
    found = [DECIMAL.fullmatch(path.stem) for path in paths]
    ends = [match and match[3] for match in found]
    is_dropped = None not in found and len({len(end or "") for end in ends}) > 1
    is_dropped = is_dropped and not any(end and end != "0" and end.endswith("0") for end in ends)

    def plain(row: int) -> Any:
        return natural_key(paths[row]), paths[row].name

    def decimal(row: int) -> Any:
        before, whole, end = found[row].groups()
        return natural_key(paths[row].with_name(before + "_")), int(whole), end or "", paths[row].name

    order = sorted(range(len(paths)), key=plain)
    if not is_dropped or (decimals := sorted(order, key=decimal)) == order:
        return order, None
    return decimals, "names are ordered as decimal numbers, whose last zeros are left out"


def taken_note(paths: Sequence[Path]) -> str | None:
    """Describe where EXIF times go back in the order of the names, as after a reset counter; None if they do not."""
    rows = dict.fromkeys(np.linspace(0, len(paths) - 1, min(len(paths), MAX_TAKEN)).astype(int).tolist())
    taken = [(when, paths[row].name) for row in rows if (when := _taken(paths[row]))]
    back = next(((a[1], b[1]) for a, b in itertools.pairwise(taken) if b[0] < a[0]), None)
    if back is None:
        return None
    return (
        f"{back[1]} comes after {back[0]} by its name, but was taken before it by its EXIF: if a counter was reset or "
        "a clock set back, rename the images in the order in which they were taken"
    )


def _taken(path: Path) -> str | None:
    """DateTimeOriginal with its fraction, which sorts as text; None if there is none."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return None
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
    except (OSError, ValueError, SyntaxError):
        return None
    date = str(tags.get(ExifTags.Base.DateTimeOriginal, ""))
    return date + str(tags.get(ExifTags.Base.SubsecTimeOriginal, "")) if re.match(r"[12]\d{3}:", date) else None


def times_of(paths: Sequence[Path]) -> tuple[list[float], str | None]:
    """Seconds of image files in their order, and a note unless their names are read as they stand.

    Dates with a time become seconds since 1970 (UTC); ascending numbers become seconds by `unit_of`; else the positions
    of the files are taken.
    """
    names = [path.stem for path in paths]
    dates = [_date(name) for name in names]
    if _ascend(dates):
        return dates, "times are the dates in the names of the images"
    numbers = [last_number(name) for name in names]
    if not _ascend(numbers):
        return [float(i) for i in range(len(paths))], _back_note(paths, dates) or _back_note(paths, numbers)
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


def check_numbering(all_names: Collection[str], used: Collection[str], given: Collection[str], where: object) -> None:
    """Raise ValueError if names are those of images but for the first number, such as 0 and ffmpeg's 1.

    Each would be taken for its neighbour's. They are if all are one off, and one of them is of no image; or if they are
    those of the images in use, one off.

    Args:
        all_names: names of all images, without suffix; empty if not known.
        used: names of the images in use.
        given: names of masks, poses or predictions, in `where`.
    """
    others = _numbers(given)
    for names, is_all in ((all_names, False), (used, True)):
        for kind, numbers in _numbers(names).items():
            found = others.get(kind, {})
            off = (found.keys() - {number + step for number in numbers} for step in (1, -1))
            if not numbers.keys() & found.keys() or all(off) or (is_all and len(found) < len(numbers)):
                continue
            low, high = min(numbers), max(numbers)
            if {low - 1, high + 1} & found.keys():
                raise ValueError(
                    f"{where} has names from {found[min(found)].join(kind)} on, the images from "
                    f"{numbers[low].join(kind)} on, so each would be its neighbour's: rename one of them, so that both "
                    "begin alike (ffmpeg: -start_number 0)"
                )


def _numbers(names: Collection[str]) -> dict[tuple[str, str], dict[int, str]]:
    """The numbers in names, and how they are written, by what stands before and after."""
    found = defaultdict(dict)
    for name in names:
        for match in re.finditer("[0-9]{1,18}", name):
            found[name[: match.start()], name[match.end() :]][int(match[0])] = match[0]
    return found


def _back_note(paths: Sequence[Path], times: Sequence[float | None]) -> str | None:
    """Describe where times go back in the order of the files; None if they may be other numbers."""
    known = [time for time in times if time is not None and time >= MIN_CLOCK]
    if len(known) < len(times):
        return None
    for (a, before), (b, after) in itertools.pairwise(zip(paths, known, strict=True)):
        if after < before:
            return f"times are the positions of the images: those in their names go back from {a.name} to {b.name}"
    return None


def _ascend(times: Sequence[float | None]) -> bool:
    is_known = all(time is not None and math.isfinite(time) for time in times)
    return is_known and all(b > a for a, b in zip(times, times[1:], strict=False))


def _date(name: str) -> float | None:
    """Seconds since 1970 of the date and time in a name; None without one."""
    found = DATE.search(name)
    if found is None:
        return None
    year, _, month, day, hour, _, minute, second, fraction = found.groups()
    try:
        date = datetime(*map(int, (year, month, day, hour, minute, second)), tzinfo=UTC)
    except ValueError:
        return None
    return date.timestamp() + int(fraction or 0) / 1000
