"""Read the frames of a video file, whose header is often wrong about their number and rate."""

import math
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from emgs_jax.data.base import BadFrameError

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
MIN_ASPECT = 0.2  # of a pixel; less means a damaged header


class Video:
    """A video up to frame `stop`, read from its beginning, as seeking lands on a nearby key frame with many codecs.

    `times` are the seconds of each readable frame, `count` is the number of all, beyond `stop` by the header; `notes`
    describe a wrong header and pixels that are not square.
    """

    def __init__(self, path: Path, stop: int | None = None) -> None:
        self._path, self._capture = path, open_video(path)
        announced = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.times = _times(self._capture, stop)
        count = self._next = len(self.times)  # _next: the frame that the capture gives next
        if not count:
            raise ValueError(self._nothing_decoded())
        self.count = count if stop is None or not math.isfinite(announced) else max(count, int(announced))
        is_short = math.isfinite(announced) and count < (announced if stop is None else min(announced, stop))
        self.notes = [f"{path} announces {announced:.0f} frames, {count} can be read"] if is_short else []
        self._aspect = _pixel_aspect(self._capture)
        if self._aspect != 1:
            (height, width), shown = self._decoded(0).shape[:2], self.read(0).shape[1]
            self.notes.append(
                f"pixels of {path} are {self._aspect:.4g} times as wide as high: its {width}x{height} frames are shown "
                f"as {shown}x{height}, to which intrinsics refer"
            )

    def _nothing_decoded(self) -> str:
        code = int(self._capture.get(cv2.CAP_PROP_FOURCC))
        codec = "".join(chr(code >> shift & 255) for shift in (0, 8, 16, 24)).strip("\0 ")
        return (
            f"{self._path}: none of its frames can be decoded, by OpenCV and as {codec or 'its codec'} (AV1 is read by "
            "few): convert it to h264 (ffmpeg -i VIDEO -c:v libx264 NEW.mp4) or to images"
        )

    def read(self, row: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """The frame with square pixels, as a player shows it."""
        image = self._decoded(row)
        height, width = image.shape[:2]
        return image if self._aspect == 1 else cv2.resize(image, (max(round(width * self._aspect), 1), height))

    def _decoded(self, row: int) -> UInt8[np.ndarray, "_ _ 3"]:
        if row < self._next:
            self._capture, self._next = open_video(self._path), 0
        while self._next < row and self._capture.grab():
            self._next += 1
        is_read, image = self._capture.read() if self._next == row else (False, None)
        if not is_read or image is None:
            if not self._next:
                raise ValueError(self._nothing_decoded())
            raise BadFrameError(
                f"{self._path}, frame {row} cannot be read, the video ends or is damaged after frame {self._next - 1}: "
                f"set dataset.stop={self._next}"
            )
        self._next += 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def announced(path: Path) -> int:
    """The number of frames in a video's header; 0 if it has none."""
    count = open_video(path).get(cv2.CAP_PROP_FRAME_COUNT)
    return int(count) if math.isfinite(count) and count > 0 else 0


def open_video(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        reason = damage(path) or "no video that OpenCV can open: convert it to mp4 (h264) or to images"
        raise ValueError(f"{path} is {reason}")
    return capture


def _pixel_aspect(capture: cv2.VideoCapture) -> float:
    """Width of a decoded pixel over its height; 1 if the file does not tell."""
    across, down = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if not (across > 0 and down > 0 and MIN_ASPECT <= across / down <= 1 / MIN_ASPECT):
        return 1.0
    return down / across if capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90 else across / down


def damage(path: Path) -> str | None:
    """Describe the damage of a video file, None if none is found: cut off mp4 and mov files lack the last box, moov."""
    remedy = "copy it again from where it was recorded; no program can convert it as it is"
    size = path.stat().st_size
    if not size:
        return f"empty: {remedy}"
    with open(path, "rb") as file:
        begin, names = 0, []
        while begin + 8 <= size:
            file.seek(begin)
            length, name = struct.unpack(">I4s", file.read(8))
            if length == 1:
                length = int.from_bytes(file.read(8), "big")
            names.append(name)
            begin = size if length == 0 else begin + max(length, 8)
    is_mp4 = names[:1] == [b"ftyp"]
    return f"not whole, the recording or the copy was cut off: {remedy}" if is_mp4 and b"moov" not in names else None


def _times(capture: cv2.VideoCapture, stop: int | None) -> list[float]:
    """Seconds of each frame, to the end or to `stop`, as the rate may change within a video.

    Without ascending times (a bare h264 stream) they are frame numbers divided by the nominal rate, or by 1.
    """
    times = []
    while (stop is None or len(times) < stop) and capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    is_time = np.isfinite(times).all() and (np.diff(times) >= 0).all() and (len(times) < 2 or times[-1] > times[0])
    if is_time:
        return times
    rate = capture.get(cv2.CAP_PROP_FPS)
    return [row / (rate if math.isfinite(rate) and rate > 0 else 1.0) for row in range(len(times))]
