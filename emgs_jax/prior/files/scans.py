"""Depths of sensors and of COLMAP, in the folders that their programs write; all said here is read from their code."""

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
    load_numbers,
)
from emgs_jax.prior.files.view import Predictions, View, by_rays, whole_image

SCANNET_UNITS = 1000.0  # per metre, in the 16-bit images that SensReader extracts
DEPTH_MAPS = Path("stereo") / "depth_maps"
COLMAP_KINDS = (".geometric.bin", ".photometric.bin")  # the first that is there is read


def read_colmap_workspace(folder: Path) -> Predictions:
    """`dense/` of `colmap patch_match_stereo`: stereo/depth_maps/IMAGE.geometric.bin and the sparse model."""
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

    names, used = [Path(model.names[row]).stem for row in rows], [paths[row] for row in rows]
    poses = as_poses(model.T_world_camera[rows], str(model.files[1]))
    files = [*used, *model.files]
    return Predictions("COLMAP", names, poses, str(model.files[1]), read, files, False, whole_image, may_lack=True)


def load_colmap_array(path: Path) -> np.ndarray:
    """A depth map of COLMAP, float32 (h, w): `WIDTH&HEIGHT&1&`, then the rows, little endian; 0 = none."""
    data = path.read_bytes()
    words = data[:64].split(b"&", 3)
    try:
        width, height, channels = (int(word) for word in words[:3])
        values = np.frombuffer(data[sum(map(len, words[:3])) + 3 :], "<f4")
        if channels != 1 or len(words) < 4:
            raise ValueError(f"{channels} channels")
        return values.reshape(height, width)
    except ValueError as error:
        raise ValueError(f"{path} is no depth map of COLMAP ({error}): make it again") from error


def read_scannet(folder: Path) -> Predictions:
    """A scan that ScanNet's SensReader extracted: depth/N.png (mm), pose/N.txt, intrinsic/intrinsic_depth.txt."""
    paths = files_of(folder / "depth", ".png")
    calibration = folder / "intrinsic" / "intrinsic_depth.txt"
    intrinsics = as_intrinsics(load_numbers(calibration, (4, 4)), str(calibration))
    places = [folder / "pose" / f"{path.stem}.txt" for path in paths]
    poses = [as_poses(load_numbers(place, (1, 4, 4)), str(place)) for place in places]  # of -inf where lost

    def read(row: int) -> View:
        return as_view(str(paths[row]), read_depth(paths[row], SCANNET_UNITS), None, intrinsics)

    names, files = [path.stem for path in paths], [*paths, *places, calibration]
    return Predictions("ScanNet", names, np.concatenate(poses), f"{folder}/pose", read, files, True, by_rays)


def read_record3d(folder: Path) -> Predictions:
    """An export of Record3D as EXR + JPG: depth/N.exr (m), metadata.json with poses of ARKit's axes."""
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
