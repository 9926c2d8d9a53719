"""A list of checksums as `sha256sum` writes it: a file that is not what it was is found when it is to be read.

Flipped bytes inside a JPEG are a picture like any other, as are other digits in a pose; without a list they are silent.
"""

import hashlib
import os
import re
from pathlib import Path

from emgs_jax.data.base import BadFrameError, Dataset
from emgs_jax.data.reading import read_text

SUMS_FILE = "SHA256SUMS"
WRITE = f"(cd FOLDER && find . -type f ! -name {SUMS_FILE} -exec sha256sum {{}} + > {SUMS_FILE})"


class Checksums:
    """The files of a list, each checked once for what it is at the time.

    Args:
        path: of the list. Names are relative to its folder; files that it does not name pass.

    Raises:
        ValueError: it cannot be read, or a line of it is none of `sha256sum`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._listed = read_sums(path)
        self._sound: dict[Path, tuple[int, int]] = {}  # time of change and size at which it was found so

    def __contains__(self, file: Path) -> bool:
        return _place(file) in self._listed

    def check(self, file: Path) -> None:
        """Raise BadFrameError where the bytes of a file are others than those that were listed."""
        place = _place(file)
        if place not in self._listed or not place.is_file():
            return  # who reads it says so where it is missing
        number, expected = self._listed[place]
        status = place.stat()
        version = status.st_mtime_ns, status.st_size
        if self._sound.get(place) == version:
            return
        try:
            with open(place, "rb") as opened:
                found = hashlib.file_digest(opened, hashlib.sha256).hexdigest()
        except OSError as error:
            raise BadFrameError(f"{file} cannot be read ({error}): fetch the file again") from error
        if found != expected:
            raise BadFrameError(
                f"{file} is not the file of {self.path}, line {number} (another SHA-256): fetch the file again, write "
                f"the list again if it is right {WRITE}, or set on_bad_frame=skip"
            )
        self._sound[place] = version


def find_checksums(checksums: str | None, dataset: Dataset) -> Checksums | None:
    """The list for a data set, None where there is none; ValueError where it cannot be read or lacks an image.

    It is `off`; a file; or `auto`, SHA256SUMS in the folder of the first image or one above, if it is there. Each image
    has to be in the list.
    """
    if checksums in ("off", None, False) or not dataset.files(0):
        return None
    first = dataset.files(0)[0]
    beside = [folder / SUMS_FILE for folder in (first.parent, first.parent.parent)]
    paths = [path for path in beside if path.is_file()] if checksums == "auto" else [Path(str(checksums)).expanduser()]
    if not paths:
        return None
    found = Checksums(paths[0])
    images = {dataset.files(index)[0] for index in range(len(dataset))}
    missing = sorted(image for image in images if image not in found)
    if missing:
        raise ValueError(
            f"{found.path} lacks {len(missing)} of the {len(images)} images in use, first of all {missing[0]}: write "
            f"it again {WRITE}, or set checksums=off"
        )
    return found


def read_sums(path: Path) -> dict[Path, tuple[int, str]]:
    """Line number and hex digest by file, of a list that `sha256sum` wrote; names are resolved from its folder."""
    found = {}
    try:
        lines = read_text(path).replace("\r\n", "\n").split("\n")
    except BadFrameError as error:
        raise ValueError(f"checksums={path} cannot be read: give the file, auto or off") from error
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        parts = re.fullmatch(r"(\\?)([0-9a-fA-F]{64}) [ *](.+)", line)
        if parts is None or "\0" in line:
            raise ValueError(
                f"{path}, line {number}: expected 64 hexadecimal digits, two spaces and a name, got {line[:80]!r}; "
                f"write the list again {WRITE}"
            )
        escapes, digest, name = parts.groups()
        if escapes:  # as the names of files unpacked from Windows' archives may have backslashes
            name = re.sub(r"\\(.)", lambda sign: {"n": "\n", "r": "\r"}.get(sign[1], sign[1]), name)
        found[_place(path.parent / name)] = number, digest.lower()
    return found


def _place(file: Path) -> Path:
    """Return the path of a file with all links resolved; the path itself if no file can have that name."""
    try:
        return Path(os.path.realpath(file))
    except ValueError:  # a zero byte in a name from a damaged list
        return file
