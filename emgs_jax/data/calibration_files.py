"""Read calibration files of other programs; pixel centres at integers.

COLMAP and nerfstudio count from the image's corner, so .5 is subtracted.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.camera_models import Calibration, as_number, lens_of, named_lens, refuse_model, size_of
from emgs_jax.data.colmap_model import load_cameras
from emgs_jax.data.transforms_json import frames_of, with_angle_of_view, with_frames_camera

KNOWN_FILES = (
    "COLMAP cameras.txt or .bin, nerfstudio transforms.json, OpenCV or ROS YAML (camera_matrix), ORB-SLAM YAML "
    "(Camera.fx), Kalibr's camchain.yaml or EuRoC's sensor.yaml (distortion_model, resolution), MASt3R-SLAM "
    "intrinsics.yaml (width, height, calibration) or JSON with width, height, fx, fy, cx, cy"
)
COEFFICIENTS = {"OPENCV": ("k1", "k2", "p1", "p2", "k3"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4")  # keys of both
# Keys in such files beside those of the camera.
TRANSFORMS_KEYS = {
    *("frames", "ply_file_path", "applied_transform", "applied_scale", "orientation_override", "aabb_scale", "aabb"),
    *("auto_scale_poses_override", "train_filenames", "val_filenames", "test_filenames", "depth_unit_scale_factor"),
    *("camera_angle_x", "camera_angle_y", "scale", "offset", "up", "sharpness", "fps", "camera_model", "is_fisheye"),
}
OPENCV_KEYS = {
    *("calibration_time", "nframes", "nr_of_frames", "board_width", "board_height", "square_size", "marker_size"),
    *("flags", "aspectRatio", "fix_aspect_ratio", "avg_reprojection_error", "per_view_reprojection_errors"),
    *("extrinsic_parameters", "image_points", "grid_points", "fisheye_model", "camera_name", "distortion_model"),
    *("rectification_matrix", "projection_matrix", "local_transform"),
}
ORB_SECTIONS = (
    *("Camera", "ORBextractor", "Viewer", "File", "System", "IMU", "Stereo", "RGBD", "loopClosing"),
    *("DepthMapFactor", "ThDepth", "Feature", "Mapping", "PangolinViewer", "Tracking"),
)
ORB_MODELS = {
    **dict.fromkeys(("pinhole", "perspective"), "OPENCV"),
    **dict.fromkeys(("kannalabrandt8", "fisheye"), "OPENCV_FISHEYE"),
}
_OF_FRAMES = {"fl_x", "fl_y", "cx", "cy", "w", "h", *DISTORTION, "camera_model", "is_fisheye"}
TRANSFORMS_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "OPENCV_FISHEYE")


def read_calibration(path: Path) -> Calibration:
    """Read the camera of one of the KNOWN_FILES.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another format or camera model, or an unknown, missing or senseless value.
    """
    suffix = path.suffix.lower()
    if suffix not in (".txt", ".bin", ".json", ".yaml", ".yml"):
        raise ValueError(f"{path} is none of the calibration files that are known: {KNOWN_FILES}")
    try:
        if suffix in (".txt", ".bin"):
            return _only([*load_cameras(path).values()], path)
        values = parse_keys(reading.read_text(path), path)
    except BadFrameError as error:
        raise FileNotFoundError(f"dataset.intrinsics: {path} cannot be read; it may be {KNOWN_FILES}") from error
    if "fl_x" in values or "frames" in values:
        return _transforms(values, path)
    if "camera_matrix" in values:
        return _opencv(values, path)
    if "calibration" in values:
        return _mast3r_slam(values, path)
    if any(str(key).startswith(("Camera.", "Camera1.")) for key in values):
        return _orb_slam(values, path)
    if "fx" in values:
        return _plain(values, path)
    chain = [camera for key, camera in values.items() if str(key).startswith("cam") and isinstance(camera, dict)]
    if chain or "distortion_model" in values:
        return _only([kalibr_camera(camera, path) for camera in chain or [values]], path)
    raise ValueError(f"{path} has none of the keys of a camera: give {KNOWN_FILES}")


def _only(cameras: list[Calibration], path: Path) -> Calibration:
    """The only camera of a file, which may list it several times."""
    if not cameras:
        raise ValueError(f"{path} must have lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS, as COLMAP's cameras.txt")
    if len({*cameras}) > 1:
        raise ValueError(f"{path} has {len({*cameras})} different cameras: leave that of the one that took the images")
    return cameras[0]


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def parse_keys(text: str, path: Path) -> dict[str, Any]:
    try:
        if path.suffix.lower() == ".json":
            values = json.loads(text)
        else:
            lines = text.splitlines()  # OpenCV's first line, %YAML:1.0, is no YAML
            values = yaml.load("\n".join(lines[1:] if lines and lines[0].startswith("%YAML") else lines), _Loader)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{path} is damaged or no {path.suffix[1:]}: {error}") from error
    if not isinstance(values, dict):
        raise ValueError(f"{path} must hold keys and values: {KNOWN_FILES}")
    return values


def needed(values: Mapping[str, Any], keys: Collection[str], path: Path) -> list[float]:
    """The numbers at `keys`, which must exist."""
    missing = [key for key in keys if key not in values]
    if missing:
        raise ValueError(f"{path} has no {', '.join(missing)}: add what is missing, in pixels of the images on disk")
    return [as_number(values[key], key, path) for key in keys]


def _check_known(values: Mapping[str, Any], known: Collection[str], path: Path) -> None:
    """Raise ValueError for unknown keys, which might change the camera."""
    unknown = sorted({str(key) for key in values} - set(known))
    if unknown:
        raise ValueError(
            f"{path} has unknown keys: {', '.join(unknown)}; known are {', '.join(sorted(known))}: "
            "remove them if they say nothing about the lens, else give dataset.intrinsics as numbers"
        )


def _lens(values: Mapping[str, Any], model: str, path: Path, before: str = "") -> tuple[float, ...]:
    """The distortion at the keys k1, k2, …, 0 if missing; ValueError if one belongs to another model."""
    found = {key: as_number(values.get(before + key, 0), before + key, path) for key in DISTORTION}
    if foreign := [key for key in found if found[key] and key not in COEFFICIENTS[model]]:
        refuse_model(f"{model} with {', '.join(foreign)}", [*COEFFICIENTS], path)
    bent = [found[key] for key in COEFFICIENTS[model]]
    return lens_of(model, bent if model != "OPENCV" or bent[4] else bent[:4], path)


def _camera(values: Mapping[str, Any], names: Sequence[str], path: Path, model="OPENCV", before="", corner=0.0):
    """The camera with fx, fy, cx, cy, width, height at the keys `names`; the first pixel's centre is at `corner`."""
    fx, fy, cx, cy, width, height = needed(values, names, path)
    lens = _lens(values, model, path, before)
    return Calibration((fx, fy, cx - corner, cy - corner), lens, size_of(width, height, path), model)


