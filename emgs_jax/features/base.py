"""Interface of a feature model: unit vectors for the cells of an image, in the space of its text embeddings."""

import abc
from functools import cached_property

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.features.text import TextEmbeddings, load_text


class FeatureModel(abc.ABC):
    """Describes parts of an image by vectors that text can be compared with; loads weights when first needed."""

    identity: dict  # of the vector space: features are compared only with embeddings of the same identity
    settings: dict  # what else the features depend on, for provenance; JSON values
    _classes: tuple[str, ...]  # names to embed, or to choose from the file
    _file: str | None  # of `experiments.embed`, in place of a text encoder

    @cached_property
    def text(self) -> TextEmbeddings:
        """The classes' embeddings, from the text encoder or from the file."""
        return self.embed(self._classes) if self._file is None else load_text(self._file, self.identity, self._classes)

    @abc.abstractmethod
    def embed(self, names: tuple[str, ...]) -> TextEmbeddings:
        """Embed the names with the text encoder."""

    def check(self, dataset: Dataset) -> None:  # noqa: B027
        """Raise ValueError if the model cannot describe the frames of the data set."""

    @abc.abstractmethod
    def extract(self, frame: Frame) -> np.ndarray:
        """Features (y, x, f), float16, unit or zero, of a grid of cells that cover the image."""
