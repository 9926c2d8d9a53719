"""COLMAP's camera models, evaluated by pycolmap; pixel centres at integers, so COLMAP's cx, cy are .5 larger."""

import math
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from emgs_jax.data.reading import Intrinsics, Size

MODELS = {  # parameters by model, f = fx = fy, in the order of the models' numbers in cameras.bin
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "SIMPLE_DIVISION": "f cx cy k",
    "DIVISION": "fx fy cx cy k",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta",
    "EQUIRECTANGULAR": "w h",
}
PERSPECTIVE = tuple(model for model, names in MODELS.items() if "cx" in names)
FULL_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
OPENCV_FAMILY = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")  # its special cases
LENSES = {  # names of a pinhole camera's distortion in ROS, OpenCV, Kalibr and EuRoC
    **dict.fromkeys(("", "none", "plumb_bob", "rational_polynomial", "radtan", "radial-tangential"), "OPENCV"),
    **dict.fromkeys(("equidistant", "fisheye"), "OPENCV_FISHEYE"),
    "fov": "FOV",
}


@dataclass(frozen=True)
class Calibration:
    """A camera."""

    intrinsics: Intrinsics  # fx, fy, cx, cy of the images on disk, pixel centres at integers
    # other parameters of `model`: of OPENCV k1, k2, p1, p2(, k3(, k4, k5, k6)); empty for a pinhole camera
    distortion: tuple[float, ...] = ()
    size: Size | None = None  # (width, height) of its images; None if unknown
    model: str = "OPENCV"  # OPENCV for all of OPENCV_FAMILY, else COLMAP's name

    @property
    def is_pinhole(self) -> bool:
        return self.model == "OPENCV" and not any(self.distortion)


def as_number(value: Any, key: str, where: object) -> float:
    """A finite number, which YAML may read as text (1e-3 without a point)."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{where}: {key} must be a finite number, got {str(value)[:80]!r}: correct it")
    return number


def size_of(width: float, height: float, where: object) -> Size:
    if min(width, height) < 1 or width != int(width) or height != int(height):
        raise ValueError(f"{where}: width and height must be pixels, got {width:g} and {height:g}: correct them")
    return int(width), int(height)


def refuse_model(model: object, known: Sequence[str], where: object) -> None:
    raise ValueError(
        f"{where}: the camera model {model} is not read, only {', '.join(known)}: undistort the images with the "
        "program that calibrated them (colmap image_undistorter) and give the new calibration"
    )


def from_colmap(
    model: str, values: Sequence[Any], size: Size | None, where: object, corner: float = 0.5
) -> Calibration:
    """The camera with COLMAP's parameters of a perspective model; `corner` is the first pixel's centre in `values`."""
    if model not in PERSPECTIVE:
        refuse_model(model, PERSPECTIVE, where)
    names = MODELS[model].split()
    if len(values) != len(names):
        raise ValueError(f"{where}: {model} has the parameters {', '.join(names)}, got {len(values)}: correct them")
    found = {name: as_number(value, name, where) for name, value in zip(names, values, strict=True)}
    focal = found.get("fx", found.get("f")), found.get("fy", found.get("f"))
    intrinsics = *focal, found["cx"] - corner, found["cy"] - corner
    if model in OPENCV_FAMILY:
        bent = [found.get(name, 0.0) for name in FULL_OPENCV]
        return Calibration(intrinsics, lens_of("OPENCV", bent[: 8 if any(bent[4:]) else 4], where), size)
    rest = tuple(value for name, value in found.items() if name not in ("f", "fx", "fy", "cx", "cy"))
    return Calibration(intrinsics, rest, size, model)


def lens_of(model: str, coefficients: Sequence[float], where: object) -> tuple[float, ...]:
    """The distortion of a model, checked; of OPENCV empty if all are 0, and the ninth and later ones must be 0."""
    if model == "OPENCV":
        if len(coefficients) not in (0, 4, 5, 8, 12, 14) or any(coefficients[8:]):
            raise ValueError(
                f"{where}: {len(coefficients)} distortion coefficients are no k1, k2, p1, p2(, k3(, k4, k5, k6)): "
                "calibrate with these"
            )
        return tuple(coefficients[: 8 if any(coefficients[5:8]) else 5]) if any(coefficients) else ()
    names = MODELS[model].split()[4:]
    if len(coefficients) != len(names):
        raise ValueError(f"{where}: {model} has {', '.join(names)}, got {len(coefficients)} numbers: correct them")
    return tuple(coefficients)


def named_lens(name: object, coefficients: Sequence[float], where: object) -> tuple[tuple[float, ...], str]:
    """Distortion and model by another program's name for it; ValueError if it is unknown."""
    model = LENSES.get(str(name).lower())
    if model is None:
        refuse_model(name, [*filter(None, LENSES)], where)
    return lens_of(model, coefficients, where), model


def load_pycolmap(otherwise: str) -> ModuleType:
    """Import pycolmap, silence its log and restore the handler of SIGTERM; ValueError if it is not installed."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(otherwise) from error
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def to_pycolmap(camera: Calibration, size: Size) -> Any:
    """pycolmap's camera with pixel centres at integers; ValueError if it is not installed."""
    pycolmap = load_pycolmap(
        "images with lens distortion are straightened by pycolmap, which is not installed (for Linux on ARM there "
        "is no wheel): build it from the source of COLMAP, or undistort the images on another machine"
    )
    model, rest = camera.model, camera.distortion
    if model == "OPENCV":
        model, rest = "FULL_OPENCV", (*rest, *[0.0] * (len(FULL_OPENCV) - len(rest)))
    fx, fy, *center = camera.intrinsics
    focal = (fx,) if MODELS[model].startswith("f ") else (fx, fy)
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=[*focal, *center, *rest])


def project(camera: Any, rays: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Pixels of points x, y at depth 1 in pycolmap's `camera`; nan where it does not see them."""
    return camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))


def unproject(camera: Any, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Points x, y at depth 1 that pycolmap's `camera` shows at pixels; nan if they lie beside or behind it."""
    rays = np.asarray(camera.cam_from_img(pixels))
    is_seen = np.abs(project(camera, rays) - pixels).max(axis=1, keepdims=True) < 0.5  # nan is not
    return np.where(is_seen, rays, np.nan)
