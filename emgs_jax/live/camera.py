"""Frames of a camera while it runs: a data set whose end is not known.

Each image that is taken becomes a file, with what came beside it (depth, pose) in an .npz of its name: so a run's
memory is bounded, and the same command on the folder maps the same frames again (`prior=stream`).
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import wait_for_all
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.images import Images
from emgs_jax.data.intrinsics import Given, Pictures, find_lens
from emgs_jax.data.reading import Size, about_pixels
from emgs_jax.data.straightened import Straightened
from emgs_jax.io.files import atomic_write
from emgs_jax.live.capture import start
from emgs_jax.live.newest import Newest, Shot

RECORDED = "recorded"  # folder of a run
FIRST_S, NEXT_S = 30.0, 10.0  # longest wait for the first image, and for each other one
NUM_TIMED = 20  # frames of which the bar tells the rate
FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
NO_INTRINSICS = (
    "dataset.intrinsics is not set: give [fx,fy,cx,cy] in pixels of the camera's images, or a calibration file. "
    "dataset.intrinsics=estimate finds them once all images are taken (emgs run camera); its metrics.json has them "
    "then (provenance, data, camera)"
)


@dataclass(eq=False)
class Camera(Straightened):
    """The newest images of a camera, a stream, or a recording that is played in real time, see `capture.open_source`.

    `len` counts the frames that were taken; `has` waits for the next one. Nothing is known of the truth.
    """

    source: str | int = 0  # 0, 1, /dev/video0, rtsp://…, a video, or a recorded folder
    intrinsics: Given | None = None  # see `intrinsics.find_lens`; to estimate them, all images are taken first
    size: Sequence[int] | None = None  # (width, height) of the frames; None: about 320 x 240 pixels
    fps: float | None = None  # most images a second; None: as many as are asked for
    max_frames: int | None = None
    max_seconds: float | None = None  # from the first image on
    record: bool = False  # keep the images in `folder`/recorded; otherwise they are deleted with this object
    folder: Path | None = None  # of the run

    name = "camera"

    def __post_init__(self) -> None:
        self._newest, self._is_over = Newest(), False
        self._images, self._times, self._arrived, self._mapped = [], [], [], []
        self.sequence, self._given = str(self.source), self.intrinsics  # `_use` replaces the latter
        if self._given in (None, "exif") and not self.sequence.startswith("ros"):
            raise ValueError(NO_INTRINSICS)
        self._folder = self._new_folder()
        told = start(self.sequence, self._newest)
        self._given = numbers_of(told) if self._given is None and told is not None else self._given
        if self._given is None:
            raise ValueError(NO_INTRINSICS)
        shot = self._newest.take(FIRST_S)
        if shot is None:
            raise ValueError(self._newest.reason or self._said(f"gives no image in {FIRST_S:g} s"))
        self._begin, self._raw_size = shot.arrived, shot.image.shape[1::-1]
        self.size = about_pixels(*self._raw_size) if self.size is None else self.size
        self._lens = None
        if callable(self._given):
            self._add(shot)
            wait_for_all(self)
        name = f"images of camera {self.source}"
        pictures = Pictures(self._raw_size, max(len(self), 1), self._read, [*self._images], name)
        self._use(find_lens(self._given, pictures), self._raw_size, f"{as_words(self._raw_size)}, {name}")
        if not self._images:
            self._add(shot)

    def _said(self, words: str) -> str:
        """What the camera does, with the last problem of its images."""
        problem = self._newest.problem
        return f"camera {self.source} {words}" + (f": {problem}" if problem else "")

    def _new_folder(self) -> Path:
        if not self.record:
            self._temporary = tempfile.TemporaryDirectory(prefix="emgs_camera_")  # deleted with this object
            return Path(self._temporary.name)
        if self.folder is None:
            raise ValueError("dataset.record=true needs the folder of a run: give Camera its folder")
        folder = self.folder / RECORDED
        if folder.exists():
            raise ValueError(f"{folder} holds an earlier recording: give hydra.run.dir=ANOTHER, or move it away")
        folder.mkdir(parents=True)
        return folder

    def _add(self, shot: Shot) -> None:
        """Write an image, and what came with it, under its time."""
        time_s = shot.time
        if self._times and time_s <= self._times[-1]:  # a clock that was set back, or is coarse
            time_s = self._times[-1] + 1e-6
        path = self._folder / f"{time_s:.6f}.png"
        if shot.given:
            given = dict(shot.given)
            if self._lens is not None and given.get("depth", np.zeros(0)).shape == shot.image.shape[:2]:
                given["depth"] = self._lens.straighten_depth(given["depth"])  # it is registered to the image
            with atomic_write(path.with_suffix(".npz")) as handle:
                np.savez(handle, **given)
        with atomic_write(path) as handle:
            handle.write(cv2.imencode(".png", cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR), FAST)[1])
        self._images.append(path)
        self._times.append(float(path.stem))
        self._arrived.append(shot.arrived)

    def has(self, index: int) -> bool:
        while len(self) <= index:
            shot = self._next()
            if shot is None:
                if not self._is_over:
                    tqdm.write(f"no more images: {self._newest.reason}")
                self._is_over = True
                return False
            self._add(shot)
        return True

    def _next(self) -> Shot | None:
        """Wait for the next image in use; None after the last one, for the reason that `_newest` has."""
        while True:
            if self.max_frames is not None and len(self) >= self.max_frames:
                self._newest.end(f"dataset.max_frames={self.max_frames} are taken")
                return None
            if self.max_seconds is not None and time.monotonic() - self._begin > self.max_seconds:
                self._newest.end(f"dataset.max_seconds={self.max_seconds:g} have passed")
                return None
            shot = self._newest.take(NEXT_S)
            if shot is None:
                self._newest.end(self._said(f"has given none for {NEXT_S:g} s"))
                return None
            if shot.image.shape[1::-1] != self._raw_size:
                was, now = as_words(self._raw_size), as_words(shot.image.shape[1::-1])
                self._newest.end(f"camera {self.source} gave {was}, and now {now}")
                return None
            if not self.fps or shot.arrived - self._arrived[-1] >= 1 / self.fps:
                return shot

    def begin(self) -> None:
        """Begin with the newest image: the first one came before the programs were compiled."""
        shot = self._newest.take(NEXT_S) if len(self) == 1 and self.total is None else None
        if shot is None or shot.image.shape[1::-1] != self._raw_size:
            return
        for path in (self._images[0], self._images[0].with_suffix(".npz")):
            path.unlink(missing_ok=True)
        self._images, self._times, self._arrived = [], [], []
        self._begin, self._newest.num_dropped = shot.arrived, 0
        self._add(shot)

    @property
    def total(self) -> int | None:
        return None if self._newest.reason is None else len(self)

    def number(self, index: int) -> int:
        return index

    def progress_words(self, index: int) -> str:
        self._mapped.append(time.monotonic())
        recent = self._mapped[-NUM_TIMED:]
        rate = (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)
        behind = recent[-1] - self._arrived[index]
        return f"{rate:.1f} maps/s, {self._newest.num_dropped} dropped, {behind:.1f} s behind"

    def report(self) -> dict[str, float]:
        behind = np.array(self._mapped) - np.array(self._arrived[: len(self._mapped)])
        seconds = self._arrived[-1] - self._begin
        return {
            "camera/num_dropped": float(self._newest.num_dropped),
            "camera/frames_per_second": (len(self) - 1) / seconds if seconds > 0 else float("nan"),
            "camera/median_latency_s": float(np.median(behind)) if len(behind) else float("nan"),
        }

    def recording(self) -> dict[str, Any] | None:
        """Return the settings of `Images` that read the recorded frames; None if they are not kept."""
        if not self.record:
            return None
        of_folder = {"_target_": "emgs_jax.data.images.Images", "root": str(self._folder.resolve()), "sequence": None}
        intrinsics = "estimate" if callable(self._given) else self._given
        return of_folder | {"intrinsics": intrinsics, "start": 0, "stop": None, "stride": 1, "size": [*self.size]}

    def fingerprint(self) -> str:
        """Hex digest of the frames so far, as of a folder of images."""
        return Images(str(self._folder), size=self.size, intrinsics=self._given).fingerprint()

    def _place(self, index: int) -> tuple[float, str]:
        return self._times[index], str(self._images[index])


def as_words(size: Size) -> str:
    """Name images by their (width, height)."""
    return f"images of {size[0]}x{size[1]}"


def numbers_of(camera: Calibration) -> list[float]:
    """Write a camera as `dataset.intrinsics`; ValueError for a lens that needs a calibration file."""
    if camera.model != "OPENCV":
        raise ValueError(f"the lens is {camera.model}: take the rectified topic, or give dataset.intrinsics")
    return [*camera.intrinsics, *camera.distortion]
