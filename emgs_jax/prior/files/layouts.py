"""Read predictions of other programs; names, units and conventions are those of their code."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.data.posed_images import find_model
from emgs_jax.data.reading import read_depth, resize_intrinsics
from emgs_jax.ops.constants import FLIP
from emgs_jax.prior.files.arrays import (
    as_intrinsics,
    as_poses,
    as_view,
    files_of,
    load_exr,
    load_json,
    load_npy,
    load_npz,
    load_numbers,
    names_in,
    reading,
)
from emgs_jax.prior.files.view import Camera, Part, Place, Predictions, View, by_rays, grid_intrinsics, whole_image
from emgs_jax.prior.network.resize import plan_resize

PLACES = (".", "exports/npz", "exports/mini_npz")  # below the folder
FILES = ("results.npz", "predictions.npz")
PATCH = 14  # of VGGT's images, whose width is always 518
SCANNET_UNITS = 1000.0  # per metre, in the 16-bit images that SensReader extracts
DEPTH_MAPS = Path("stereo") / "depth_maps"
STREAMED, STREAMED_POSES = "results_output", "camera_poses.txt"
COLMAP_KINDS = (".geometric.bin", ".photometric.bin")  # the first that exists is read


@dataclass(frozen=True)
class Export:
    """An .npz of all images of one inference: the names of its arrays."""

    layout: str
    depth: str  # (n, h, w) or (n, h, w, 1)
    poses: str  # (n, 3 or 4, 4)
    intrinsics: str  # (n, 3, 3)
    confidence: str  # (n, h, w), optional like `mask`
    place: Place  # the part of the image that the network sees
    needs: tuple[str, ...] = ()  # further arrays that distinguish it
    mask: str = "final_mask"
    is_inverted: bool = True  # poses are world -> camera
    is_metric: bool = False


def vggt_place(camera: Camera, view: View) -> Part:
    """VGGT: width 518 and a height of whole patches, cropped to the middle 518 (mode crop).

    In mode pad the longer side is 518, and the image is centred in a square. If both have this shape, the focal length
    decides.
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
    """MapAnything: the image is scaled to cover the grid, which shows its middle."""
    resize = plan_resize((round(camera.aspect * 10000), 10000), view.grid)
    return Part(resize.scaled, resize.corner)


def dust3r_crop(camera: Camera, view: View) -> Part:
    """DUSt3R and its successors: the longer side becomes the grid's, and the other is cropped to its middle."""
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
    """The .npz with all images, in a folder or itself; None without one."""
    if folder.suffix == ".npz":
        return folder
    return next((path for place in PLACES for name in FILES if (path := folder / place / name).is_file()), None)


def read_export(path: Path) -> Predictions:
    """Read an .npz of one of EXPORTS; ValueError if it is none, or its arrays do not fit."""
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

    names, source = [f"row {row}" for row in range(count)], f"{path}: {kind.poses}"
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


def find_streaming(folder: Path) -> Path | None:
    """The output folder of DA3-Streaming that a folder is, or whose `results_output` it is."""
    places = [folder, *([folder.parent] if folder.name == STREAMED else [])]
    return next((one for one in places if (one / STREAMED).is_dir() and (one / STREAMED_POSES).is_file()), None)


def read_da3_streaming(folder: Path) -> Predictions:
    """Read the output of DA3-Streaming: results_output/frame_N.npz of the images in order, and camera_poses.txt."""
    found, path = list((folder / STREAMED).glob("frame_*.npz")), folder / STREAMED_POSES
    paths = sorted(found, key=lambda file: int(file.stem.rpartition("_")[2]))
    poses = as_poses(load_numbers(path, (-1, 4, 4)), str(path))
    if len(poses) != len(paths):
        raise ValueError(f"{path} has {len(poses)} poses for {len(paths)} files of {folder / STREAMED}: predict again")

    def read(row: int) -> View:
        arrays, where = load_npz(paths[row], ("depth", "intrinsics"), ("conf",)), f"{paths[row]}: "
        confidence = arrays["conf"] + 1 if "conf" in arrays else None  # it counts from 0
        return as_view(f"{where}depth", arrays["depth"], confidence, as_intrinsics(arrays["intrinsics"], where))

    names = [f"row {row}" for row in range(len(paths))]
    return Predictions("DA3-Streaming", names, poses, str(path), read, [*paths, path], False, whole_image)


