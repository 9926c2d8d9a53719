"""Depths of any network in files: one file a frame, or one for all.

Video-Depth-Anything and DepthCrafter write an .npz of a whole video, Depth Anything and MiDaS images of 8 or 16 bits
(each stretched to its range, which a scale and a shift per frame undo) or .pfm, Marigold .npy. Files belong to frames
by name, apart from a common ending such as `_depth`, or by order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from emgs_jax.data.base import Dataset
from emgs_jax.data.reading import check_depth_scale, decode, fingerprint
from emgs_jax.ops.ranges import number
from emgs_jax.prior.files.arrays import files_of, load_exr, load_npy, load_npz, names_in
from emgs_jax.prior.files.naming import rows_of
from emgs_jax.prior.files.view import Camera, View, check_metres, whole_image
from emgs_jax.prior.multiview.dense import Depths, Scene, Way
from emgs_jax.prior.multiview.lens import rectify
from emgs_jax.prior.multiview.monocular import MonocularConfig, begin_monocular
from emgs_jax.scale.estimate import Scale

SUFFIXES = (".npz", ".npy", ".pfm", ".exr", ".png")  # the first that exists is read
KEYS = ("depth", "depths", "disparity", "disparities", "inverse_depth", "prediction")  # of an .npz with several arrays
IN_METRES = (
    "write metres (RealSense, ARKit and others write millimetres), give prior.dense.depth_scale (units of a metre in "
    ".png files), or prior.dense.kind=up_to_scale"
)


@dataclass(frozen=True, kw_only=True)
class DepthFilesConfig(MonocularConfig):
    """Depths in files."""

    folder: str  # of the files, or the one file of all frames
    depth_scale: float = number(1000.0, low=1e-3, high=1e6)  # units of a metre in 16-bit .png files of metric depths


class DepthFiles(NamedTuple):
    """What a folder holds."""

    files: Sequence[Path]
    names: Sequence[str]  # of each frame's file without its suffix; numbers where one file has all
    read: Callable[[int], np.ndarray]  # values (gh, gw) of one, NaN where there are none


def way_of_files(config: DepthFilesConfig) -> Way:
    """Depth that is read from files; ValueError if there are none, or they cannot be read."""
    folder = Path(config.folder).expanduser()
    found = open_depths(folder, config.kind, check_depth_scale(config.depth_scale, "prior.dense.depth_scale"))

    def check(dataset: Dataset) -> None:
        values = _reader(dataset, found, folder)(0)
        if config.kind == "metric" and np.isfinite(values).any():
            check_metres(float(np.nanmedian(values)), str(found.files[0]), IN_METRES)

    def begin(scene: Scene) -> tuple[Depths, Sequence[Scale | None]]:
        read = _reader(scene.dataset, found, folder)

        def values(frame: int) -> np.ndarray:
            return rectify(read(frame), scene.lens(scene.newest().world[frame]))

        return begin_monocular(scene, values, config)

    root = folder if folder.is_dir() else folder.parent
    return Way(begin, check, needs_all=True, contents={"fingerprint": fingerprint(root, found.files, {})})


def open_depths(folder: Path, kind: str, depth_scale: float) -> DepthFiles:
    in_folder = (found for suffix in SUFFIXES if (found := files_of(folder, suffix)))
    paths = [folder] if folder.is_file() else next(in_folder, [])
    if not paths or paths[0].suffix not in SUFFIXES:
        below = sorted(path.name for path in folder.glob("*/") if path.is_dir())
        remedy = f"; it has the folders {', '.join(below[:5])}: give one of them" if below else ""
        raise ValueError(f"prior.dense.folder={folder} has no file *{', *'.join(SUFFIXES)}{remedy}")
    load = {
        ".npz": _load_npz,
        ".npy": load_npy,
        ".pfm": partial(decode, flags=cv2.IMREAD_UNCHANGED),
        ".exr": load_exr,
        ".png": partial(_load_png, kind=kind, depth_scale=depth_scale),
    }[paths[0].suffix]
    if len(paths) > 1:
        return DepthFiles(paths, [path.stem for path in paths], lambda row: _image(load(paths[row]), kind, paths[row]))
    stack = np.asarray(load(paths[0]))
    stack = stack.squeeze() if stack.ndim > 3 else stack
    if stack.ndim != 3 or stack.dtype.kind not in "fui":
        raise ValueError(f"{paths[0]} must be depths (frames, h, w) of all frames, got {stack.shape}")
    return DepthFiles(paths, [f"{row}" for row in range(len(stack))], lambda row: _image(stack[row], kind, paths[0]))


def _load_npz(path: Path) -> np.ndarray:
    """The only array of an .npz, or the first of `KEYS`."""
    names = names_in(path)
    key = names[0] if len(names) == 1 else next((key for key in KEYS if key in names), None)
    if names and key is None:
        raise ValueError(f"{path} has {', '.join(names)}: name the depths one of {', '.join(KEYS)}")
    return load_npz(path, names=(key or KEYS[0],))[key or KEYS[0]]


def _load_png(path: Path, kind: str, depth_scale: float) -> np.ndarray:
    raw = decode(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim == 3 and (raw[..., :3] != raw[..., :1]).any():
        raise ValueError(
            f"{path} is a coloured picture of depth, from which values cannot be read: let the program write values "
            "(--grayscale --pred-only, --save_npz, .npy)"
        )
    raw = np.float32(raw[..., 0] if raw.ndim == 3 else raw)
    return raw / np.float32(depth_scale) if kind == "metric" else raw


def _image(values: np.ndarray, kind: str, path: Path) -> np.ndarray:
    """Values (h, w), float32; NaN where they are not finite, or a depth is not above 0."""
    values = np.squeeze(values)
    if values.ndim != 2 or values.dtype.kind not in "fui" or min(values.shape) < 2:
        raise ValueError(f"{path} must be depths (h, w), got {values.dtype} {values.shape}")
    values = np.float32(values)
    is_known = np.isfinite(values) & ((values > 0) | (kind not in ("metric", "up_to_scale")))
    return np.where(is_known, values, np.float32(np.nan))


def _reader(dataset: Dataset, found: DepthFiles, folder: Path) -> Callable[[int], np.ndarray]:
    """Return a function that reads the values of a frame at its pixels."""
    rows = [row for row in rows_of(dataset, found.names, folder) if row is not None]
    size = dataset.size[0], dataset.size[1]
    camera = Camera(size, dataset.intrinsics)

    def read(frame: int) -> np.ndarray:
        values = found.read(rows[frame])
        whole_image(camera, View(f"{found.files[min(rows[frame], len(found.files) - 1)]}", values))
        # Where the file has a value for every pixel, no values are mixed across a depth edge.
        is_coarse, stored = values.shape[1] < size[0], dataset.stored_pixels(frame)
        if stored is None:
            return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR if is_coarse else cv2.INTER_NEAREST_EXACT)
        x, y = np.moveaxis(stored * np.float32(values.shape[1::-1]) - np.float32(0.5), -1, 0)
        way = cv2.INTER_LINEAR if is_coarse else cv2.INTER_NEAREST
        return cv2.remap(values, x, y, way, borderMode=cv2.BORDER_REPLICATE)

    return read
