"""Images with known cameras but without depth: COLMAP's projects, nerfstudio's folders, and benchmarks.

Their poses are a reference for the trajectory; those of a program have its own unit, so only `trajectory/ate_sim3_m`
has a meaning. Images are not turned by their EXIF orientation, as these programs do not turn them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from emgs_jax.data import reading
from emgs_jax.data.calibration_files import Calibration, read_cameras
from emgs_jax.data.colmap_model import SparseModel, is_model, load_colmap
from emgs_jax.data.file_names import IMAGE_SUFFIXES, find_image, natural_order, times_of
from emgs_jax.data.intrinsics import check_image_size, to_lens
from emgs_jax.data.straightened import Straightened
from emgs_jax.data.tones import tones_of
from emgs_jax.data.transforms_json import load_transforms

Pose = Float[np.ndarray, "4 4"]
COLMAP_LAYOUT = "root[/sequence]/{images/, sparse/0/{cameras,images}.txt or .bin}"
NERFSTUDIO_LAYOUT = "root[/sequence]/{transforms.json, images/}"
MAX_ZOOM = 0.05  # relative difference of focal lengths up to which images are brought to one camera
MODEL_FOLDERS = ("sparse/0", "sparse", ".", "colmap/sparse/0")  # sparse/0 stands for all that are numbered


@dataclass(frozen=True)
class Solved:
    """Images of one camera with poses and calibration from another program."""

    images: list[Path]
    poses: list[Pose | None]  # T_world_camera of each, in the program's unit
    cameras: list[Calibration]  # of each; one serves for all
    source: Path  # file of poses and cameras
    files: tuple[Path, ...]
    times: list[float] | None = None  # seconds of images in order of time; None: from their names
    note: str | None = None
    masks: list[Path | None] | None = None  # of each, as nerfstudio has them; None = there are none


@dataclass(eq=False)
class PosedImages(Straightened):
    """Base of the data sets with poses; images in natural order of folders and names."""

    is_turned, _flags = False, reading.AS_STORED

    def _take(self, folder: Path, solved: Solved) -> None:
        order, times, note = in_order(solved)
        chosen = self._select(len(order), solved.source)
        self._folder, self._files, self._times = folder, solved.files, [times[place] for place in chosen]
        rows = [order[place] for place in chosen]
        self._images, self._poses = [solved.images[row] for row in rows], [solved.poses[row] for row in rows]
        self._masks = [None] * len(rows) if solved.masks is None else [solved.masks[row] for row in rows]
        for path, pose in zip(self._images, self._poses, strict=True):
            if pose is not None:
                reading.check_position(pose[:3, 3], f"{solved.source}, image {path.name},")
        if not any(path.is_file() for path in self._images):
            raise FileNotFoundError(
                f"{solved.source} names {self._images[0].name} and {len(rows) - 1} others, and none of them is in "
                f"{self._images[0].parent}: put the images there"
            )
        raw_size = reading.first_size(self._images, self._images[0].parent, self._flags)
        camera, of_cameras = common_camera([solved.cameras[row] for row in rows], solved.source)
        if of_cameras:
            self._cameras = [solved.cameras[row] for row in rows]
            for own in {*self._cameras}:
                check_image_size(own, raw_size, str(solved.source))
        lens = to_lens(camera, raw_size, str(solved.source), {"source": solved.source.name})
        self._tones = tones_of(self._images)
        self._use(lens, raw_size, solved.note, note, of_cameras, reading.transparency_note(self._images))

    def pose(self, index: int) -> Pose | None:
        return self._poses[index]

    def mask_file(self, index: int) -> Path | None:
        return self._masks[index]

    def _options(self) -> dict[str, Any]:
        own = {} if self._cameras is None else {"cameras": self._cameras}
        return {"lens": self.calibration["distortion"], "images": [path.name for path in self._images]} | own


def common_camera(cameras: Sequence[Calibration], source: Path) -> tuple[Calibration, str | None]:
    """The camera of median focal length, to which all images are brought; and words where they have their own.

    A camera that focuses changes its focal length a little, and COLMAP may solve for a camera for each image.

    Raises:
        ValueError: they differ by more than `MAX_ZOOM`.
    """
    different = {*cameras}
    if len(different) < 2:
        return cameras[0], None
    ordered = sorted(cameras, key=lambda camera: camera.intrinsics[0])
    low, high = ordered[0].intrinsics[0], ordered[-1].intrinsics[0]
    words = f"the images are of {len(different)} different cameras (focal lengths of {low:.1f} to {high:.1f} px)"
    if high / low - 1 > MAX_ZOOM or len({(camera.size, camera.model) for camera in cameras}) > 1:
        raise ValueError(
            f"{source}: {words}: map those of one (dataset.start, dataset.stop), with focus and zoom locked; or solve "
            "for one camera (COLMAP: --ImageReader.single_camera 1)"
        )
    return ordered[len(ordered) // 2], f"{words}, and are brought to one"


def in_order(solved: Solved) -> tuple[list[int], list[float], str | None]:
    """Rows of the images in order, their seconds, and a note on the origin of these."""
    if solved.times is not None:
        return [*range(len(solved.images))], solved.times, None
    order, of_order = natural_order(solved.images)
    times, note = times_of([solved.images[row] for row in order])
    return order, times, "; ".join(filter(None, (of_order, note))) or None


@dataclass(eq=False)
class Colmap(PosedImages):
    """A project of COLMAP in root or root/sequence: the images that are registered in a sparse model, of one camera."""

    model: str | None = None  # its folder; None: the first of MODEL_FOLDERS that has one, of several the largest
    images: str = "images"  # folder of the images

    name, layout, source = "colmap", COLMAP_LAYOUT, "COLMAP's project"

    def __post_init__(self) -> None:
        folder = self._find(self.sequence or ".")
        self._take(folder, read_colmap(find_model(folder, self.model), folder / self.images))


@dataclass(eq=False)
class Nerfstudio(PosedImages):
    """A folder with nerfstudio's transforms.json, of one camera; sequence None: root itself."""

    name, layout, source = "nerfstudio", NERFSTUDIO_LAYOUT, "written by ns-process-data and by many apps"

    def __post_init__(self) -> None:
        folder = self._find(self.sequence or ".")
        self._take(folder, read_nerfstudio(folder / "transforms.json"))