def _transforms(values: Mapping[str, Any], path: Path) -> Calibration:
    """Nerfstudio, with one camera for all frames."""
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    camera = {*names, *DISTORTION}
    values = with_frames_camera(values, _OF_FRAMES, path)
    values = with_angle_of_view(values, path)
    _check_known(values, camera | TRANSFORMS_KEYS, path)
    model = "OPENCV_FISHEYE" if values.get("is_fisheye") else values.get("camera_model", "OPENCV")
    if model not in TRANSFORMS_MODELS:
        refuse_model(model, TRANSFORMS_MODELS, path)
    return _camera(values, names, path, model if model in COEFFICIENTS else "OPENCV", corner=0.5)


def read_cameras(path: Path) -> list[Calibration]:
    """The camera of each frame of nerfstudio's transforms.json; raises as `read_calibration`."""
    values, found = parse_keys(reading.read_text(path), path), {}
    frames = frames_of(values)
    own = [tuple(sorted((key, str(frame[key])) for key in _OF_FRAMES & frame.keys())) for frame in frames]
    for key, frame in zip(own, frames, strict=True):
        if key not in found:
            found[key] = _transforms({**values, "frames": [frame]}, path)
    return [found[key] for key in own]


def _opencv(values: Mapping[str, Any], path: Path) -> Calibration:
    """OpenCV's calibration sample and ROS' camera_info."""
    known = {"image_width", "image_height", "camera_matrix", "distortion_coefficients"}
    _check_known(values, known | OPENCV_KEYS, path)
    model = "fisheye" if values.get("fisheye_model") else values.get("distortion_model", "plumb_bob")
    width, height = needed(values, ("image_width", "image_height"), path)
    K = numbers_of(values["camera_matrix"], "camera_matrix", path)
    if len(K) != 9 or any(K[i] != 0 for i in (1, 3, 6, 7)) or K[8] != 1:
        raise ValueError(f"{path}: camera_matrix must be fx 0 cx, 0 fy cy, 0 0 1, got {K}: correct it")
    if "distortion_coefficients" not in values:
        raise ValueError(f"{path} has no distortion_coefficients: add them, data: [0, 0, 0, 0] for straight images")
    bent = numbers_of(values["distortion_coefficients"], "distortion_coefficients", path)
    lens, model = named_lens(model, bent, path)
    return Calibration((K[0], K[4], K[2], K[5]), lens, size_of(width, height, path), model)


