"""Calibration files of other programs: what camera a file is of, in OpenCV's terms and pixels.

Our pixel centres are at integers, as OpenCV's; COLMAP and nerfstudio count from the corner, so .5 is taken off.
"""

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError
from emgs_jax.data.reading import Intrinsics, Size
from emgs_jax.data.transforms_json import with_angle_of_view, with_frames_camera

KNOWN_FILES = (
    "COLMAP cameras.txt, nerfstudio transforms.json, OpenCV or ROS YAML (camera_matrix), ORB-SLAM YAML (Camera.fx), "
    "MASt3R-SLAM intrinsics.yaml (width, height, calibration) or JSON with width, height, fx, fy, cx, cy"
)
DISTORTION = ("k1", "k2", "p1", "p2", "k3")  # OpenCV's order
# Parameters of COLMAP's models: f is both focal lengths, k is k1.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
# What stands in such files beside the camera.
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
TRANSFORMS_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


@dataclass(frozen=True)
class Calibration:
    """A camera.

    Args:
        intrinsics: fx, fy, cx, cy of the images on disk, pixel centres at integers.
        distortion: k1, k2, p1, p2 and maybe k3 (OpenCV's model); empty for a pinhole camera.
        size: (width, height) of the images that it is for; None where nothing says.
    """

    intrinsics: Intrinsics
    distortion: tuple[float, ...] = ()
    size: Size | None = None


def read_calibration(path: Path) -> Calibration:
    """The camera in a file of one of the KNOWN_FILES.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another format, a model without an OpenCV equivalent here, an unknown, missing or senseless value.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        raise ValueError(f"{path} is binary: colmap model_converter --output_type TXT writes cameras.txt")
    if suffix not in (".txt", ".json", ".yaml", ".yml"):
        raise ValueError(f"{path} is none of the calibration files that are known: {KNOWN_FILES}")
    try:
        text = reading.read_text(path)
    except BadFrameError as error:
        raise FileNotFoundError(f"dataset.intrinsics: {path} cannot be read; it may be {KNOWN_FILES}") from error
    if suffix == ".txt":
        return _colmap(text, path)
    values = parse_keys(text, path)
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
    raise ValueError(f"{path} has none of the keys fl_x, camera_matrix, calibration, Camera.fx, fx: give {KNOWN_FILES}")


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def parse_keys(text: str, path: Path) -> dict[str, Any]:
    """The keys and values of a JSON or YAML file."""
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


def _number(value: Any, key: str, path: Path) -> float:
    """A finite number, which YAML may have left as text (1e-3 without a point)."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{path}: {key} must be a finite number, got {str(value)[:80]!r}: correct it")
    return number


def needed(values: Mapping[str, Any], keys: Collection[str], path: Path) -> list[float]:
    """The numbers at `keys`, which must be there."""
    missing = [key for key in keys if key not in values]
    if missing:
        raise ValueError(f"{path} has no {', '.join(missing)}: add what is missing, in pixels of the images on disk")
    return [_number(values[key], key, path) for key in keys]


def _check_known(values: Mapping[str, Any], known: Collection[str], path: Path) -> None:
    """No key that might change the camera goes unread."""
    unknown = sorted({str(key) for key in values} - set(known))
    if unknown:
        raise ValueError(
            f"{path} has unknown keys: {', '.join(unknown)}; known are {', '.join(sorted(known))}: "
            "remove them if they say nothing about the lens, else give dataset.intrinsics as numbers"
        )


def size_of(width: float, height: float, path: Path) -> Size:
    if min(width, height) < 1 or width != int(width) or height != int(height):
        raise ValueError(f"{path}: width and height must be pixels, got {width:g} and {height:g}: correct them")
    return int(width), int(height)


def lens_of(coefficients: list[float], path: Path) -> tuple[float, ...]:
    """k1, k2, p1, p2 and maybe k3; empty where all are 0. What OpenCV's longer models add must be 0."""
    if len(coefficients) not in (0, 4, 5, 8, 12, 14) or any(coefficients[5:]):
        raise ValueError(
            f"{path}: {len(coefficients)} distortion coefficients are no k1, k2, p1, p2(, k3): calibrate with these"
        )
    return tuple(coefficients[:5]) if any(coefficients) else ()


