"""Features without weights, for tests: a random projection of local colours, and random text embeddings."""

from collections.abc import Sequence

import cv2
import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.text import TextEmbeddings, average_over_templates, check_templates, random_embeddings


class RandomFeatures(FeatureModel):
    """Projects the mean colour of each cell of `cell` pixels a side; text embeddings are unrelated to colours."""

    def __init__(
        self, width: int, cell: int, seed: int, classes: Sequence[str], templates: Sequence[str], text: str | None
    ) -> None:
        if width < 1 or cell < 1 or seed < 0:
            raise ValueError(f"features.width and cell must be ≥ 1 and seed ≥ 0, got {width}, {cell} and {seed}")
        check_templates(templates)
        self._width, self._cell, self._classes, self._file = width, cell, tuple(classes), text
        self._templates = tuple(templates)
        self._projection = np.random.default_rng(seed).standard_normal((width, 4)).astype(np.float32)
        self.identity = {"name": "random", "version": 1, "width": width, "seed": seed}
        self.settings = {"cell": cell}

    def embed(self, names: tuple[str, ...]) -> TextEmbeddings:
        """Pseudo-random vectors that depend on the prompts only."""
        vectors = np.zeros((0, self._width), np.float32)
        if names:
            encode = lambda prompts: random_embeddings(prompts, self._width)  # noqa: E731
            vectors = average_over_templates(names, self._templates, encode)
        return TextEmbeddings(tuple(names), vectors, self._templates, self.identity)

    def extract(self, frame: Frame) -> np.ndarray:
        """The unit projection of (r, g, b, 1) of each cell's mean colour in [0, 1], float16 (y, x, f)."""
        image = frame.image
        height, width = image.shape[:2]
        cells = max(round(width / self._cell), 1), max(round(height / self._cell), 1)
        colors = cv2.resize(image.astype(np.float32) / np.float32(255), cells, interpolation=cv2.INTER_AREA)
        # einsum and not @, whose sums depend on the number of BLAS threads.
        features = np.einsum("yxc,fc->yxf", colors, self._projection[:, :3]) + self._projection[:, 3]
        return (features / np.linalg.norm(features, axis=-1, keepdims=True)).astype(np.float16)
