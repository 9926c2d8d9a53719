"""Find intrinsics by `dataset.intrinsics` (numbers, a calibration file, exif, estimate), and undistort images."""

import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import ExifTags, Image

from emgs_jax.data import reading
from emgs_jax.data.calibration_files import read_calibration
from emgs_jax.data.camera_models import Calibration, from_colmap, lens_of
from emgs_jax.data.plausible_camera import is_impossible, oddities, other_reading, view_deg
from emgs_jax.data.reading import Intrinsics, Number, Size
from emgs_jax.data.tones import Tones, read_shown
from emgs_jax.data.undistortion import Maps, tables, undistortion

DIAGONAL_35_MM = 43.27  # of 36 mm x 24 mm, by which cameras scale at any aspect (COLMAP's rule)
MAX_ASPECT_CHANGE = 0.02  # from the picture that the camera took to the file
ALTERNATIVES = (
    "dataset.intrinsics=[fx,fy,cx,cy] in pixels of the images on disk (then k1,k2,p1,p2 and maybe k3 of the lens; or "
    "[MODEL,…] with COLMAP's parameters), a calibration file, exif or estimate"
)


@dataclass(frozen=True)
class Pictures:
    """The images in use, of one camera."""

    size: Size  # (width, height) on disk
    count: int
    read: Callable[[int], UInt8[np.ndarray, "_ _ 3"]]  # RGB image 0..count-1 as on disk; raises BadFrameError
    files: Sequence[Path] = ()  # empty for a video
    name: str = "images"  # for messages
    numbers: Sequence[int] = ()  # of a video's frames


Estimator = Callable[[Pictures], tuple[Calibration, dict[str, Any]]]
Given = str | Sequence[Number | str] | Estimator  # dataset.intrinsics; a function stands for "estimate"


