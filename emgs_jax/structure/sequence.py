"""The structure of a data set's images, and the camera of images whose intrinsics nobody knows."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emgs_jax.data.base import Dataset
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.model import Structure, to_structure
from emgs_jax.structure.reconstruct import Shots
from emgs_jax.structure.store import make_models, models_of

ESTIMATED = "structure"  # of a data set's calibration: the key of the structure that its camera is from


def structure_of(dataset: Dataset, config: StructureConfig, folder: Path | None) -> tuple[Structure, bool]:
    """The structure of a data set, and True if its images are straight, whatever lens the structure has.

    Args:
        folder: of a run, which keeps it.
    """
    names = names_of(dataset)
    key = dataset.calibration.get(ESTIMATED)
    if key is not None and (models := models_of(key, folder)) is not None:
        return to_structure(models, names, config), True
    read, size, intrinsics = full_images(dataset)
    shots = Shots(names, read, size, pinhole_of(intrinsics, config), is_calibrated=True)
    _, models = make_models(shots, config, folder)
    return to_structure(models, names, config), False


def names_of(dataset: Dataset) -> list[str]:
    """A name for each frame in use: that of its file, or its number in the data set where files have no name each."""
    kept = getattr(dataset, "kept", range(len(dataset)))
    files = [dataset.files(index) for index in range(len(dataset))]
    return image_names([found[0] if found else None for found in files], kept)


def image_names(files: Sequence[Path | None], numbers: Sequence[int]) -> list[str]:
    """Stems of the files if each has its own, else the numbers."""
    stems = [path.stem if path is not None else "" for path in files]
    return stems if all(stems) and len({*stems}) == len(stems) else [f"{number:06d}" for number in numbers]


def full_images(dataset: Dataset) -> tuple[Any, tuple[int, int], tuple[float, ...]]:
    """A function that reads an image as large as it is on disk, straight; its (width, height) and intrinsics."""
    full = getattr(dataset, "full", None)
    if full is None or full.intrinsics is None:
        return lambda index: dataset[index].image, tuple(dataset.size), tuple(dataset.intrinsics)
    return full.read, full.size, full.intrinsics


def pinhole_of(intrinsics: Sequence[float], config: StructureConfig) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera of a straight image, whose distortion may still be refined."""
    fx, fy, cx, cy = intrinsics
    is_square = abs(fx / fy - 1) < 1e-3
    if not config.refine_distortion:
        return "PINHOLE", (fx, fy, cx + 0.5, cy + 0.5)
    if is_square:
        return "SIMPLE_RADIAL", ((fx + fy) / 2, cx + 0.5, cy + 0.5, 0.0)
    return "OPENCV", (fx, fy, cx + 0.5, cy + 0.5, 0.0, 0.0, 0.0, 0.0)
