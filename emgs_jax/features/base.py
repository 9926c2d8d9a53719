"""Interface of a feature model: unit vectors of the cells of an image, in the space of its text embeddings."""

from typing import Protocol, runtime_checkable

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.features.text import TextEmbeddings


@runtime_checkable
class FeatureModel(Protocol):
    """Anything that describes the parts of an image by vectors that text can be compared with.

    Construction checks what it can without reading weights; they are loaded when they are first needed.
    """

    identity: dict  # of the space: embeddings of another model must not be compared with its features
    settings: dict  # what else the features depend on, for provenance; plain JSON values
    text: TextEmbeddings  # of the classes, from the text encoder or from a file of `experiments.embed`

    def embed(self, names: tuple[str, ...]) -> TextEmbeddings:
        """Embed the names with the text encoder."""
        ...

    def check(self, dataset: Dataset) -> None:
        """Raise ValueError where it cannot describe the frames of the data set."""
        ...

    def extract(self, frame: Frame) -> np.ndarray:
        """Return features (y, x, f), float16, unit or zero, of a grid of cells that cover the frame's image."""
        ...
