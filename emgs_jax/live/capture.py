"""Images as they come: from a camera, an address of a stream, or a recording that is played in real time.

A thread waits for the images, and `Newest` keeps one until the map takes it.
"""

import itertools
import os
import threading
import time
from collections.abc import Generator, Iterator
from functools import partial
from pathlib import Path

import cv2

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.images import listed
from emgs_jax.data.tones import read_shown
from emgs_jax.data.video import VIDEO_SUFFIXES, Video
from emgs_jax.io.npz import read_npz
from emgs_jax.live.newest import Newest, Shot, Unread

# Streams over TCP, each image as it comes: otherwise OpenCV lags by seconds (opencv#13145).
OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
RTSP_OPTIONS = "rtsp_transport;tcp|fflags;nobuffer|flags;low_delay"
ERRORS = OSError, ValueError, cv2.error  # of reading an image
GIVEN = ("depth", "T_world_camera", "intrinsics", "confidence")  # arrays beside an image, as in files of prior=files


def start(source: str | Iterator[Shot], into: Newest, needs_camera: bool = False) -> Calibration | None:
    """Open a source and offer its images to `into`, from a thread; ValueError if it cannot be opened.

    Returns the camera if that is needed and the source tells it.
    """
    if isinstance(source, str) and is_ros(source):
        from emgs_jax.live.ros import subscribe  # an extra

        return subscribe(source.split()[1:], into, needs_camera)
    shots = open_source(source, into) if isinstance(source, str) else source
    into.fill(partial(_offer, shots, name_of(source), into), f"camera {name_of(source)}")
    return None


def name_of(source: str | Iterator[Shot]) -> str:
    """Name a source in messages."""
    return source if isinstance(source, str) else "iterator"


def is_ros(source: str) -> bool:
    """Test whether a source is the word "ros" and remappings of topics."""
    return source.split()[:1] == ["ros"]


def _offer(shots: Iterator[Shot | Unread], name: str, into: Newest) -> None:
    try:
        for shot in shots:
            if not into.put(shot):
                return
        into.end(f"camera {name} has ended")
    except Exception as error:  # whatever it is, no more will come
        into.end(f"camera {name} has failed: {str(error) or type(error).__name__}")
    finally:
        if isinstance(shots, Generator):
            shots.close()


def open_source(source: str, into: Newest) -> Iterator[Shot | Unread]:
    """Open a camera by its number or device, the address of a stream, a video or a recorded folder."""
    path = Path(source).expanduser()
    is_video = path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()
    if path.is_dir() or is_video:
        into.can_wait = True
        return _paced(_of_video(Video(path)) if is_video else _recorded(path, into), into.begun)
    capture = _stream(source) if "://" in source else cv2.VideoCapture(int(source) if source.isdecimal() else source)
    if not capture.isOpened():
        devices = ", ".join(str(device) for device in sorted(Path("/dev").glob("video*"))) or "none"
        raise ValueError(
            f"camera {source} cannot be opened: it is not there, or another program holds it (devices: {devices}; "
            "camera:1 is the second, camera:rtsp://… a stream, camera:FILE a video played in real time)"
        )
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return _of_device(capture)


def _stream(address: str) -> cv2.VideoCapture:
    """Open a stream without a buffer, as its options alone are: a video loses its first frame by them."""
    if OPTIONS in os.environ:  # a user's own
        return cv2.VideoCapture(address)
    os.environ[OPTIONS] = RTSP_OPTIONS
    try:
        return cv2.VideoCapture(address)
    finally:
        del os.environ[OPTIONS]


def _of_device(capture: cv2.VideoCapture) -> Iterator[Shot]:
    """Yield the images of a camera; ValueError if there is none: one that is held by another program can be opened."""
    try:
        for number in itertools.count():
            is_read, image = capture.read()
            if not is_read and number == 0:
                raise ValueError("it is there and gives no image, as where another program holds it")
            if not is_read:
                return
            yield Shot(time.time(), cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    finally:
        capture.release()


def _of_video(video: Video) -> Iterator[tuple[float, Shot]]:
    """Yield all images: a video that skips some decodes them anyway."""
    for row, seconds in enumerate(video.times):
        yield seconds, Shot(seconds, video.read(row))


def _recorded(folder: Path, into: Newest) -> Iterator[tuple[float, Unread]]:
    """The images of a folder, by the times in their names; the first that cannot be read ends them."""
    for path, seconds in zip(*listed(folder)[:2], strict=True):

        def read(path: Path = path, seconds: float = seconds) -> Shot:
            try:
                return _read(path, seconds)
            except ERRORS as error:
                into.end(f"camera {folder} has failed: {error}")
                raise BadFrameError(str(error)) from error

        yield seconds, read


def _read(path: Path, seconds: float) -> Shot:
    """Read an image with what is beside it."""
    image, beside = read_shown(path, None, None), path.with_suffix(".npz")
    given = None
    if beside.is_file():
        with beside.open("rb") as handle:
            given = read_npz(handle, (), GIVEN, may_be_compressed=True)
    return Shot(seconds, image, given)


def _paced(shots: Iterator[tuple[float, Shot | Unread]], begun: threading.Event) -> Iterator[Shot | Unread]:
    """Yield the first image, and the others at the pace of their times once images are wanted."""
    for number, (seconds, shot) in enumerate(shots):
        if number == 0:
            first = seconds
        elif number == 1:
            begun.wait()
            begin = time.monotonic()
        if number:
            time.sleep(max(begin + seconds - first - time.monotonic(), 0.0))
        yield shot