def read_colmap_workspace(folder: Path) -> Predictions:
    """Read `dense/` of `colmap patch_match_stereo`: stereo/depth_maps/IMAGE.geometric.bin and the sparse model."""
    model = find_model(folder, None)
    maps = folder / DEPTH_MAPS
    kind = next((kind for kind in COLMAP_KINDS if any(maps.rglob(f"*{kind}"))), COLMAP_KINDS[0])
    paths = [maps / f"{name}{kind}" for name in model.names]
    rows = [row for row, path in enumerate(paths) if path.is_file()]
    if not rows:
        raise ValueError(f"{maps} has no {model.names[0]}{' or '.join(COLMAP_KINDS)}: run colmap patch_match_stereo")
    cameras = [model.cameras[model.camera_ids[row]] for row in rows]
    if not all(camera.is_pinhole for camera in cameras):
        raise ValueError(f"{model.files[0]}: depth maps are of undistorted images: give the model of image_undistorter")

    def read(row: int) -> View:
        path, depth = paths[rows[row]], load_colmap_array(paths[rows[row]])
        camera = cameras[row]
        raw_size = camera.size or (depth.shape[1], depth.shape[0])
        return as_view(str(path), depth, None, resize_intrinsics(camera.intrinsics, raw_size, depth.shape[1::-1]))

    names, files = [Path(model.names[row]).stem for row in rows], [*(paths[row] for row in rows), *model.files]
    poses, source = as_poses(model.T_world_camera[rows], str(model.files[1])), str(model.files[1])
    return Predictions("COLMAP", names, poses, source, read, files, False, whole_image, may_lack=True, is_straight=True)


def load_colmap_array(path: Path) -> np.ndarray:
    """Read a depth map of COLMAP, float32 (h, w), 0 = none: `WIDTH&HEIGHT&1&`, then the rows, little endian."""
    with reading(path, "depth map of COLMAP"):
        width, height, _, values = path.read_bytes().split(b"&", 3)
        return np.frombuffer(values, "<f4").reshape(int(height), int(width))


def read_scannet(folder: Path) -> Predictions:
    """Read a scan of ScanNet's SensReader: depth/N.png (mm), pose/N.txt, intrinsic/intrinsic_depth.txt."""
    paths = files_of(folder / "depth", ".png")
    calibration = folder / "intrinsic" / "intrinsic_depth.txt"
    intrinsics = as_intrinsics(load_numbers(calibration, (4, 4)), str(calibration))
    places = [folder / "pose" / f"{path.stem}.txt" for path in paths]
    poses = [as_poses(load_numbers(place, (1, 4, 4)), str(place)) for place in places]  # of -inf where lost

    def read(row: int) -> View:
        return as_view(str(paths[row]), read_depth(paths[row], SCANNET_UNITS), None, intrinsics)

    names, files = [path.stem for path in paths], [*paths, *places, calibration]
    return Predictions(
        "ScanNet", names, np.concatenate(poses), f"{folder}/pose", read, files, True, by_rays, is_straight=True
    )


def read_record3d(folder: Path) -> Predictions:
    """Read an export of Record3D as EXR + JPG: depth/N.exr (m), metadata.json with poses in ARKit's axes."""
    paths, path = files_of(folder / "depth", ".exr"), folder / "metadata.json"
    about = load_json(path)
    try:
        rows = np.array(about["poses"], np.float64).reshape(-1, 7)
        matrix = np.array(about["K"], np.float64).reshape(3, 3).T
        raw_size = int(about["w"]), int(about["h"])
        turns = Rotation.from_quat(rows[:, :4]).as_matrix()
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must have poses, K, w and h as Record3D writes them ({error!r})") from error
    if len(rows) != len(paths):
        raise ValueError(f"{path} has {len(rows)} poses for {len(paths)} files of {folder / 'depth'}: export it again")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, rows[:, 4:]
    camera = as_intrinsics(matrix, f"{path}: K")

    def read(row: int) -> View:
        depth = load_exr(paths[row])
        return as_view(str(paths[row]), depth, None, resize_intrinsics(camera, raw_size, depth.shape[1::-1]))

    names = [file.stem for file in paths]
    poses = as_poses(poses * FLIP, f"{path}: poses")
    return Predictions("Record3D", names, poses, f"{path}: poses", read, [*paths, path], True, whole_image)
