"""Keep structures in a run's folder and in a cache, under a key of their inputs."""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from filelock import FileLock
from tqdm import tqdm

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.masks import stem
from emgs_jax.io.files import write_file
from emgs_jax.structure import evidence, mapping, mirror, posed, reconstruct
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.given import given_models, read_models, stems_of
from emgs_jax.structure.library import load
from emgs_jax.structure.mapping import Mapped, tell
from emgs_jax.structure.reconstruct import map_images
from emgs_jax.structure.shots import Shots

ABOUT = "structure.json"
VERSION = 2  # changes with the code of `structure/`, if that makes other models of the same images
NOT_OF_MODELS = ("model", "online", "median_depth", "pixel_std")  # settings that do not change the models
CACHE = Path("~/.cache/emgs_jax/structure")


def key_of(shots: Shots, config: StructureConfig) -> str:
    """Hex digest of pixels and masks, camera, settings, and the versions of COLMAP and ours."""
    settings = {name: value for name, value in asdict(config).items() if name not in NOT_OF_MODELS}
    settings["masks"] = config.masks.fingerprint()
    about = [settings, shots.camera, shots.is_calibrated, [*shots.names], load().__version__, VERSION, _constants()]
    if shots.poses is not None:
        about += [shots.poses.tolist(), *_constants_of(posed).items()]
    digest = hashlib.blake2b(json.dumps(about, sort_keys=True, default=str).encode(), digest_size=16)
    for index in range(len(shots.names)):
        try:
            digest.update(np.ascontiguousarray(shots.read(index)).data)
        except BadFrameError:
            digest.update(b"none")
        if not config.masks.folder and (is_out := shots.mask(index)) is not None:
            digest.update(np.ascontiguousarray(is_out).data)
    return digest.hexdigest()


def _constants() -> dict[str, Any]:
    """The numbers that models are made with, and nobody sets."""
    return _constants_of(evidence, mapping, mirror, reconstruct)


def _constants_of(*modules: ModuleType) -> dict[str, Any]:
    return {name: value for module in modules for name, value in vars(module).items() if name.isupper()}


def make_models(shots: Shots, config: StructureConfig, folder: Path | None) -> tuple[str, list[Any]]:
    """Load or make the models of images, the largest first, and their key; `folder` is `structure/` of a run.

    Raises:
        ValueError: the images do not determine a structure, or `config.model` is of others.
    """
    if config.model is not None:
        models = given_models(Path(config.model).expanduser(), shots, config)
        key = hashlib.blake2b(repr([stems_of(model) for model in models]).encode(), digest_size=16).hexdigest()
        if folder is not None:
            write_models(Mapped(models, []), key, folder)
        return key, models
    key = key_of(shots, config)
    places = places_of(key, folder)
    cached = places[-1]
    with ExitStack() as stack:
        with suppress(OSError):  # a cache that cannot be written is not shared
            cached.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(cached.with_suffix(".lock")))  # another run may be making the same
        there = kept_at(key, places)
        if there is None:
            there = _made(shots, config, key, places)
        models = read_models(there)
        tell(json.loads((there / ABOUT).read_text(encoding="utf-8")).get("said", ()))
        for place in places:
            if not is_of(place, key):
                try:
                    copy_models(there, place)
                except OSError as error:
                    tqdm.write(f"{place} cannot keep the structure ({error.strerror}): the next run makes it again")
    return key, models


def models_of(key: str, folder: Path | None) -> list[Any] | None:
    """Load models by their key from the run's folder or the cache; None if neither has them."""
    there = kept_at(key, places_of(key, folder))
    return None if there is None else read_models(there)


def places_of(key: str, folder: Path | None) -> list[Path]:
    """The places for models of this key: a run's folder, if any, and the cache."""
    return [*([] if folder is None else [folder]), CACHE.expanduser() / key]


def kept_at(key: str, places: Sequence[Path]) -> Path | None:
    """The first of these places that holds the models of this key."""
    return next((place for place in places if is_of(place, key)), None)


def _made(shots: Shots, config: StructureConfig, key: str, places: Sequence[Path]) -> Path:
    """Make the models in the first writable folder, and resume an interrupted call there."""
    for place in [*places, Path(tempfile.gettempdir()) / f"emgs_structure_{key}"]:
        work = place.with_name(f".{place.name}_{key}")
        try:
            work.mkdir(parents=True, exist_ok=True)
            (work / "is_writable").touch()
        except OSError:
            continue
        write_models(map_images(shots, config, work), key, place)
        shutil.rmtree(work, ignore_errors=True)
        return place
    raise ValueError(f"no folder can be written: {', '.join(map(str, places))}; give hydra.run.dir=DIR")


def is_of(place: Path, key: str) -> bool:
    """Test whether a folder holds the models of this key."""
    try:
        return json.loads((place / ABOUT).read_text(encoding="utf-8"))["key"] == key
    except (OSError, ValueError, KeyError):
        return False


def write_models(mapped: Mapped, key: str, place: Path) -> None:
    """Write models for COLMAP, a folder each, and last their key and what is to be known of them."""
    _clear(place)
    for number, model in enumerate(mapped.models):
        folder = place / str(number)
        folder.mkdir(exist_ok=True)
        model.write_binary(folder)
    images = [model.num_reg_images() for model in mapped.models]
    about = {"key": key, "pycolmap": load().__version__, "images": images, "said": mapped.said}
    about["doubtful"] = sorted(mapped.doubtful)
    write_file(place / ABOUT, json.dumps(about, indent=1).encode())


def doubtful_in(folder: Path | None) -> set[str] | None:
    """Names, without suffix, of the images of doubtful models in a run's `structure/`; None if that is not known."""
    if folder is None or not (folder / ABOUT).is_file():
        return None
    names = json.loads((folder / ABOUT).read_text(encoding="utf-8")).get("doubtful")
    return None if names is None else {*map(stem, names)}


def copy_models(source: Path, place: Path) -> None:
    """Copy the files: written again they would have another order, and sums over them other bits."""
    _clear(place)
    for folder in [path for path in source.iterdir() if path.name.isdecimal()]:
        shutil.copytree(folder, place / folder.name)
    write_file(place / ABOUT, (source / ABOUT).read_bytes())


def _clear(place: Path) -> None:
    """Remove models of other settings."""
    place.mkdir(parents=True, exist_ok=True)
    (place / ABOUT).unlink(missing_ok=True)
    for folder in [path for path in place.iterdir() if path.name.isdecimal()]:
        shutil.rmtree(folder)
