"""Read nerfstudio's transforms.json: camera → world with OpenGL's axes, pixels from the image's corner."""

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.data import reading
from emgs_jax.data.file_names import find_image
from emgs_jax.ops.constants import FLIP


def load_transforms(path: Path) -> tuple[list[str], list[list[float]], list[str | None]]:
    """Read file, T_world_camera (16 numbers, OpenCV's axes) and mask of every frame; ValueError if it is damaged."""
    try:
        frames = json.loads(path.read_text(encoding="utf-8-sig", errors="replace"))["frames"]
        names = [frame["file_path"] for frame in frames]
        masks = [frame.get("mask_path") for frame in frames]
        matrices = [np.array(frame["transform_matrix"], np.float64) for frame in frames]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        what = "frames with file_path and transform_matrix"
        raise ValueError(f"{path} must hold {what}, and it does not ({error!r}): export it again") from error
    if not names:
        raise ValueError(f"{path} has no frames: export it again")
    for name, matrix in zip(names, matrices, strict=True):
        if not isinstance(name, str) or matrix.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"{path}: frame {name!r} must have a transform_matrix of 4 rows of 4: export it again")
    if len({*names}) < len(names):
        raise ValueError(f"{path} has {next(n for n in names if names.count(n) > 1)} twice: export it again")
    bottom = [[0.0, 0.0, 0.0, 1.0]]
    poses = [((m if len(m) == 4 else np.vstack([m, bottom])) * FLIP).ravel().tolist() for m in matrices]
    return names, poses, [None if mask is None else str(mask) for mask in masks]


def with_frames_camera(values: Mapping[str, Any], keys: Collection[str], path: Path) -> Mapping[str, Any]:
    """Add the camera that every frame has to `values`; ValueError if they differ."""
    found = [{key: frame[key] for key in keys & frame.keys()} for frame in frames_of(values)]
    whole = [{**{key: values[key] for key in keys & values.keys()}, **own} for own in found]
    for number, camera in enumerate(whole):
        if camera != whole[0]:
            key = next(key for key in sorted(keys) if camera.get(key) != whole[0].get(key))
            raise ValueError(
                f"{path} has different cameras: {key} is {whole[0].get(key)} in frame 0 and {camera.get(key)} in frame "
                f"{number}: take images of one camera, with focus and zoom locked, or map them as dataset=images"
            )
    return {**values, **whole[0]} if whole else values


def with_angle_of_view(values: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """Add the centred camera of an angle of view, as in Blender's files, to `values` without a focal length.

    A missing size is read from the images.
    """
    angle = values.get("camera_angle_x")
    if "fl_x" in values or not _is_number(angle) or not 0 < angle < math.pi:
        return values
    size = [values.get("w"), values.get("h")]
    if not all(map(_is_number, size)):
        names = [frame.get("file_path") for frame in frames_of(values)]
        files = (find_image(path.parent, name) for name in names if isinstance(name, str))
        size = [*reading.first_size(files, path, reading.AS_STORED)]
    width, height = size
    focal = width / (2 * math.tan(angle / 2))
    high = values.get("camera_angle_y")
    focal_y = height / (2 * math.tan(high / 2)) if _is_number(high) and 0 < high < math.pi else focal
    return {"fl_x": focal, "fl_y": focal_y, "cx": width / 2, "cy": height / 2, "w": width, "h": height} | dict(values)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def frames_of(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The frames that are mappings; others are refused by `load_transforms`."""
    frames = values.get("frames")
    return [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