def refuse_model(model: object, known: Collection[str], path: Path) -> None:
    raise ValueError(
        f"{path}: the camera model {model} is not read, only {', '.join(known)}: undistort the images with the program "
        "that calibrated them (colmap image_undistorter) and give the new calibration"
    )


def _colmap(text: str, path: Path) -> Calibration:
    """CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], one line a camera; several lines must be of the same camera."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or min(map(len, lines)) < 5:
        raise ValueError(f"{path} must have lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS, as COLMAP's cameras.txt")
    if len({tuple(line[1:]) for line in lines}) > 1:
        raise ValueError(f"{path} has {len(lines)} different cameras: leave the line of the one that took the images")
    return colmap_camera(lines[0][1:], path)


def colmap_camera(words: list[str], path: Path) -> Calibration:
    """The camera of the words MODEL WIDTH HEIGHT PARAMS; raises ValueError where they are of another model."""
    model, *words = words
    if model not in COLMAP_MODELS:
        refuse_model(model, COLMAP_MODELS, path)
    names = COLMAP_MODELS[model]
    if len(words) != 2 + len(names):
        raise ValueError(f"{path}: {model} has the parameters {', '.join(names)}, got {len(words) - 2}: correct them")
    width, height, *numbers = (
        _number(word, name, path) for word, name in zip(words, ("width", "height", *names), strict=True)
    )
    values = dict(zip(names, numbers, strict=True))
    intrinsics = _from_corner(values.get("fx", values.get("f")), values.get("fy", values.get("f")), values)
    bent = [values.get(key, 0.0) for key in DISTORTION[:4]]
    return Calibration(intrinsics, lens_of(bent, path), size_of(width, height, path))


def _from_corner(fx: float, fy: float, values: Mapping[str, float]) -> Intrinsics:
    """Intrinsics of a program for which the corner of the image is 0, 0."""
    return fx, fy, values["cx"] - 0.5, values["cy"] - 0.5


def _transforms(values: Mapping[str, Any], path: Path) -> Calibration:
    """nerfstudio: one camera for all frames."""
    camera = {"fl_x", "fl_y", "cx", "cy", "w", "h", *DISTORTION, "k4"}
    values = with_angle_of_view(with_frames_camera(values, camera | {"camera_model"}, path), path)
    _check_known(values, camera | TRANSFORMS_KEYS, path)
    model = values.get("camera_model", "OPENCV")
    if model not in TRANSFORMS_MODELS or values.get("is_fisheye"):
        refuse_model("OPENCV_FISHEYE" if values.get("is_fisheye") else model, TRANSFORMS_MODELS, path)
    fx, fy, cx, cy, width, height = needed(values, ("fl_x", "fl_y", "cx", "cy", "w", "h"), path)
    bent = [_number(values.get(key, 0), key, path) for key in DISTORTION]
    if _number(values.get("k4", 0), "k4", path) != 0:
        refuse_model("with k4", TRANSFORMS_MODELS, path)
    return Calibration(
        _from_corner(fx, fy, {"cx": cx, "cy": cy}), lens_of(_short(bent), path), size_of(width, height, path)
    )


def _short(coefficients: list[float]) -> list[float]:
    """Without a k3 of 0."""
    return coefficients if coefficients[4] else coefficients[:4]


def _opencv(values: Mapping[str, Any], path: Path) -> Calibration:
    """OpenCV's calibration sample and ROS' camera_info."""
    known = {"image_width", "image_height", "camera_matrix", "distortion_coefficients"}
    _check_known(values, known | OPENCV_KEYS, path)
    model = str(values.get("distortion_model", "plumb_bob"))
    if model not in ("plumb_bob", "radtan") or values.get("fisheye_model"):
        refuse_model("fisheye" if values.get("fisheye_model") else model, ("plumb_bob", "radtan"), path)
    width, height = needed(values, ("image_width", "image_height"), path)
    K = numbers_of(values["camera_matrix"], "camera_matrix", path)
    if len(K) != 9 or any(K[i] != 0 for i in (1, 3, 6, 7)) or K[8] != 1:
        raise ValueError(f"{path}: camera_matrix must be fx 0 cx, 0 fy cy, 0 0 1, got {K}: correct it")
    if "distortion_coefficients" not in values:
        raise ValueError(f"{path} has no distortion_coefficients: add them, data: [0, 0, 0, 0] for straight images")
    bent = numbers_of(values["distortion_coefficients"], "distortion_coefficients", path)
    return Calibration((K[0], K[4], K[2], K[5]), lens_of(bent, path), size_of(width, height, path))


def numbers_of(value: Any, key: str, path: Path) -> list[float]:
    """The numbers of a matrix, {rows, cols, data} or nested lists, row by row."""
    data = value.get("data") if isinstance(value, dict) else value
    if not isinstance(data, list):
        raise ValueError(f"{path}: {key} must have data: [numbers]: correct it")
    rows = [item if isinstance(item, list) else [item] for item in data]
    return [_number(item, key, path) for row in rows for item in row]


def _mast3r_slam(values: Mapping[str, Any], path: Path) -> Calibration:
    """width, height, calibration: [fx, fy, cx, cy(, k1, k2, p1, p2(, k3))]."""
    _check_known(values, {"width", "height", "calibration"}, path)
    width, height = needed(values, ("width", "height"), path)
    numbers = numbers_of(values["calibration"], "calibration", path)
    if len(numbers) not in (4, 8, 9):
        raise ValueError(
            f"{path}: calibration must be fx, fy, cx, cy(, k1, k2, p1, p2(, k3)), got {len(numbers)}: correct it"
        )
    fx, fy, cx, cy, *bent = numbers
    return Calibration((fx, fy, cx, cy), lens_of(bent, path), size_of(width, height, path))


def _orb_slam(values: Mapping[str, Any], path: Path) -> Calibration:
    """Camera.fx … of ORB-SLAM2, Camera1.fx … of ORB-SLAM3; OpenVSLAM has Camera.model, cols and rows."""
    section = "Camera1" if "Camera1.fx" in values else "Camera"
    strange = {key for key in values if str(key).split(".")[0] not in (*ORB_SECTIONS, "Camera1")}
    if "Camera2.fx" in values or strange:
        found = ", ".join(sorted(map(str, strange))) or "a second camera"
        raise ValueError(f"{path} has more than one camera's keys: {found}; remove what says nothing about the lens")
    for model in (values.get("Camera.type", "PinHole"), values.get("Camera.model", "perspective")):
        if str(model).lower() not in ("pinhole", "perspective"):
            refuse_model(model, ("PinHole", "perspective"), path)
    values = {"Camera.width": values.get("Camera.cols"), "Camera.height": values.get("Camera.rows")} | dict(values)
    values = {key: value for key, value in values.items() if value is not None}
    names = [f"{section}.{key}" for key in ("fx", "fy", "cx", "cy")]
    fx, fy, cx, cy, width, height = needed(values, [*names, "Camera.width", "Camera.height"], path)
    bent = [_number(values.get(f"{section}.{key}", 0), f"{section}.{key}", path) for key in DISTORTION]
    return Calibration((fx, fy, cx, cy), lens_of(_short(bent), path), size_of(width, height, path))


def _plain(values: Mapping[str, Any], path: Path) -> Calibration:
    """width, height, fx, fy, cx, cy as ViPE takes them, and maybe the distortion."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    _check_known(values, {*names, *DISTORTION}, path)
    width, height, fx, fy, cx, cy = needed(values, names, path)
    bent = [_number(values.get(key, 0), key, path) for key in DISTORTION]
    return Calibration((fx, fy, cx, cy), lens_of(_short(bent), path), size_of(width, height, path))
