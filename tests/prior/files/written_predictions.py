"""The tiny room's frames with files of their images, and its truth as one's own files."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_run

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.prior.base import PriorPrediction, windows
from emgs_jax.prior.files.prior import Files

KEYS = {
    "scale": "auto",
    "median_depth": 2.0,
    "depth_scale": 1000.0,
    "max_depth_step": 0.03,
    "pose_std": None,
    "max_misfit": 0.1,
}


class Named(Dataset):
    """The frames of the tiny room as if they were of images on disk, whose names need not be there."""

    def __init__(self, suffix: str = ".jpg", names: list[str] | None = None) -> None:
        room = tiny_run.dataset()
        self.name, self.sequence, self.size = "images", "tiny", room.size
        self.intrinsics, self.classes, self.has_ground_truth = room.intrinsics, (), False
        self._suffix = suffix
        self.names = [f"IMG_{index + 8}" for index in range(len(room))] if names is None else names

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Frame:
        return truth()[index]

    def pose(self, index: int) -> None:
        return None

    def files(self, index: int) -> list[Path]:
        return [Path(self.names[index] + self._suffix)]

    def fingerprint(self) -> str:
        return " ".join(self.names)


NAMES = Named().names


@cache
def truth() -> list[Frame]:
    return [tiny_run.dataset()[index] for index in range(tiny_run.NUM_FRAMES)]


def write_npz(folder: Path, names: list[str], **changes) -> Path:
    """One .npz a frame; `changes`: key -> function of the frame, or None to leave the key out."""
    folder.mkdir(exist_ok=True)
    keys = {"depth": lambda f: f.depth, "T_world_camera": lambda f: f.T_world_camera} | changes
    for name, frame in zip(names, truth(), strict=True):
        np.savez(folder / f"{name}.npz", **{key: value(frame) for key, value in keys.items() if value is not None})
    return folder


def asked(folder: Path, data: Named | None = None, **keys) -> tuple[Files, list[PriorPrediction]]:
    """The prior, checked, and its answers to all windows of the tiny run."""
    data = Named() if data is None else data
    prior = Files(folder, **(KEYS | keys))
    prior.check(data, tiny_run.WINDOW_SIZE)
    calls = windows(range(len(data)).__contains__, tiny_run.WINDOW_SIZE)
    return prior, [prior.predict(call, [data[i] for i in call.views], data.intrinsics) for call in calls]


def by_frame(predictions: list[PriorPrediction]) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points, mask and confidence of each frame, from its last answer."""
    return {
        index: (prediction.points[row], prediction.mask[row], prediction.confidence[row])
        for prediction in predictions
        for row, index in enumerate(prediction.window.dense)
    }


def write_depths(folder: Path, suffix: str) -> None:
    folder.mkdir()
    for name, frame in zip(NAMES, truth(), strict=True):
        path = folder / f"{name}{suffix}"
        if suffix == ".png":
            cv2.imwrite(str(path), np.rint(frame.depth * 1000).astype(np.uint16))
        elif suffix == ".npy":
            np.save(path, frame.depth)
        else:
            openexr = pytest.importorskip("OpenEXR")
            header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
            with openexr.File(header, {"Z": frame.depth}) as file:
                file.write(str(path))