def kalibr_camera(values: Mapping[str, Any], path: Path) -> Calibration:
    """A camera of Kalibr's camchain.yaml, or EuRoC's sensor.yaml: a pinhole camera behind a lens."""
    key = next((key for key in ("distortion_coeffs", "distortion_coefficients") if key in values), None)
    if missing := [name for name in ("intrinsics", "resolution", "distortion_model") if name not in values]:
        raise ValueError(f"{path} has no {', '.join(missing)}: add what is missing, in pixels of the images on disk")
    if values.get("camera_model", "pinhole") != "pinhole":
        refuse_model(values["camera_model"], ("pinhole",), path)
    intrinsics, size = (numbers_of(values[name], name, path) for name in ("intrinsics", "resolution"))
    if len(intrinsics) != 4 or len(size) != 2:
        raise ValueError(f"{path}: intrinsics must be fx, fy, cx, cy and resolution width, height: correct them")
    bent = [] if key is None else numbers_of(values[key], key, path)
    lens, model = named_lens(values["distortion_model"], bent, path)
    return Calibration((*intrinsics,), lens, size_of(*size, path), model)


def numbers_of(value: Any, key: str, path: Path) -> list[float]:
    """The numbers of a matrix, {rows, cols, data} or nested lists, by rows."""
    data = value.get("data") if isinstance(value, dict) else value
    if not isinstance(data, list):
        raise ValueError(f"{path}: {key} must have data: [numbers]: correct it")
    rows = [item if isinstance(item, list) else [item] for item in data]
    return [as_number(item, key, path) for row in rows for item in row]


def _mast3r_slam(values: Mapping[str, Any], path: Path) -> Calibration:
    """MASt3R-SLAM: width, height, calibration: [fx, fy, cx, cy(, k1, k2, p1, p2(, k3))]."""
    _check_known(values, {"width", "height", "calibration"}, path)
    width, height = needed(values, ("width", "height"), path)
    numbers = numbers_of(values["calibration"], "calibration", path)
    if len(numbers) not in (4, 8, 9):
        raise ValueError(f"{path}: calibration must be fx, fy, cx, cy(, k1, k2, p1, p2(, k3)), got {len(numbers)}")
    fx, fy, cx, cy, *bent = numbers
    return Calibration((fx, fy, cx, cy), lens_of("OPENCV", bent, path), size_of(width, height, path))


def _orb_slam(values: Mapping[str, Any], path: Path) -> Calibration:
    """Camera.fx … of ORB-SLAM2, Camera1.fx … of ORB-SLAM3; OpenVSLAM has Camera.model, cols and rows."""
    section = "Camera1" if "Camera1.fx" in values else "Camera"
    strange = {key for key in values if str(key).split(".")[0] not in (*ORB_SECTIONS, "Camera1")}
    if "Camera2.fx" in values or strange:
        found = ", ".join(sorted(map(str, strange))) or "a second camera"
        raise ValueError(f"{path} has more than one camera's keys: {found}; remove what says nothing about the lens")
    name = values.get("Camera.model", values.get("Camera.type", "PinHole"))
    model = ORB_MODELS.get(str(name).lower()) or refuse_model(name, [*ORB_MODELS], path)
    values = {"Camera.width": values.get("Camera.cols"), "Camera.height": values.get("Camera.rows")} | dict(values)
    values = {key: value for key, value in values.items() if value is not None}
    names = *(f"{section}.{key}" for key in ("fx", "fy", "cx", "cy")), "Camera.width", "Camera.height"
    return _camera(values, names, path, model, f"{section}.")


def _plain(values: Mapping[str, Any], path: Path) -> Calibration:
    """ViPE: width, height, fx, fy, cx, cy, and maybe distortion."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    _check_known(values, {*names, *DISTORTION}, path)
    return _camera(values, names, path)