@dataclass(frozen=True)
class Lens:
    """Undistortion to a pinhole camera."""

    intrinsics: Intrinsics  # fx, fy, cx, cy of the undistorted images, which have the size of those on disk
    maps: Maps | None  # tables of cv2.remap; None without distortion
    about: Mapping[str, Any]  # origin of the intrinsics for metrics.json
    border: int = cv2.BORDER_CONSTANT  # what lies beyond the image: black, or the pixel at its border

    def of(self, camera: Calibration, size: Size) -> "Lens":
        """The lens of a similar camera, whose images are undistorted to the same pinhole camera."""
        return replace(self, maps=tables(camera, self.intrinsics, size), border=cv2.BORDER_REPLICATE)

    def straighten(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Undistort an image, bilinearly."""
        return image if self.maps is None else cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=self.border)

    def straighten_mask(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """A mask of the distorted image, without distortion; a pixel between two is masked if one of them is."""
        return mask if self.maps is None else cv2.remap(np.uint8(255 * mask), *self.maps, cv2.INTER_LINEAR) > 0

    def straighten_depth(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        """Undistort depth that is registered to the image, by the nearest, as depths must not be mixed."""
        return depth if self.maps is None else cv2.remap(depth, *self.maps, cv2.INTER_NEAREST)

    def distorted_pixels(self, size: Size) -> Float32[np.ndarray, "h w 2"] | None:
        """The pixel (column, row) of the distorted image where each of the undistorted one at `size` is."""
        if self.maps is None:
            return None
        return np.stack(
            [cv2.resize(table, tuple(size), interpolation=cv2.INTER_LINEAR) for table in self.maps], axis=-1
        )

    def straight_pixel(self, pixel: Sequence[float]) -> np.ndarray:
        """The pixel (column, row) of the undistorted image that is nearest to one of the distorted image."""
        if self.maps is None:
            return np.asarray(pixel, np.float64)
        off = (self.maps[0] - pixel[0]) ** 2 + (self.maps[1] - pixel[1]) ** 2
        row, column = np.unravel_index(np.argmin(off), off.shape)
        return np.array([column, row], np.float64)


def pictures_of(files: Sequence[Path], size: Size, tones: Tones | None = None) -> Pictures:
    """Image files of one size; `tones` of those with more than 8 bits."""
    return Pictures(size, len(files), lambda index: read_shown(files[index], size, tones), files)


def find_lens(given: Given, pictures: Pictures) -> Lens:
    """The lens that `dataset.intrinsics` names.

    Raises:
        ValueError: numbers, file, EXIF or images give no camera, or one of another size, or too much distortion.
        FileNotFoundError: no such calibration file.
    """
    about: dict[str, Any] = {"source": "numbers"}
    if callable(given):
        what = "dataset.intrinsics=estimate"
        camera, about = given(pictures)
    elif not isinstance(given, str):
        what, camera = "dataset.intrinsics", from_numbers(given)
    elif given == "exif":
        what, camera = "dataset.intrinsics=exif", from_exif(pictures)
        about = {"source": given, "note": f"intrinsics from EXIF: focal length {camera.intrinsics[0]:.1f} px"}
    elif given == "estimate":
        raise ValueError(
            "dataset.intrinsics=estimate needs a structure of the images: build the data set from a config "
            "(emgs_jax.load_config, build_dataset), or give a function of the pictures (structure.sequence.calibrate)"
        )
    else:
        path = Path(given).expanduser()
        what, camera = str(path), read_calibration(path)
        values = [round(value, 2) for value in camera.intrinsics]
        about = {"source": path.name, "note": f"intrinsics from {path.name}: {values}"}
    return to_lens(camera, pictures.size, what, about, pictures.name)


def to_lens(camera: Calibration, size: Size, what: str, about: Mapping[str, Any], images: str = "images") -> Lens:
    """The lens of a calibration for images of `size` on disk; `what` and `images` name both in errors.

    Size, intrinsics and distortion are added to `about`.

    Raises:
        ValueError: it is for another size, no lens has such a view, or the distortion leaves nothing of the image.
    """
    check_image_size(camera, size, what)
    raw = reading.check_intrinsics(camera.intrinsics, size, what, images)
    about = with_notes(about, check_plausible(camera, size, what, images))
    about = {**about, "size": [*size], "intrinsics": [*raw], "distortion": [*camera.distortion]}
    if camera.is_pinhole:
        return Lens(raw, None, about)
    straight, maps, share = undistortion(camera, size, what)
    if camera.model != "OPENCV":
        wide, high = view_deg(straight, size)
        view = f"straight images of {wide:.0f} x {high:.0f} degrees show {100 * share:.0f} % of those on disk"
        about = with_notes({**about, "model": camera.model}, f"{camera.model}: {view}")
    return Lens(straight, maps, about)


def with_notes(about: Mapping[str, Any], *notes: str | None) -> Mapping[str, Any]:
    """Add notes on the images to the `note` of a lens's description."""
    said = [note for note in (about.get("note"), *notes) if note]
    return {**about, "note": "; ".join(said)} if said else about


def from_numbers(given: Sequence[Number | str]) -> Calibration:
    """The camera of fx, fy, cx, cy, maybe with OpenCV's distortion; or of a COLMAP model's name and parameters."""
    what = "dataset.intrinsics"
    values = [*given] if isinstance(given, Iterable) else [given]
    if values and isinstance(values[0], str):
        return from_colmap(values[0], values[1:], None, what, corner=0.0)
    if len(values) not in (4, 8, 9, 12) or not all(isinstance(v, Real) and math.isfinite(v) for v in values):
        raise ValueError(
            f"{what} must be [fx, fy, cx, cy], or [fx, fy, cx, cy, k1, k2, p1, p2(, k3(, k4, k5, k6))] for images with "
            f"distortion, all finite, or [MODEL, …] with the parameters of COLMAP's model; got {values}"
        )
    return Calibration((*map(float, values[:4]),), lens_of("OPENCV", [*map(float, values[4:])], what))


def from_exif(pictures: Pictures) -> Calibration:
    """A centred camera with the 35 mm equivalent focal length of all images; the orientation tag does not matter."""
    if not pictures.files:
        raise ValueError(f"dataset.intrinsics=exif needs image files, a video has no EXIF: give {ALTERNATIVES}")
    found: dict[float | None, Path] = {}
    for path in pictures.files:
        try:
            found.setdefault(exif_focal_length(path, pictures.size), path)
        except (OSError, SyntaxError, struct.error):  # a damaged image, which is reported when it is read
            continue
    if not found or None in found:
        path = found.get(None, pictures.files[0])
        raise ValueError(
            f"dataset.intrinsics=exif: {path} has no EXIF FocalLengthIn35mmFilm (tag 41989), which is lost when images "
            f"are edited or cut from a video: give {ALTERNATIVES}"
        )
    if len(found) > 1:
        each = ", ".join(f"{value:g} mm in {path.name}" for value, path in found.items())
        raise ValueError(f"dataset.intrinsics=exif: there are several focal lengths ({each}): take those of one")
    (millimetres,) = found
    (w, h) = pictures.size
    focal = millimetres / DIAGONAL_35_MM * math.hypot(w, h)
    return Calibration((focal, focal, (w - 1) / 2, (h - 1) / 2))


def exif_focal_length(path: Path, size: Size) -> float | None:
    """FocalLengthIn35mmFilm in millimetres, None if absent or 0 (unknown); ValueError for a cropped image."""
    with Image.open(path) as image:
        tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
    try:
        value = float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
        taken = [float(tags.get(tag, 0)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if min(taken) > 0 and abs(max(taken) / min(taken) * min(size) / max(size) - 1) > MAX_ASPECT_CHANGE:
        raise ValueError(
            f"dataset.intrinsics=exif: {path} was taken with {taken[0]:.0f}x{taken[1]:.0f} and cut to "
            f"{size[0]}x{size[1]}, so its EXIF is of another view: give {ALTERNATIVES}"
        )
    return value if math.isfinite(value) and value > 0 else None


def check_image_size(camera: Calibration, size: Size, what: str) -> None:
    """Raise ValueError if a calibration is for images of another size."""
    if camera.size is None or camera.size == tuple(size):
        return
    (w, h), (width, height) = camera.size, size
    reason = "give the calibration of these images, or these images in that size"
    if (w, h) == (height, width):
        reason = "they are turned, maybe by their EXIF orientation; calibrate the images as they are shown"
    raise ValueError(f"{what} is for images of {w}x{h}, but the images are {width}x{height}: {reason}")


def check_plausible(camera: Calibration, size: Size, what: str, images: str) -> str | None:
    """Describe what is implausible in a camera, or None; ValueError if it is impossible, or likely of another form."""
    found = oddities(camera.intrinsics, size)
    if not found:
        return None
    other = other_reading(camera.intrinsics, size)
    odd = f"{what} {[*camera.intrinsics]} is odd for the {size[0]}x{size[1]} {images}: {', '.join(found)}"
    if is_impossible(camera.intrinsics, size):
        remedy = other or "give fx, fy, cx, cy in pixels of the images on disk"
        raise ValueError(f"{odd}; {remedy}")
    if other and camera.size is None:
        raise ValueError(f"{odd}; {other}, or, where they are right, a calibration file with width and height")
    return f"{odd}; {other or 'check it'}"
