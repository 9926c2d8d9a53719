"""Models of COLMAP that are there: read from their folders, and those of a user brought to the images in use."""

import shutil
import sqlite3
import tempfile
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from emgs_jax.data.colmap_model import check_whole, is_model, load_colmap
from emgs_jax.data.masks import stem
from emgs_jax.data.reading import stretch
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.library import load
from emgs_jax.structure.mapping import map_database, tell
from emgs_jax.structure.shots import DATABASE, Shots

PARTS = ("cameras", "images")
SAME_FOCAL = 0.01  # relative difference up to which cameras are one: less than what it costs to map as another
MAX_STRETCH = 0.01  # of a model's images and these: sides are whole pixels
SQLITE = b"SQLite format 3\0"  # how its files begin


def read_models(place: Path) -> list[Any]:
    """Read the models of a folder: itself, or those that are numbered below it, the largest first.

    Raises:
        ValueError: there is none, or one is damaged.
    """
    pycolmap = load()
    below = [place, *sorted((path for path in place.glob("*") if path.name.isdecimal()), key=lambda p: int(p.name))]
    found = [folder for folder in below if all(any(folder.glob(f"{part}.*")) for part in PARTS)]
    if not found:
        raise ValueError(f"{place} holds no model of COLMAP (cameras, images, points3D as .bin or .txt)")
    models = []
    for folder in found:
        check_whole(folder)
        try:
            models.append(pycolmap.Reconstruction(folder))
        except (RuntimeError, ValueError, IndexError, MemoryError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{folder} is damaged ({reason}): export the model again, or delete the folder") from error
    return sorted(models, key=lambda model: -model.num_reg_images())


def stems_of(model: Any) -> list[str]:
    """Names of a model's images that have a pose."""
    return sorted(stem(image.name) for image in model.images.values() if image.has_pose)


def given_models(place: Path, shots: Shots, config: StructureConfig) -> list[Any]:
    """The models of `prior.structure.model`: a folder of models, or a database that is mapped in a copy.

    Raises:
        ValueError: it is of other images, none, or damaged.
    """
    database = place if place.suffix == ".db" else place / DATABASE
    key = f"prior.structure.model={config.model}"
    if not place.exists():
        raise ValueError(f"{key} does not exist: give the folder of a COLMAP model, or a database")
    has_model = any(any(folder.glob("cameras.*")) for folder in (place, *place.glob("[0-9]*")) if folder.is_dir())
    if has_model or not database.is_file():
        models = read_models(place)
    else:
        with database.open("rb") as handle:
            if handle.read(len(SQLITE)) != SQLITE:  # COLMAP may take it for an empty one
                raise ValueError(f"{key} is no database of COLMAP, or a damaged one (it is no file of SQLite)")
        with tempfile.TemporaryDirectory() as work:
            shutil.copy(database, Path(work) / DATABASE)
            try:
                take_camera(Path(work) / DATABASE, shots, key)
                models, said, _ = map_database(shots, config, Path(work))
                tell(said)
            except RuntimeError as error:
                raise ValueError(f"{key} is no database of COLMAP, or a damaged one ({error})") from error
    for model in models:
        stems = stems_of(model)
        twice = next((name for name in shots.names if stems.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"{key} has two images {twice}, and only their names tell them apart: export one folder's")
    named = {name for model in models for name in stems_of(model)}
    if not named & {*shots.names}:
        raise ValueError(
            f"{key} is of other images: it has {', '.join(sorted(named)[:3])}, …, this run "
            f"{', '.join(shots.names[:3])}, …; names count without folder and suffix"
        )
    for model in models:
        resize(model, shots, key)
        one_camera(model, shots.names, key)
    return models


def take_camera(database: Path, shots: Shots, key: str) -> None:
    """Give all images of a database the camera that is known, and say so; nothing where it is to be estimated."""
    if not shots.is_calibrated:
        return
    pycolmap = load()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            check_shape((camera.width, camera.height), shots.size, key)
            model, params = shots.camera
            known = pycolmap.Camera(model=model, width=shots.size[0], height=shots.size[1], params=params)
            known.rescale(camera.width, camera.height)
            known.camera_id, known.has_prior_focal_length = camera.camera_id, True
            before, after = camera.mean_focal_length(), known.mean_focal_length()
            if abs(before / after - 1) > SAME_FOCAL:
                tqdm.write(f"{key}: the data set's focal length of {after:.1f} px counts, not its own of {before:.1f}")
            opened.update_camera(known)


def names_at(place: Path) -> set[str]:
    """Names of the images of the models in a folder, or of a database; none where it cannot be read."""
    database = place if place.suffix == ".db" else place / DATABASE
    folders = [folder for folder in (place, *place.glob("[0-9]*")) if is_model(folder)]
    with suppress(ValueError, OSError, sqlite3.Error):  # whoever reads it says why
        if not folders and database.is_file():
            with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True)) as opened:
                return {stem(name) for (name,) in opened.execute("SELECT name FROM images")}
        return {stem(name) for folder in folders for name in load_colmap(folder).names}
    return set()


def in_use(model: Any, names: Sequence[str]) -> list[Any]:
    """The images of a model that have a pose and one of these names."""
    wanted = {*names}
    return [image for image in model.images.values() if image.has_pose and stem(image.name) in wanted]


def resize(model: Any, shots: Shots, key: str) -> None:
    """Bring the cameras and keypoints of a model to images of the size of these.

    Raises:
        ValueError: its images have another shape.
    """
    scales, size = {}, shots.size
    for number in {image.camera_id for image in in_use(model, shots.names)}:
        camera = model.cameras[number]
        before = camera.width, camera.height
        check_shape(before, size, key)
        if before != tuple(size):
            scales[number] = np.array(size) / before
            camera.rescale(*size)
    for image in model.images.values() if scales else ():
        for point in image.points2D if image.camera_id in scales else ():
            point.xy = point.xy * scales[image.camera_id]


def check_shape(found: tuple[int, int], size: tuple[int, int], key: str) -> None:
    """ValueError where images of `found` (width, height) are no copies of those of `size`."""
    if stretch(found, size) > MAX_STRETCH:
        raise ValueError(
            f"{key} is of images of {found[0]}x{found[1]}, which are no copies of those of {size[0]}x{size[1]}: give "
            "the images that the model was made of"
        )


def one_camera(model: Any, names: Sequence[str], key: str) -> None:
    """See all images of a model in use by one camera: their median, where they are the same but for its adjustment.

    Raises:
        ValueError: they are of different cameras.
    """
    cameras = {image.camera_id: image.camera for image in in_use(model, names)}
    if len(cameras) < 2:
        return
    focal = np.array([camera.mean_focal_length() for camera in cameras.values()])
    if len({camera.model_name for camera in cameras.values()}) > 1 or focal.max() / focal.min() - 1 > SAME_FOCAL:
        raise ValueError(
            f"{key}: the images are of {len(cameras)} different cameras (focal lengths of {focal.min():.1f} to "
            f"{focal.max():.1f} px): map those of one, or run COLMAP with --ImageReader.single_camera 1 where they "
            "were taken by one"
        )
    params = np.median([camera.params for camera in cameras.values()], axis=0)
    for camera in cameras.values():
        camera.params = params