def find_model(folder: Path, model: str | None) -> SparseModel:
    """Read a sparse model, of several the largest; errors name the searched folders."""
    places = [folder / name for name in (MODEL_FOLDERS if model is None else (model,))]
    for place in places:
        beside = [place]
        if model is None and place.name == "0":  # COLMAP numbers models that it could not join
            numbered = (path for path in place.parent.glob("*") if path.name.isdecimal())
            beside = sorted(numbered, key=lambda path: int(path.name))
        if there := [load_colmap(folder) for folder in beside if is_model(folder)]:
            return max(there, key=lambda found: len(found.names))
    looked = ", ".join(str(place) for place in places)
    raise FileNotFoundError(f"no cameras and images (.txt or .bin) in {looked}; expected the layout {COLMAP_LAYOUT}")


def read_colmap(found: SparseModel, folder: Path) -> Solved:
    """The images of a sparse model, in `folder`."""
    images = [find_image(folder, name) for name in found.names]
    there = sum(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.rglob("*"))
    note = f"{found.files[1]} has {len(images)} of the {there} images in {folder}; the others have no pose"
    lacking = note if there > len(images) else None
    cameras = [found.cameras[number] for number in found.camera_ids]
    return Solved(images, [*found.T_world_camera], cameras, found.files[1], found.files, note=lacking)


def read_nerfstudio(path: Path) -> Solved:
    """Read the frames of a transforms.json, whose poses may be inf or nan; ValueError if it is damaged."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected the layout {NERFSTUDIO_LAYOUT}")
    cameras = read_cameras(path)
    names, rows, masks = load_transforms(path)
    poses = [
        reading.as_pose(" ".join(map(repr, row)), f"{path}, frame {name}")
        for name, row in zip(names, rows, strict=True)
    ]
    images, masks = (
        [find_image(path.parent, name) for name in names],
        [find_image(path.parent, mask) if mask else None for mask in masks],
    )
    return Solved(images, poses, cameras, path, (path,), masks=masks)
