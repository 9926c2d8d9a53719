"""Shared by the data sets on disk: find, choose, read, check and resize; errors name their file."""

import hashlib
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import ExifTags, Image

from emgs_jax.data.base import BadFrameError

Number = int | float  # a YAML value may be written 585 or 585.0
Size = tuple[int, int]  # (width, height)
Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy; pixel centres at integers

MAX_SIDE = 16384  # pixels; more is a typing error
MAX_POSITION_M = 1000.0  # from the origin, where steps of float32 are .06 mm; they are 6 cm at 1e6 m
RIGID_TOLERANCE = 1e-2  # of R^T R, as text files round
SAME_SURFACE = 0.05  # relative inverse-depth step between neighbouring pixels of one surface
AS_STORED = cv2.IMREAD_IGNORE_ORIENTATION  # not turned by EXIF, as other programs do not turn either
HEIC = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"miaf", b"MiHE"}
NUM_PIXELS, SIDE = 320 * 240, 16  # of a frame, whose sides are multiples of SIDE
OWN_BITS = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH  # BGR in 8 or 16 bits, or float
EIGHT_BITS = b"\xff\xd8", b"BM", b"RIFF", b"GIF8"  # signatures of formats without more bits
REMEDY = "fetch the file again or set on_bad_frame=skip"


def find_sequence(root: str | None, sequence: str | None, layout: str, source: str) -> Path:
    """The folder (or file) root/sequence; errors name the path, the expected layout and the source of the data."""
    if root is None:
        raise ValueError(f"dataset.root is not set: give dataset.root=FOLDER with the layout {layout} ({source})")
    if sequence is None:
        raise ValueError(f"dataset.sequence is not set: give dataset.sequence=NAME of the layout {layout} under {root}")
    folder = Path(root).expanduser()
    path = folder / sequence
    if not folder.exists():
        raise FileNotFoundError(f"dataset.root={root} does not exist; expected the layout {layout} ({source})")
    if not path.exists():
        near = next(p for p in path.parents if p.is_dir())
        names = ", ".join(sorted(p.name for p in near.iterdir() if not p.name.startswith("."))[:8])
        raise FileNotFoundError(f"{path} does not exist; expected the layout {layout} ({source}); {near} has: {names}")
    return path


def select(count: int, start: int, stop: int | None, stride: int, where: object) -> range:
    """Choose images out of `count`; `where` names them in errors."""
    if count == 0:
        raise ValueError(f"{where} has no images")
    for name, value in (("start", start), ("stop", 0 if stop is None else stop), ("stride", stride)):
        if not isinstance(value, int):
            raise ValueError(f"dataset.{name} must be a whole number of images, got {value}")
    if stride < 1:
        raise ValueError(f"dataset.stride must be at least 1, got {stride}")
    if not 0 <= start < count:
        raise ValueError(f"dataset.start must be in 0..{count - 1}, {where} has {count} images; got {start}")
    if stop is not None and not start < stop <= count:
        raise ValueError(f"dataset.stop must be null (all) or in {start + 1}..{count}, of {where}; got {stop}")
    return range(start, count if stop is None else stop, stride)


def limit(start: int, stop: int | None) -> int | None:
    """The number of images that must be counted before `select`; None: all, also if `start` or `stop` are invalid."""
    return stop if isinstance(start, int) and isinstance(stop, int) and 0 <= start < stop else None


def stretch(size: Size, other: Size) -> float:
    """Relative difference of the sides' ratios of two images: 0 if one is a smaller copy of the other."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1.0)


def check_index(index: int, count: int) -> None:
    """Raise IndexError outside of 0..count-1, which ends a for loop over a data set."""
    if not 0 <= index < count:
        raise IndexError(f"frame {index} of a sequence with {count} frames")


def check_size(size: Sequence[int]) -> Size:
    values = tuple(size) if isinstance(size, Iterable) else (size,)
    if len(values) != 2 or not all(isinstance(value, int) and 1 <= value <= MAX_SIDE for value in values):
        raise ValueError(f"dataset.size must be [width, height] in pixels, up to {MAX_SIDE}, got {size}")
    return values[0], values[1]


def check_depth_scale(depth_scale: Number, what: str = "dataset.depth_scale") -> float:
    """Check that a depth scale is positive and finite; `what` names it in errors."""
    if not (math.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(
            f"{what} must be raw units per metre, above 0, got {depth_scale}: correct it, or leave the key out for the "
            "data set's own"
        )
    return float(depth_scale)


def check_intrinsics(
    intrinsics: str | Sequence[Number], raw_size: Size, what: str = "dataset.intrinsics", images: str = "images"
) -> Intrinsics:
    """Check that intrinsics are four numbers that fit images of `raw_size`; `what` and `images` name them in errors."""
    if isinstance(intrinsics, str):
        raise ValueError(f"{what} must be [fx, fy, cx, cy] in pixels for this data set, got {intrinsics!r}")
    values = tuple(float(v) for v in intrinsics)
    if len(values) != 4 or not np.isfinite(values).all() or min(values[:2]) <= 0:
        raise ValueError(f"{what} must be [fx, fy, cx, cy] in pixels, focal lengths above 0, got {list(intrinsics)}")
    if not (0 <= values[2] < raw_size[0] and 0 <= values[3] < raw_size[1]):
        raise ValueError(
            f"{what} {list(values)} has its principal point outside of the {raw_size[0]}x{raw_size[1]} "
            f"{images}: give [fx, fy, cx, cy] at the size of the images on disk, not at dataset.size"
        )
    return values


def resize_intrinsics(intrinsics: Intrinsics, raw_size: Size, size: Size) -> Intrinsics:
    """Intrinsics after resizing; image borders stay borders, so c' = (c + .5) s - .5."""
    fx, fy, cx, cy = intrinsics
    sx, sy = size[0] / raw_size[0], size[1] / raw_size[1]
    return fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5


