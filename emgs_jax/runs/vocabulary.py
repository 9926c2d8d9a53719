"""Words as vectors to compare with the features of a finished map, and errors if they do not match."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from omegaconf import DictConfig

from emgs_jax.config.configure import build
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.text import TextEmbeddings, load_text
from emgs_jax.runs.finished_run import TEXT_FILE, FinishedRun


@dataclass(frozen=True)
class Vocabulary:
    """Texts that a map can be queried for: those of `known`, or any text if there is a `model`."""

    source: str
    width: int  # of the map's features
    known: TextEmbeddings | None
    model: FeatureModel | None = None

    def embed(self, names: Sequence[str]) -> TextEmbeddings:
        """Embed names in order; raise ValueError if one has no vector or one of another width."""
        text = self._find(tuple(names)) if self.model is None else self.model.embed(tuple(names))
        if text.vectors.shape != (len(names), self.width):
            widths = f"embeddings of width {text.vectors.shape[1]}, and the map's features have width {self.width}"
            raise ValueError(f"{self.source} has {widths}: embed the words with the model that made the features")
        return text

    def _find(self, names: tuple[str, ...]) -> TextEmbeddings:
        rows = {name: row for row, name in enumerate(self.known.names)}
        for name in names:
            if name not in rows:
                near = difflib.get_close_matches(name, rows, 5, 0.4)
                there = f"the nearest are {', '.join(near)}" if near else f"there are {', '.join(list(rows)[:20])}"
                raise ValueError(
                    f"{name!r} is no word of {self.source}; {there}. For other words give embeddings "
                    "(features.text=FILE of emgs embed) or the text encoder of the features (features=…)"
                )
        vectors = self.known.vectors[[rows[name] for name in names]].reshape(len(names), -1)
        return TextEmbeddings(names, vectors, self.known.templates, self.known.model)


def feature_space(run: FinishedRun) -> dict[str, Any]:
    """Identify the model whose features a run's map holds; {"prior": name} for those of a prior without a model."""
    settings = run.provenance["prior"]["settings"]
    features = settings.get("features") if isinstance(settings, Mapping) else None
    if isinstance(features, Mapping) and isinstance(features.get("model"), Mapping):
        return dict(features["model"])
    return dict(run.text.model) if run.text is not None else {"prior": run.provenance["prior"]["name"]}


def vocabulary(run: FinishedRun, file: str | None, model: FeatureModel | None) -> Vocabulary:
    """Choose the vocabulary for a run's map: of the file, else of the model, else of the run's classes.

    Raises ValueError if the map has no features, or if file or model belong to other features; the message names both.
    """
    path = run.folder / "map.npz"
    features = np.asarray(run.map.gaussians.features)[np.asarray(run.map.gaussians.valid)]
    if not features.any():
        raise ValueError(f"{path} has no features to compare words with: map again with features=…")
    width, space = features.shape[1], feature_space(run)
    if file is not None:
        return Vocabulary(str(file), width, load_text(file, space))
    if model is not None:
        if model.identity != space:
            raise ValueError(
                f"features={model.identity.get('name')} is {model.identity}, but the features of {path} are of "
                f"{space}: choose the model that made them"
            )
        return Vocabulary(f"the model {model.identity.get('name')}", width, None, model)
    if run.text is None:
        raise ValueError(
            f"{run.folder} has no {TEXT_FILE} with words, and its features are of {space}: give embeddings "
            "(features.text=FILE of emgs embed) or the text encoder (features=…)"
        )
    return Vocabulary(str(run.folder / TEXT_FILE), width, run.text)


def feature_model(config: DictConfig, words: Sequence[str]) -> FeatureModel | None:
    """Build the text encoder of a config; None with features=none, or if `features.text` has the embeddings."""
    if "_target_" not in config.features or config.features.text is not None:
        return None
    return build(config, "features", classes=list(words))


def words_of(value: Any, key: str) -> tuple[str, ...]:
    """Return one word or a list of them as a tuple; raise ValueError if one is empty, not text or duplicated."""
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    words = list(value) if is_list else [] if value is None else [value]
    if not all(isinstance(word, str) and word.strip() for word in words) or len(set(words)) < len(words):
        raise ValueError(f"{key} must be a word or a list of words, none empty and each once, got {value!r}")
    return tuple(word.strip() for word in words)
