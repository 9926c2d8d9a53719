"""Base of a feature model: unit vectors of the cells of an image, in the space of its text embeddings."""

import abc
from functools import cached_property

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.features.text import TextEmbeddings, load_text


class FeatureModel(abc.ABC):
    """Anything that describes the parts of an image by vectors that text can be compared with.

    Construction checks what it can without reading weights; they are loaded when they are first needed.
    """

    identity: dict  # of the space: embeddings of another model must not be compared with its features
    settings: dict  # what else the features depend on, for provenance; plain JSON values
    _classes: tuple[str, ...]  # names to embed, or to choose from the file
    _file: str | None  # of `experiments.embed`; with it no text encoder is needed

    @cached_property
    def text(self) -> TextEmbeddings:
        """The classes, from the text encoder or from the file."""
        return self.embed(self._classes) if self._file is None else load_text(self._file, self.identity, self._classes)

    @abc.abstractmethod
    def embed(self, names: tuple[str, ...]) -> TextEmbeddings:
        """Embed the names with the text encoder."""

    def check(self, dataset: Dataset) -> None:  # noqa: B027
        """Raise ValueError where it cannot describe the frames of the data set; here all that is needed are images."""

    @abc.abstractmethod
    def extract(self, frame: Frame) -> np.ndarray:
        """Return features (y, x, f), float16, unit or zero, of a grid of cells that cover the frame's image."""