def about_pixels(width: int, height: int) -> tuple[int, int]:
    """(width, height) with the aspect of an image and about NUM_PIXELS pixels."""
    scale = math.sqrt(NUM_PIXELS / (width * height))
    return max(round(width * scale / SIDE), 1) * SIDE, max(round(height * scale / SIDE), 1) * SIDE


def resize_color(image: UInt8[np.ndarray, "_ _ 3"], size: Size) -> UInt8[np.ndarray, "_ _ 3"]:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def resize_nearest(values: np.ndarray, size: Size) -> np.ndarray:
    """Resize depths (float) or labels (integer) without mixing both sides of an edge.

    The pixels around each new centre vote by bilinear weights for equal labels, or for depths of one surface; the lower
    right wins a tie. If all depths are of one surface, inverse depth is interpolated, which is exact on a plane, where
    the nearest pixel would be half a pixel off for even factors.
    """
    (top, bottom, v), (left, right, u) = (_around(*sides) for sides in zip(values.shape, size[::-1], strict=True))
    corners = np.stack([values[rows[:, None], columns] for rows in (bottom, top) for columns in (right, left)])
    weights = np.stack([y[:, None] * x for y in (v, 1 - v) for x in (u, 1 - u)])
    is_depth = values.dtype.kind == "f"
    inverse = np.where(corners > 0, 1.0 / np.where(corners > 0, corners, 1.0), 0.0) if is_depth else corners
    largest = np.maximum(inverse[:, None], inverse) if is_depth else 0
    is_alike = np.abs(inverse[:, None] - inverse) <= SAME_SURFACE * largest
    votes = (is_alike * weights).sum(1)
    chosen = (votes + 1e-3 * weights).argmax(0)[None]
    nearest = np.take_along_axis(corners, chosen, 0)[0]
    if not is_depth:
        return nearest
    is_mixed = (np.take_along_axis(votes, chosen, 0)[0] > 1 - 1e-6) & (weights.max(0) < 1) & (nearest > 0)
    blended = 1.0 / np.where(is_mixed, (weights * inverse).sum(0), 1.0)
    return np.where(is_mixed, blended, nearest).astype(values.dtype)


