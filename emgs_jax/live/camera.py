"""Frames of a camera while it runs: a data set whose end is not known.

Each image that is taken becomes a file, with what came beside it (depth, pose) in an .npz of its name: so a run's
memory is bounded, and the same command on the folder maps the same frames again (`prior=stream`).
"""

import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm

from emgs_jax.data.base import Rates, wait_for_all
from emgs_jax.data.images import Images
from emgs_jax.data.intrinsics import Given, Pictures, find_lens, to_lens
from emgs_jax.data.reading import Size, about_pixels
from emgs_jax.data.straightened import Straightened
from emgs_jax.io.files import atomic_write, write_file
from emgs_jax.live.capture import is_ros, name_of, start
from emgs_jax.live.newest import Newest, Shot

RECORDED = "recorded"  # folder of a run
CAMERA_FILE = "camera.json"  # the intrinsics of the images there, for dataset.intrinsics; not where they are estimated
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

    source: str | int | Iterator[Shot] = 0  # 0, 1, /dev/video0, rtsp://…, a video, a recorded folder, or your images
    intrinsics: Given | None = None  # see `intrinsics.find_lens`; to estimate them, all images are taken first
    size: Sequence[int] | None = None  # (width, height) of the frames; None: about 320 x 240 pixels
    fps: float | None = None  # most images a second; None: as many as are asked for
    max_frames: int | None = None
    max_seconds: float | None = None  # from the first image on
    record: bool = False  # keep the images in `folder`/recorded; otherwise they are deleted with this object
    folder: Path | None = None  # of the run

    name = "camera"

    def __post_init__(self) -> None:
        self._newest, self._is_over, self._is_live = Newest(), False, False
        self._images, self._times, self._arrived, self._mapped = [], [], [], []
        self._rates: Rates | None = None
        source = self.source if isinstance(self.source, Iterator) else str(self.source)
        self.source = self.sequence = name_of(source)
        self._given = self.intrinsics  # `_use` replaces it
        if self._given == "exif" or (self._given is None and not is_ros(self.sequence)):
            raise ValueError(NO_INTRINSICS)
        self._folder = self._new_folder()
        told = start(source, self._newest, needs_camera=self._given is None)
        shot = self._newest.take(FIRST_S)
        if shot is None:
            raise ValueError(self._newest.reason or self._said(f"gives no image in {FIRST_S:g} s"))
        self._begin, self._raw_size = shot.arrived, shot.image.shape[1::-1]
        self.size = about_pixels(*self._raw_size) if self.size is None else self.size
        name, self._bent = f"images of camera {self.source}", None
        if callable(self._given):
            self._add(shot)
            wait_for_all(self)
            lens = find_lens(self._given, Pictures(self._raw_size, len(self), self._read, [*self._images], name))
        else:  # what is written has no distortion
            pictures = Pictures(self._raw_size, 1, lambda _: shot.image, name=name)
            lens = self._bent = (
                find_lens(self._given, pictures)
                if told is None
                else to_lens(told, self._raw_size, "CameraInfo", {"source": "CameraInfo"}, name)
            )
            self._given = [*lens.intrinsics] if lens.maps is not None or told is not None else self._given
            lens = replace(lens, maps=None)
        self._use(lens, self._raw_size, f"{as_words(self._raw_size)}, {name}")
        if not self._images:
            self._add(shot)
            if self.record:
                keys = "width", "height", "fx", "fy", "cx", "cy"
                camera = dict(zip(keys, (*self._raw_size, *lens.intrinsics), strict=True))
                write_file(self._folder / CAMERA_FILE, json.dumps(camera))

    def _said(self, words: str) -> str:
        """What the camera does, with the last problem of its images."""
        problem = self._newest.problem
        return f"camera {self.source} {words}" + (f": {problem}" if problem else "")

    def _new_folder(self) -> Path:
        if not self.record:  # deleted with this object
            self._temporary = tempfile.TemporaryDirectory(prefix=f".camera.{os.getpid()}.tmp.", dir=self.folder)
            return Path(self._temporary.name)
        if self.folder is None:
            raise ValueError("dataset.record=true needs the folder of a run: give Camera its folder")
        folder = self.folder / RECORDED
        if folder.exists():
            raise ValueError(
                f"{folder} holds an earlier recording: map it (emgs run {folder}), or give hydra.run.dir=ANOTHER"
            )
        folder.mkdir(parents=True)
        return folder

    def _add(self, shot: Shot) -> None:
        """Write an image, and what came with it, under its time, without distortion."""
        time_s = round(shot.time, 6)
        if time_s < 0:
            raise ValueError(f"camera {self.source} has a time below 0 ({time_s:g} s): set its clock")
        if self._times and time_s <= self._times[-1]:  # a clock that was set back, or is coarse
            time_s = round(self._times[-1] + 1e-6, 6)
        path, image, given = self._folder / f"{time_s:.6f}.png", shot.image, dict(shot.given or {})
        if self._bent is not None and self._bent.maps is not None:
            image, given = self._bent.straighten(image), self._straight_given(given, image.shape[:2])
        elif self._bent is None and "depth" in given:
            raise ValueError("with a depth for each image dataset.intrinsics=[fx,fy,cx,cy] are needed, not estimate")
        if given:
            with atomic_write(path.with_suffix(".npz"), outlives_power=self.record) as handle:
                np.savez(handle, **given)
        with atomic_write(path, outlives_power=self.record) as handle:
            handle.write(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), FAST)[1])
        self._images.append(path)
        self._last = path, image
        self._times.append(float(path.stem))
        self._arrived.append(shot.arrived)

    def _straight_given(self, given: dict[str, np.ndarray], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """What came with an image of a lens with distortion, registered to it, without the distortion."""
        given, remedy = dict(given), "register the depth to the images, or take rectified images"
        for name in {"depth", "confidence"} & given.keys():
            if given[name].shape != shape:
                raise ValueError(
                    f"the {name} of camera {self.source} has not the size of its images, whose lens has distortion: "
                    f"{remedy}"
                )
            given[name] = self._bent.straighten_depth(given[name])
        own, known = given.pop("intrinsics", None), self._bent.about["intrinsics"]  # others hold from here on
        if own is not None and not is_camera(own, known):
            raise ValueError(
                f"the intrinsics beside an image of camera {self.source}, {own.tolist()}, are not those of the images, "
                f"{known}, whose lens has distortion: {remedy}"
            )
        return given

    def _read(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """The image on disk; the last one that was written is still here."""
        return self._last[1] if self._images[index] == self._last[0] else super()._read(index)

    def has(self, index: int) -> bool:
        self._newest.begun.set()
        while len(self) <= index:
            shot = self._next()
            if shot is not None:
                try:
                    self._add(shot)
                    continue
                except (OSError, ValueError) as error:  # such as a full disk
                    self._newest.end(str(error))
            if not self._is_over:
                tqdm.write(f"no more images: {self._newest.reason}")
            self._is_over = True
            return False
        return True

    def drop_last(self) -> None:
        """Leave out the last frame, as if it had not been taken."""
        self._remove(self._images.pop())
        self._times.pop(), self._arrived.pop()
        self._newest.num_dropped += 1

    @staticmethod
    def _remove(image: Path) -> None:
        """Remove an image, and what came with it."""
        for path in (image, image.with_suffix(".npz")):
            path.unlink(missing_ok=True)

    def _next(self) -> Shot | None:
        """Wait for the next image in use; None after the last one, for the reason that `_newest` has."""
        while True:
            if self.max_frames is not None and len(self) >= self.max_frames:
                self._newest.end(f"dataset.max_frames={self.max_frames} are taken")
                return None
            if self.max_seconds is not None and time.monotonic() - self._begin > self.max_seconds:
                self._newest.end(f"dataset.max_seconds={self.max_seconds:g} have passed")
                return None
            shot = self._newest.take(None if self._newest.can_wait else NEXT_S)
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
        self._is_live = self.total is None
        is_late = len(self) == 1 and self._is_live and not self._newest.can_wait
        self._newest.begun.set()
        shot = self._newest.take(NEXT_S) if is_late else None
        self._begin = time.monotonic()
        if shot is None or shot.image.shape[1::-1] != self._raw_size:
            self._arrived[0] = self._begin  # a recording has waited
            return
        self._remove(self._images[0])
        self._images, self._times, self._arrived = [], [], []
        self._newest.num_dropped = 0
        self._add(shot)

    @property
    def total(self) -> int | None:
        return len(self) if self._newest.is_over else None

    def number(self, index: int) -> int:
        return index

    def progress_words(self, index: int) -> str:
        if not self._is_live:  # all images were taken before
            return ""
        self._mapped.append(time.monotonic())
        recent = self._mapped[-NUM_TIMED:]
        rate = (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)
        self._rates = Rates(rate, self._newest.num_dropped, recent[-1] - self._arrived[index])
        return str(self._rates)

    @property
    def rates(self) -> Rates | None:
        return self._rates

    def report(self) -> dict[str, float]:
        if not self._is_live:
            return {}
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


def is_camera(given: np.ndarray, known: Sequence[float]) -> bool:
    """Test whether intrinsics, (4,) or a camera matrix, are fx, fy, cx, cy that are known, up to half a pixel."""
    fx, fy, cx, cy = known
    same = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]] if given.ndim == 2 else known)
    values = given[:3, :3] if given.ndim == 2 else given
    return values.shape == same.shape and bool(np.allclose(values, same, rtol=0, atol=0.5))


def as_words(size: Size) -> str:
    """Name images by their (width, height)."""
    return f"images of {size[0]}x{size[1]}"
