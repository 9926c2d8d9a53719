"""Readers of what the demos of feed-forward networks write; names of arrays and conventions are those of their code."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from emgs_jax.prior.files.arrays import (
    as_intrinsics,
    as_poses,
    as_view,
    files_of,
    load_npy,
    load_npz,
    names_in,
)
from emgs_jax.prior.files.view import Camera, Part, Place, Predictions, View, grid_intrinsics, whole_image
from emgs_jax.prior.network.resize import plan_resize

PLACES = (".", "exports/npz", "exports/mini_npz")  # below the folder
FILES = ("results.npz", "predictions.npz")
PATCH = 14  # of VGGT's images, whose width is always 518


@dataclass(frozen=True)
class Export:
    """An .npz that holds all images of one inference.

    Args:
        depth, poses, intrinsics: names of the arrays (n, h, w) or (n, h, w, 1), (n, 3 or 4, 4) and (n, 3, 3).
        confidence, mask: likewise (n, h, w); they may be missing.
        needs: further arrays that tell it from others.
        is_inverted: poses are world -> camera.
        place: what of the image the network sees.
    """

    layout: str
    depth: str
    poses: str
    intrinsics: str
    confidence: str
    place: Place
    needs: tuple[str, ...] = ()
    mask: str = "final_mask"
    is_inverted: bool = True
    is_metric: bool = False


def vggt_place(camera: Camera, view: View) -> Part:
    """VGGT: the width becomes 518, the height whole patches, of which 518 in the middle are kept (mode crop).

    In mode pad the longer side becomes 518, and the image stands in the middle of a square. Where both are of this
    shape the focal length tells.
    """
    width, height = view.grid
    wide = Part((width, scaled := _patches(width / camera.aspect)), (0, (scaled - height) // 2))
    narrow = _patches(height * camera.aspect), height
    whole = (width, _patches(width / camera.aspect)) if camera.aspect >= 1 else narrow
    padded = Part(whole, (-((width - whole[0]) // 2), -((height - whole[1]) // 2)))
    fits = [wide] if abs(min(scaled, width) - height) <= PATCH else []
    fits += [padded] if width == height else []
    if not fits:
        raise ValueError(
            f"{view.source} is {width}x{height}, and of images {camera.aspect:.3f} times as wide as high VGGT has "
            f"{width}x{min(scaled, width)}: predict from the images as they are shown (EXIF may turn them: save them "
            "upright)"
        )
    if view.intrinsics is None:
        return fits[0]
    focal = [grid_intrinsics(camera, part)[0] for part in fits]
    return fits[int(np.argmin(np.abs(np.log(np.divide(focal, view.intrinsics[0])))))]


def _patches(side: float) -> int:
    return round(side / PATCH) * PATCH


def mapanything_crop(camera: Camera, view: View) -> Part:
    """MapAnything: the image is scaled until it covers the grid, of which it shows the middle."""
    resize = plan_resize((round(camera.aspect * 10000), 10000), view.grid)
    return Part(resize.scaled, resize.corner)


def dust3r_crop(camera: Camera, view: View) -> Part:
    """DUSt3R and what follows it: the longer side becomes that of the grid, of the rest the middle is kept."""
    (width, height), aspect = view.grid, camera.aspect
    scaled = (width, round(width / aspect)) if aspect >= 1 else (round(height * aspect), height)
    return Part(scaled, (scaled[0] // 2 - width // 2, scaled[1] // 2 - height // 2))


EXPORTS = (
    Export(
        *("MapAnything", "depth", "extrinsic", "intrinsic", "conf", mapanything_crop),
        needs=("final_mask",),
        is_inverted=False,
        is_metric=True,
    ),
    Export("VGGT", "depth", "extrinsic", "intrinsic", "depth_conf", vggt_place, needs=("pose_enc",)),
    Export("Depth Anything 3", "depth", "extrinsics", "intrinsics", "conf", whole_image),
    Export("Depth Anything 3", "depths", "extrinsics", "intrinsics", "conf", whole_image),
)


def find_export(folder: Path) -> Path | None:
    """The .npz with all images that a folder holds or is."""
    if folder.suffix == ".npz":
        return folder
    return next((path for place in PLACES for name in FILES if (path := folder / place / name).is_file()), None)


def read_export(path: Path) -> Predictions:
    """An .npz of one of EXPORTS; ValueError where it is of none, or its arrays do not fit each other."""
    there = names_in(path)
    kinds = [e for e in EXPORTS if {e.depth, e.poses, e.intrinsics, *e.needs} <= {*there}]
    if not kinds:
        known = "; ".join(f"{e.layout}: {', '.join((e.depth, e.poses, e.intrinsics, *e.needs))}" for e in EXPORTS)
        raise ValueError(f"{path} has {', '.join(there) or 'no arrays'}, and known are {known}")
    kind = kinds[0]
    cameras = load_npz(path, (kind.poses, kind.intrinsics))
    is_batch = cameras[kind.poses].ndim == 4 and len(cameras[kind.poses]) == 1  # as a network returns one scene
    cameras = {name: array[0] for name, array in cameras.items()} if is_batch else cameras
    poses = as_poses(cameras[kind.poses], f"{path}: {kind.poses}")
    poses = np.linalg.inv(poses) if kind.is_inverted else poses
    count = len(poses)

    @cache  # all images are one array
    def dense() -> dict[str, np.ndarray]:
        arrays = load_npz(path, (kind.depth,), (kind.confidence, kind.mask))
        arrays = {name: array[0] for name, array in arrays.items()} if is_batch else arrays
        for name, array in (arrays | {kind.intrinsics: cameras[kind.intrinsics]}).items():
            sides = 1 if name == kind.intrinsics else 3
            if array.shape[:sides] != (count, *arrays[kind.depth].shape[1:sides]) or array.ndim < 3:
                raise ValueError(f"{path}: {name} is {array.shape}, with {count} {kind.poses}: predict them again")
        return arrays

    def read(row: int) -> View:
        arrays, where = dense(), f"{path}: {kind.depth}, row {row},"
        depth, confidence = arrays[kind.depth][row], arrays.get(kind.confidence)
        if kind.mask in arrays:
            depth = np.where(arrays[kind.mask][row].reshape(depth.shape), depth, 0)
        found = None if confidence is None else np.maximum(confidence[row], 1)  # some are rounded
        return as_view(where, depth, found, as_intrinsics(cameras[kind.intrinsics][row], f"{path}: {kind.intrinsics}"))

    names = [f"row {row}" for row in range(count)]
    source = f"{path}: {kind.poses}"
    return Predictions(kind.layout, names, poses, source, read, [path], kind.is_metric, kind.place)


def read_cut3r(folder: Path) -> Predictions:
    """Read the output of CUT3R's demo: depth/N.npy, conf/N.npy and camera/N.npz with pose and intrinsics."""
    cameras = files_of(folder / "camera", ".npz")
    poses = [as_poses(load_npz(path, ("pose",))["pose"][None], f"{path}: pose") for path in cameras]

    def read(row: int) -> View:
        path, name = cameras[row], f"{cameras[row].stem}.npy"
        intrinsics = as_intrinsics(load_npz(path, ("intrinsics",))["intrinsics"], f"{path}: intrinsics")
        confidence = np.maximum(load_npy(folder / "conf" / name), 1)
        return as_view(str(folder / "depth" / name), load_npy(folder / "depth" / name), confidence, intrinsics)

    files = [*cameras, *(folder / kind / f"{path.stem}.npy" for path in cameras for kind in ("depth", "conf"))]
    names, source = [path.stem for path in cameras], f"{folder}/camera/*.npz: pose"
    return Predictions("CUT3R", names, np.concatenate(poses), source, read, files, False, dust3r_crop)
