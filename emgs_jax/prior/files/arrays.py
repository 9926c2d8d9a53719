"""Read and check arrays of other programs; errors name file and key."""

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.data.file_names import natural_order
from emgs_jax.data.reading import is_rigid
from emgs_jax.io.npz import npz_names, read_npz
from emgs_jax.io.packages import extra
from emgs_jax.prior.files.view import Intrinsics, View, usable

MAX_POSITION = 1e6  # in the file's unit
EXR_CHANNELS = ("Z", "Y", "R", "V")  # the first that exists is the depth


def files_of(folder: Path, suffix: str) -> list[Path]:
    """The files of a folder with a suffix, in natural order."""
    found = [path for path in folder.glob(f"*{suffix}") if not path.name.startswith(".")]
    return [found[row] for row in natural_order(found)[0]]


@contextlib.contextmanager
def reading(path: Path, what: str, *errors: type[Exception]) -> Iterator[None]:
    """Turn errors into a ValueError that names the file."""
    try:
        yield
    except (ValueError, OSError, *errors) as error:
        raise ValueError(f"{path} is no {what} that can be read ({error}): write it again") from error


def load_npz(path: Path, names: Sequence[str] = (), optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Read arrays of an .npz; ValueError names the file and what it lacks and has."""
    try:
        with path.open("rb") as handle:
            return read_npz(handle, names, optional, may_be_compressed=True)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: {error}; it has {', '.join(names_in(path)) or 'nothing'}") from error


def names_in(path: Path) -> list[str]:
    """Names of the arrays of an .npz; none if it is no .npz."""
    try:
        with path.open("rb") as handle:
            return npz_names(handle)
    except (ValueError, OSError):
        return []


def load_npy(path: Path) -> np.ndarray:
    with reading(path, ".npy", EOFError):
        return np.load(path, allow_pickle=False)


def load_exr(path: Path) -> np.ndarray:
    """Read depths of an EXR file by the package OpenEXR."""
    exr = extra("OpenEXR", f"{path}: EXR needs the package OpenEXR", "exr")
    with reading(path, "EXR", Exception), exr.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    known = [name for name in EXR_CHANNELS if name in channels] or [*channels][: len(channels) == 1]
    if not known:
        raise ValueError(f"{path} has the channels {', '.join(channels)}: one of {', '.join(EXR_CHANNELS)} is expected")
    return channels[known[0]].astype(np.float32)


def load_json(path: Path) -> Any:
    with reading(path, "JSON", RecursionError):
        return json.loads(path.read_text(encoding="utf-8-sig"))


def load_numbers(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Read a text file of numbers, inf and nan among them."""
    with reading(path, f"list of numbers {shape}"):
        return np.array([float(word) for word in path.read_text(encoding="utf-8-sig").split()]).reshape(shape)


def as_numbers(values: Any, where: str, what: str) -> np.ndarray:
    try:
        return np.asarray(values, np.float64)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where} must be {what}") from error


def as_poses(values: Any, where: str) -> np.ndarray:
    """T_world_camera (n, 4, 4) of (n, 3, 4), (n, 4, 4) or (n, 16); NaN for a pose that is not finite."""
    poses = as_numbers(values, where, "a matrix of 4 by 4 numbers, camera -> world")
    poses = poses.reshape(-1, 4, 4) if poses.shape[1:] == (16,) else poses
    if poses.shape[1:] == (3, 4):
        poses = np.concatenate([poses, np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(poses), 1, 4))], axis=1)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        many = ": more than one scene, give each a folder of its own" if poses.ndim == 4 else ""
        raise ValueError(f"{where} must be matrices of 3 or 4 by 4 numbers, got {poses.shape}{many}")
    poses = np.where(np.isfinite(poses).all((1, 2), keepdims=True), poses, np.nan)
    for row in np.flatnonzero(np.isfinite(poses).all((1, 2))):
        if not is_rigid(poses[row]) or np.abs(poses[row, :3, 3]).max() > MAX_POSITION:
            name = where if len(poses) == 1 else f"{where}, row {row},"
            raise ValueError(f"{name} is no rigid motion within {MAX_POSITION:g}: camera -> world is expected")
    return poses


def as_intrinsics(values: Any, where: str) -> Intrinsics:
    """fx, fy, cx, cy of four numbers or a camera matrix (3, 3) or (4, 4)."""
    given = as_numbers(values, where, "[fx, fy, cx, cy] or a camera matrix")
    if given.shape in ((3, 3), (4, 4)):
        if not np.allclose(given[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1), atol=1e-3):
            raise ValueError(f"{where} must be fx 0 cx, 0 fy cy, 0 0 1, row by row, got {given.tolist()}: transpose it")
        given = given[[0, 1, 0, 1], [0, 1, 2, 2]]
    if given.shape != (4,) or not np.isfinite(given).all() or min(given[:2]) <= 0:
        raise ValueError(f"{where} must be [fx, fy, cx, cy] or a camera matrix, in pixels of the file, got {values}")
    return tuple(map(float, given))


def as_view(
    source: str, geometry: np.ndarray, confidence: np.ndarray | None = None, intrinsics: Intrinsics | None = None
) -> View:
    """Check and make a view of depths (h, w) or points (h, w, 3), a confidence (h, w) of at least 1, and intrinsics."""
    geometry = _plane(geometry)
    if geometry.dtype.kind not in "fui" or geometry.ndim not in (2, 3) or geometry.shape[2:] not in ((), (3,)):
        raise ValueError(f"{source} must be depths (h, w) or points (h, w, 3), got {geometry.dtype} {geometry.shape}")
    if min(geometry.shape[:2]) < 2:
        raise ValueError(f"{source} is {geometry.shape[1]}x{geometry.shape[0]}, and must have two rows and columns")
    if confidence is not None:
        confidence = _plane(confidence)
        if confidence.shape != geometry.shape[:2] or confidence.dtype.kind not in "fui":
            raise ValueError(
                f"{source}: confidence must be numbers {geometry.shape[:2]}, as what it is of, got {confidence.dtype} "
                f"{confidence.shape}"
            )
        known = confidence[usable(geometry)]
        wrong = known[~((known >= 1) & (known < np.inf))]
        if len(wrong):
            raise ValueError(
                f"{source}: confidence must be finite and at least 1 where there is a depth, and is {wrong[0]:.3g}: of "
                "what begins at 0, such as probabilities, give 1 + confidence"
            )
    return View(source, geometry, confidence, intrinsics)


def _plane(values: np.ndarray) -> np.ndarray:
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
