"""Read our own layout, a file a frame (docs/predictions.md)."""

from functools import partial
from pathlib import Path

import numpy as np

from emgs_jax.data.file_names import last_number
from emgs_jax.data.reading import read_depth
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.prior.files import arrays
from emgs_jax.prior.files.arrays import as_intrinsics, as_poses, as_view, files_of, load_json, load_npz, names_in
from emgs_jax.prior.files.view import Predictions, View, whole_image

SUFFIXES = (".npz", ".exr", ".npy", ".png")  # the first that exists is read
POSES = ("poses.txt", "poses.json")
KEYS = ("depth", "points", "confidence", "intrinsics")  # of an .npz, beside the pose
GIVES_POSES = (
    "poses are needed beside depths, and are not found here: prior=multiview_stereo finds poses and depths from "
    "the images alone, prior=mapanything by a network"
)


def read_own(folder: Path, units_per_metre: float) -> Predictions:
    """Read a folder of .npz, .exr, .npy or 16-bit .png files, with poses in the .npz, poses.txt or poses.json."""
    suffix = next((suffix for suffix in SUFFIXES if files_of(folder, suffix)), None)
    if suffix is None:
        raise ValueError(
            f"prior.folder={folder} has no file *{', *'.join(SUFFIXES)} and no known layout (docs/predictions.md)"
        )
    paths = files_of(folder, suffix)
    names = [path.stem for path in paths]
    lists = [folder / name for name in POSES if (folder / name).is_file()]
    if lists:
        poses, source = _listed_poses(lists[0], names), str(lists[0])
    elif suffix == ".npz":
        poses, source = np.concatenate([own_pose(path) for path in paths]), f"T_world_camera of {folder}/*.npz"
    else:
        raise ValueError(f"{folder} has {len(paths)} files *{suffix} and neither of {', '.join(POSES)}: {GIVES_POSES}")
    if suffix == ".npz":
        unread = tuple(name for name in names_in(paths[0]) if name not in (*KEYS, "T_world_camera"))
        read_npz, files = (lambda row: read_npz_view(paths[row])), paths + lists
        return Predictions("npz", names, poses, source, read_npz, files, True, whole_image, unread=unread)
    given = load_json(lists[0]).get("intrinsics") if lists[0].suffix == ".json" else None
    intrinsics = None if given is None else as_intrinsics(given, f"{lists[0]}: intrinsics")
    png = partial(read_depth, depth_scale=units_per_metre)
    load = {".exr": arrays.load_exr, ".npy": arrays.load_npy, ".png": png}[suffix]

    def read(row: int) -> View:
        return as_view(str(paths[row]), load(paths[row]), None, intrinsics)

    return Predictions(suffix[1:], names, poses, source, read, paths + lists, True, whole_image)


def own_pose(path: Path) -> np.ndarray:
    """The pose (1, 4, 4) of an .npz."""
    if "T_world_camera" not in names_in(path):
        load_npz(path)  # where it is no .npz at all
        raise ValueError(f"{path} lacks T_world_camera; it has {', '.join(names_in(path))}: {GIVES_POSES}")
    return as_poses(load_npz(path, ("T_world_camera",))["T_world_camera"][None], f"{path}: T_world_camera")


def read_npz_view(path: Path) -> View:
    found = load_npz(path, (), KEYS)
    if ("depth" in found) == ("points" in found):
        raise ValueError(f"{path} must have depth or points, one of them; it has {', '.join(names_in(path))}")
    key = "depth" if "depth" in found else "points"
    if found[key].shape[2:] not in (((), (1,)) if key == "depth" else ((3,),)):
        raise ValueError(f"{path}: {key} must be (h, w{', 3' * (key == 'points')}), got {found[key].shape}")
    given = found.get("intrinsics")
    intrinsics = None if given is None else as_intrinsics(given, f"{path}: intrinsics")
    return as_view(f"{path}: {key}", found[key], found.get("confidence"), intrinsics)


def _order(times: np.ndarray, names: list[str], path: Path) -> np.ndarray:
    """Line of a list of poses for each file: by the number in its name if all have one, else in order."""
    numbers = [last_number(name) for name in names]
    if None not in numbers and len({*numbers}) == len(names) and sorted(times) == sorted(numbers):
        line = {time: row for row, time in enumerate(times)}
        return np.array([line[number] for number in numbers])
    if (np.diff(times) < 0).any():
        raise ValueError(
            f"{path} is not in order of time, and its times are not the numbers in the names of the files, so which "
            f"pose is whose is not known: write the lines in the order {', '.join(names[:3])}, …, or give poses.json"
        )
    return np.arange(len(names))


def _listed_poses(path: Path, names: list[str]) -> np.ndarray:
    """Read a list of poses in the order of `names`: TUM's format by rows, JSON by name."""
    if path.suffix == ".txt":
        times, poses = load_trajectory_tum(path, may_lack=True)
        if len(poses) != len(names):
            raise ValueError(
                f"{path} has {len(poses)} poses for {len(names)} files: it must have one for each, in the order of "
                "their names; or give poses.json, which has them by name"
            )
        return as_poses(poses[_order(times, names, path)], str(path))
    given = load_json(path)
    given = given.get("T_world_camera") if isinstance(given, dict) else None
    if not isinstance(given, dict):
        raise ValueError(f'{path} must hold {{"T_world_camera": {{"name of the file without suffix": [[...], ...]}}}}')
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"{path} lacks T_world_camera of {len(missing)} of {len(names)} files, first {missing[0]}")
    rows = [np.full((4, 4), np.nan) if given[name] is None else given[name] for name in names]
    return np.concatenate(
        [as_poses([row], f"{path}: T_world_camera of {name}") for name, row in zip(names, rows, strict=True)]
    )