def _around(count: int, wanted: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixels, of `count`, before and after each of `wanted` centres, and the second one's weight."""
    centres = np.clip((np.arange(wanted) + 0.5) * count / wanted - 0.5, 0, count - 1)
    before = np.floor(centres).astype(int)
    return before, np.minimum(before + 1, count - 1), centres - before


def read_bytes(path: Path) -> bytes:
    """Read a file's bytes; BadFrameError if that fails."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise BadFrameError(f"{path} is missing: {REMEDY}") from error
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise BadFrameError(f"{path} cannot be read ({error}): {REMEDY}") from error


def read_text(path: Path) -> str:
    """Read a file's text, without a byte order mark; invalid bytes are replaced."""
    return read_bytes(path).decode("utf-8-sig", "replace")


def layout_text(path: Path, layout: str) -> str:
    """Read a file's text; FileNotFoundError, which names the expected layout, if that fails."""
    try:
        return read_text(path)
    except BadFrameError as error:
        raise FileNotFoundError(f"{error}; expected the layout {layout}") from error


def damage(data: bytes) -> str | None:
    """Describe damage of an encoded image, whose missing parts decoders fill with grey; None if there is none."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_damage(data)
    if data.startswith(b"\xff\xd8"):
        # Thumbnails before the scan have their own end markers; inside the scan an 0xff is escaped.
        scan = _jpeg_scan(data)
        return None if scan >= 0 and data.find(b"\xff\xd9", scan) >= 0 else "truncated: no end-of-image marker"
    if data.startswith(b"BM") and len(data) >= 6 and len(data) < struct.unpack("<I", data[2:6])[0]:
        return "truncated: shorter than its header says"
    return None if data else "empty"


def _png_damage(data: bytes) -> str | None:
    position = 8
    while position + 12 <= len(data):
        (length,) = struct.unpack(">I", data[position : position + 4])
        end = position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[position + 4 : end]) != struct.unpack(">I", data[end : end + 4])[0]:
            return "damaged: a PNG checksum is wrong"
        if data[position + 4 : position + 8] == b"IEND":
            return None
        position = end + 4
    return "truncated: no PNG end chunk"


def _jpeg_scan(data: bytes) -> int:
    """Offset of the first scan, or -1."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        if data[position + 1] == 0xFF:  # fill byte
            position += 1
            continue
        if data[position + 1] == 0xDA:
            return position
        position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    return -1


def decode(path: Path, flags: int) -> np.ndarray:
    """Decode an image file by cv2 (BGR); BadFrameError if that fails."""
    data = read_bytes(path)
    reason = damage(data)
    image = None
    if reason is None:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            reason = f"cannot be decoded ({error.err})"
    if image is None:
        other = other_kind(data)
        remedy = f"convert it to png or jpg, {REMEDY}" if (other or "").startswith("an image") else REMEDY
        raise BadFrameError(f"{path} is {other or reason or 'not a readable image'}: {remedy}")
    return image


def orientation(path: Path) -> int:
    """The EXIF orientation of an image, from 1 (as stored, or none) to 8."""
    try:
        with Image.open(path) as image:
            found = image.getexif().get(ExifTags.Base.Orientation, 1)
    except (OSError, ValueError, SyntaxError):
        return 1
    return found if found in range(2, 9) else 1


def is_turned_unseen(path: Path) -> bool:
    """Test whether EXIF turns an image without changing its sides: mirrored, upside down, or square."""
    turn = orientation(path)
    if turn == 1:
        return False
    with Image.open(path) as image:
        return turn < 5 or image.width == image.height


def other_kind(data: bytes) -> str | None:
    """Name the kind of a file that OpenCV cannot decode, by its content; None if unknown."""
    if data[4:8] == b"ftyp":
        box = data[8 : max(int.from_bytes(data[:4], "big"), 12)]
        brands = {box[at : at + 4] for at in range(0, min(len(box), 128), 4) if at != 4}  # at 4 is a version
        kinds = {"AVIF": {b"avif", b"avis"}, "Canon's raw format": {b"crx "}, "HEIC": HEIC}
        kind = next((kind for kind, own in kinds.items() if brands & own), None)
        return f"an image in {kind}, whatever its name says" if kind else "a video"
    if data.startswith((b"\xff\x0a", b"\0\0\0\x0cJXL ")):
        return "an image in JPEG XL, whatever its name says"
    if data.startswith(b"version https://git-lfs"):
        return "a pointer of Git LFS and no image (git lfs pull fetches it)"
    if data[:4] == b"%PDF":
        return "a PDF"
    return "a web page" if data.lstrip()[:1] == b"<" else None


def read_depth(path: Path, depth_scale: float, raw_size: Size | None = None) -> Float32[np.ndarray, "_ _"]:
    """Read depth in metres from a 16-bit image, 0 = no value (raw 0 and 65535)."""
    raw = decode(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise BadFrameError(f"{path} must be a 16-bit depth image with one channel, got {raw.dtype} {raw.shape}")
    check_raw_size(raw, raw_size, path)
    return np.where(raw == 65535, 0, raw).astype(np.float32) / np.float32(depth_scale)


def check_raw_size(image: np.ndarray, raw_size: Size | None, path: object) -> None:
    """Raise BadFrameError unless an image has the calibration's size."""
    if raw_size is not None and image.shape[1::-1] != tuple(raw_size):
        (w, h), (width, height) = image.shape[1::-1], raw_size
        raise BadFrameError(
            f"{path} is {w}x{h}, but colour, depth and intrinsics of this sequence are {width}x{height}: "
            "resize the file, or give dataset.intrinsics for the images that are there, or set on_bad_frame=skip"
        )


def first_size(
    images: Iterable[Any], where: object, flags: int = 0, read: Callable[[Any], np.ndarray] | None = None
) -> Size:
    """(width, height) of the first image that can be read, by default a file; `where` names them in errors."""
    reasons = []
    for image in images:
        try:
            return (decode(image, OWN_BITS | flags) if read is None else read(image)).shape[1::-1]
        except BadFrameError as error:
            reasons.append(str(error))
    raise ValueError(f"{where}: none of its {len(reasons)} images can be read: {'; '.join(dict.fromkeys(reasons[:3]))}")


def transparency_note(paths: Iterable[Path]) -> str | None:
    """Describe the first image that is transparent in places; None if there is none."""
    return next((note for path in paths if (note := _transparency(path))), None)


def may_be_deep(path: Path) -> bool:
    """Test by its first bytes whether an image may have more than 8 bits."""
    try:
        with open(path, "rb") as file:
            head = file.read(25)
    except OSError:
        return True
    return head[24:] == b"\x10" if head.startswith(b"\x89PNG") else not head.startswith(EIGHT_BITS)


def _transparency(path: Path) -> str | None:
    try:
        with Image.open(path) as image:
            has_some = "A" in image.getbands() or "transparency" in image.info
            if not has_some or image.convert("RGBA").getchannel("A").getextrema()[0] >= 255:
                return None
    except (OSError, ValueError, SyntaxError):  # damaged; reported when it is read
        return None
    return (
        f"{path.name} is transparent in places, and maybe others: such pixels are mapped in the file's colour below "
        "(often black): take them out of the predictions"
    )


def as_pose(text: str, where: object, may_be_far: bool = False) -> Float[np.ndarray, "4 4"] | None:
    """Parse a rigid transform from 16 numbers, by rows; None if they are inf or nan (lost tracking).

    Raises:
        BadFrameError: they are no pose.
        ValueError: it is too far away for float32.
    """
    try:
        pose = np.array([float(token) for token in text.split()], np.float64).reshape(4, 4)
    except ValueError as error:
        raise BadFrameError(f"{where} must hold 16 numbers (a 4x4 pose): {REMEDY}") from error
    if not np.isfinite(pose).all():
        return None
    if not is_rigid(pose):
        scale = float(np.cbrt(np.linalg.det(pose[:3, :3])))
        if scale > 0 and is_rigid(pose / np.where(np.arange(4) < 3, [[scale]] * 3 + [[1.0]], 1.0)):
            raise BadFrameError(
                f"{where} has a rotation times {scale:.4g}, of an alignment with a scale: divide the first three "
                "columns by it, and give depth and positions in one unit"
            )
        if scale < 0 and is_rigid(pose * np.where(np.arange(4) == 0, -1.0, 1.0)):
            raise BadFrameError(f"{where} has a mirrored pose, as of one axis flipped: flip two of them, or none")
        raise BadFrameError(f"{where} has a pose that is no rigid motion: {REMEDY}")
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right  # the nearest rotation, as the text is rounded
    if not may_be_far:
        check_position(pose[:3, 3], where)
    return pose


def rigid(position: Sequence[float], quaternion: Sequence[float]) -> Float[np.ndarray, "4 4"]:
    """The pose with a position and a quaternion x, y, z, w; ValueError unless finite and of length 1."""
    if not np.isfinite(position).all() or not abs(math.hypot(*quaternion) - 1) <= RIGID_TOLERANCE:
        raise ValueError("its quaternion has not length 1")
    from scipy.spatial.transform import Rotation  # slow to import, and no command's help needs it

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return pose


def is_rigid(poses: Float[np.ndarray, "*b 4 4"]) -> bool:
    """Test whether all poses are rigid, up to `RIGID_TOLERANCE`."""
    turns = poses[..., :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turns @ turns.mT - np.eye(3))
        is_turn = (off < RIGID_TOLERANCE).all() and (np.linalg.det(turns) > 0).all()
    return bool(is_turn and np.allclose(poses[..., 3, :], (0, 0, 0, 1)))


def check_position(position: Float[np.ndarray, " 3"], where: object) -> None:
    """Raise ValueError if a true position is too far away for float32."""
    if np.abs(position).max() > MAX_POSITION_M:
        shown = ", ".join(f"{value:g}" for value in position)
        raise ValueError(
            f"{where} has a position of [{shown}] m, and a map holds positions in float32 up to {MAX_POSITION_M:g} m: "
            "where the trajectory is geo-referenced subtract one position from all of its lines, else correct this one"
        )


def fingerprint(root: Path, files: Iterable[Path], options: dict[str, object]) -> str:
    """Hex digest of names and contents of files, and of options; independent of the machine."""
    digest = hashlib.sha256()
    files = set(files)
    names = {p.relative_to(root).as_posix() if p.is_relative_to(root) else p.name: p for p in files}
    contents = {name: _content(path) for name, path in names.items()}
    for item in [*sorted(options.items()), *sorted(contents.items())]:
        digest.update(repr(item).encode())
    return digest.hexdigest()


def contents(path: Path) -> str:
    """Hex digest of a file, or of those in a folder and its numbered ones, such as models of COLMAP or a bag."""
    files = [path, *path.glob("*"), *path.glob("[0-9]*/*")]
    return fingerprint(path, (file for file in files if file.is_file()), {})


def _content(path: Path) -> str:
    """Digest of a file's bytes; empty if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, hashlib.blake2b).hexdigest()
    except OSError:
        return ""
