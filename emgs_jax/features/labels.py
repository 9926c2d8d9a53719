"""Features from the class images of any segmentation network: each class has a vector."""

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from emgs_jax.data import reading
from emgs_jax.data.base import BadFrameError, Dataset, Frame
from emgs_jax.data.labels import LabelFolder, as_unknown
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.text import TextEmbeddings, read_text

MAX_CHANNELS = 128  # CV_CN_MAX of OpenCV 5; 4 has 512
MAX_ENLARGED = 32  # times; a network gives a class for each of its patches at least


class LabelFeatures(FeatureModel):
    """Reads the classes of each image: a pixel has the vector of its class, or with scores their unit weighted mean.

    Args:
        folder: for every image STEM.* STEM.png with class ids (see `LabelFolder`), or STEM.npy with scores of at least
            0, (h, w, classes), in the order of `names`.
        unknown: ids that mean no class, see `LabelFolder`.
        text: file of `experiments.embed` with the names' embeddings; None: each class has an axis of its own.
    """

    def __init__(self, folder: str, names: str, unknown: Sequence[int] | None = None, text: str | None = None) -> None:
        ids = as_unknown(unknown, "features.unknown")
        self._labels = LabelFolder(Path(folder).expanduser(), Path(names).expanduser(), ids, "features.unknown")
        self._names_file, self._file = names, text
        self.settings = {"folder": Path(folder).name, "unknown": None if ids is None else [*ids]}

    @property
    def identity(self) -> dict:
        return self.text.model

    @cached_property
    def text(self) -> TextEmbeddings:
        names = self._labels.names
        if self._file is None:
            model = {"name": "labels", "version": 1, "classes": [*names]}
            return TextEmbeddings(names, np.eye(len(names), dtype=np.float32), (), model)
        found = read_text(self._file)
        if missing := found.missing(names):
            raise ValueError(
                f"features.text={self._file} has no embedding of {missing[:5]} of {self._names_file}: write it with "
                "`python -m experiments.embed` for these names"
            )
        return found.only(names)

    def embed(self, names: tuple[str, ...]) -> TextEmbeddings:
        """The vectors of these classes; ValueError if one has none."""
        if unknown := self.text.missing(names):
            raise ValueError(f"{unknown} are no classes of {self._names_file}, which has {', '.join(self.text.names)}")
        return self.text.only(names)

    def check(self, dataset: Dataset) -> None:
        """Raise ValueError if a frame has no file, or the data set straightens the images that were segmented."""
        images = [str(files[0]) for i in range(len(dataset)) if (files := dataset.files(i))]
        missing = [name for name in images if not self._file_of(name).is_file()]
        if missing:
            raise ValueError(
                f"{self._file_of(missing[0])} does not exist, nor do those of {len(missing)} of {len(dataset)} images: "
                "features.folder must hold a class image (PNG) or scores (.npy) of the name of every image in use"
            )
        twice = [name for name, count in Counter(Path(name).stem for name in {*images}).items() if count > 1]
        if twice:
            raise ValueError(
                f"images of several folders have the name {twice[0]}, and classes have one folder: map the images of "
                "one folder, or give each a name of its own"
            )
        if any(dataset.calibration.get("distortion") or ()):
            raise ValueError(
                f"{dataset.name} straightens its images, and the classes of {self._labels.folder} are of the distorted "
                "ones: straighten both beforehand and give the intrinsics of the straight ones"
            )

    def extract(self, frame: Frame) -> np.ndarray:
        """Features (h, w, f), float16, at the frame's size; zero without a class."""
        path = self._file_of(frame.name)
        vectors, size = self.text.vectors, frame.image.shape[1::-1]
        if path.suffix == ".npy":
            scores = _read_scores(path, len(vectors))
            _check_shape(scores.shape[1::-1], size, path)
            features = _resize_scores(scores, size) @ vectors
            features /= np.maximum(np.linalg.norm(features, axis=-1, keepdims=True), 1e-12)
            return features.astype(np.float16)
        labels = self._labels.read(frame.name)
        _check_shape(labels.shape[::-1], size, path)
        labels = reading.resize_nearest(labels, size)
        return np.vstack([vectors, np.zeros_like(vectors[:1])]).astype(np.float16)[labels]

    def _file_of(self, image: str) -> Path:
        scores = self._labels.folder / f"{Path(image).stem}.npy"
        return scores if scores.is_file() else self._labels.path(image)


def _check_shape(found: tuple[int, int], size: tuple[int, int], path: Path) -> None:
    """Raise BadFrameError if labels have not the aspect of the image, up to half a pixel, or are too coarse."""
    (w, h), (width, height) = found, size
    if abs(w * height - h * width) > max(w, h, width, height):
        raise BadFrameError(
            f"{path} is {w}x{h}, which is not the aspect of the {width}x{height} frame: give labels of the whole image"
        )
    if min(w, h) * MAX_ENLARGED < min(width, height):
        raise BadFrameError(f"{path} is {w}x{h}, too coarse for a frame of {width}x{height}: give larger ones")


def _resize_scores(scores: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize scores (h, w, c), as many channels at once as OpenCV takes; it drops the axis of a single one."""
    parts = np.split(scores, range(MAX_CHANNELS, scores.shape[2], MAX_CHANNELS), axis=-1)
    resized = [cv2.resize(part, size, interpolation=cv2.INTER_AREA).reshape(*size[::-1], -1) for part in parts]
    return np.concatenate(resized, axis=-1)


def _read_scores(path: Path, num_classes: int) -> np.ndarray:
    try:
        # Mapped, so that a header that announces too much is an error and not a large array.
        scores = np.lib.format.open_memmap(path, mode="r")
    except (ValueError, OSError, EOFError) as error:
        raise BadFrameError(f"{path} is no array of scores, or damaged ({error}): write it again") from error
    if scores.ndim != 3 or scores.shape[2] != num_classes or scores.dtype.kind not in "fiu" or scores.size == 0:
        raise BadFrameError(
            f"{path} must hold scores (h, w, {num_classes}), one a class, got {scores.dtype} {scores.shape}"
        )
    scores = scores.astype(np.float32)
    if not (np.isfinite(scores).all() and (scores >= 0).all()):
        raise BadFrameError(f"{path} has scores that are negative or not finite: give probabilities")
    return scores
