"""The structure of a data set's images, and self-calibration."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.data.base import BadFrameError, Dataset
from emgs_jax.data.camera_models import PERSPECTIVE, Calibration, from_colmap, to_pycolmap
from emgs_jax.data.intrinsics import Pictures, from_exif
from emgs_jax.data.masks import image_names, names_of
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.given import in_use
from emgs_jax.structure.library import load
from emgs_jax.structure.model import Structure, to_structure
from emgs_jax.structure.online import CAMERA, Online, add, forget_follower, newest
from emgs_jax.structure.shots import Shots
from emgs_jax.structure.store import make_models, models_of

WAITING_S = 0.3  # between images of a camera before the structure begins
ESTIMATED = "structure"  # in a data set's calibration: key of the structure that its camera is from


def structure_of(
    dataset: Dataset, config: StructureConfig, folder: Path | None, at_poses: bool = False
) -> tuple[Structure, bool]:
    """The structure of a data set, kept in `folder`, and True if its images are undistorted, whatever the lens.

    Args:
        at_poses: the data set's poses, in metres, are those of the structure, up to their errors.
    """
    names = names_of(dataset)
    key = dataset.calibration.get(ESTIMATED)
    if key is not None and not at_poses and (models := models_of(key, folder)) is not None:
        return to_structure(models, names, config), True
    read, size, intrinsics = full_images(dataset)
    # A model that is given is of the images on disk, which the data set may have straightened.
    is_straight = config.model is not None and any(dataset.calibration.get("distortion") or ())
    camera = of_calibration(dataset.calibration, size) if is_straight else pinhole_of(intrinsics, config)
    masks = getattr(dataset, "full_mask", None)
    poses = [dataset.pose(index) for index in range(len(dataset))] if at_poses else None
    known = None if poses is None else np.stack([np.full((4, 4), np.nan) if T is None else T for T in poses])
    shots = Shots(names, read, size, camera, is_calibrated=True, mask=masks, poses=known)
    _, models = make_models(shots, config, folder)
    return to_structure(models, names, config), is_straight


def follow_images(dataset: Dataset, config: StructureConfig) -> Callable[[int], Structure]:
    """Return a function that gives the structure of the images so far, once that of this number has come.

    It takes more images as long as no structure has begun; of a camera only those that show something new, as each is
    mapped then. While those that waited are asked for, it takes one for every second of them: so it does not lose a
    camera that moves on.
    """
    read, size, intrinsics = full_images(dataset)
    model, parameters = pinhole_of(intrinsics, config)
    camera = load().Camera(model=model, width=size[0], height=size[1], params=parameters, camera_id=CAMERA)
    camera.has_prior_focal_length = True
    mask = getattr(dataset, "full_mask", None) or (lambda index: None)
    online, known, begun = Online(camera, config), {}, []

    def image_of(index: int) -> np.ndarray | None:
        try:
            return read(index)
        except BadFrameError:
            return None

    def take() -> bool:
        """Add the next image; False if there is none."""
        index = online.num_frames
        if not dataset.has(index):
            return False
        add(online, image_of(index), mask(index))
        return True

    def up_to(frame: int) -> Structure:
        while not online.has_begun and take():
            if not online.has_begun and dataset.total is None:
                if forget_follower(online):
                    dataset.drop_last()
                time.sleep(WAITING_S)
        if not begun:
            begun.append(online.num_frames)
        while online.num_frames < max(frame + 1, begun[0] + frame // 2) and take():
            pass
        if online.num_frames not in known:
            known.clear()
            known[online.num_frames] = newest(online)
        return known[online.num_frames]

    return up_to


def calibrate(
    pictures: Pictures, config: StructureConfig, folder: Path | None = None
) -> tuple[Calibration, dict[str, Any]]:
    """Calibrate a camera by COLMAP from all images, starting at the first one's EXIF or a default, and describe it."""
    if config.camera_model not in PERSPECTIVE:
        raise ValueError(f"prior.structure.camera_model={config.camera_model}: there are {', '.join(PERSPECTIVE)}")
    files, numbers = [*pictures.files] or [None] * pictures.count, pictures.numbers or range(pictures.count)
    names, mask = image_names(files, numbers), config.masks.reader(files, numbers, pictures.size)
    (width, height), focal = pictures.size, _exif_focal(pictures)
    is_known = focal is not None and config.camera_model == "SIMPLE_RADIAL"
    start = (focal, width / 2, height / 2, 0.0) if is_known else ()
    camera = config.camera_model, start
    shots = Shots(names, pictures.read, pictures.size, camera, is_calibrated=False, mask=mask)
    key, models = make_models(shots, config, folder)
    model, images = max(((one, in_use(one, names)) for one in models), key=lambda pair: len(pair[1]))
    image = images[0]
    camera = from_colmap(image.camera.model_name, [*image.camera.params], pictures.size, "COLMAP's self-calibration")
    count, error = len(images), model.compute_mean_reprojection_error()
    note = (
        f"intrinsics estimated by COLMAP from {count} of {pictures.count} images: {image.camera.model_name} "
        f"{[round(float(value), 4) for value in image.camera.params]}, reprojection error {error:.2f} px"
    )
    about = {"source": "estimate", "note": note, "num_images": count, "reprojection_error_px": error, ESTIMATED: key}
    return camera, about


def _exif_focal(pictures: Pictures) -> float | None:
    """Focal length in pixels by the EXIF of the first image, or None."""
    if not pictures.files:
        return None
    try:
        return from_exif(replace(pictures, files=pictures.files[:1])).intrinsics[0]
    except ValueError:
        return None


def full_images(dataset: Dataset) -> tuple[Callable[[int], np.ndarray], tuple[int, int], tuple[float, ...]]:
    """A function that reads an undistorted image at its size on disk; (width, height) and intrinsics there."""
    intrinsics = getattr(dataset, "full_intrinsics", None)
    if intrinsics is None:
        return lambda index: dataset[index].image, tuple(dataset.size), tuple(dataset.intrinsics)
    height, width = dataset.full(0).shape[:2]
    return dataset.full, (width, height), tuple(intrinsics)


def of_calibration(about: Mapping[str, Any], size: tuple[int, int]) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera of the images on disk, from the calibration of a data set."""
    fx, fy, cx, cy = about["intrinsics"]
    camera = to_pycolmap(
        Calibration((fx, fy, cx + 0.5, cy + 0.5), tuple(about["distortion"]), model=about.get("model", "OPENCV")), size
    )
    return camera.model_name, tuple(map(float, camera.params))


def pinhole_of(intrinsics: Sequence[float], config: StructureConfig) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera of an undistorted image, whose distortion may still be refined."""
    fx, fy, cx, cy = intrinsics
    is_square = abs(fx / fy - 1) < 1e-3
    if not config.refine_distortion:
        return "PINHOLE", (fx, fy, cx + 0.5, cy + 0.5)
    if is_square:
        return "SIMPLE_RADIAL", ((fx + fy) / 2, cx + 0.5, cy + 0.5, 0.0)
    return "OPENCV", (fx, fy, cx + 0.5, cy + 0.5, 0.0, 0.0, 0.0, 0.0)
