"""Text embeddings: averaged over prompt templates, and kept in a file in place of the text model.

The file is an npz with `embeddings`, float32 (classes, f), and `header`, a JSON string with `format`, `version`,
`names`, `templates` and `model` (the identity of the model whose features they are compared with).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from emgs_jax.io.npz import load_headed, save_headed

FORMAT, VERSION = "emgs_jax.text", 1
REMEDY = "write it with `python -m experiments.embed`"


@dataclass(frozen=True)
class TextEmbeddings:
    """Classes as vectors."""

    names: tuple[str, ...]
    vectors: np.ndarray  # unit, float32 (classes, f)
    templates: tuple[str, ...]  # prompts over which each vector is the mean
    model: dict

    def missing(self, names: Sequence[str]) -> list[str]:
        return [name for name in names if name not in self.names]

    def only(self, names: Sequence[str]) -> "TextEmbeddings":
        return replace(self, names=tuple(names), vectors=self.vectors[[self.names.index(name) for name in names]])


def average_over_templates(
    names: Sequence[str], templates: Sequence[str], encode: Callable[[list[str]], np.ndarray]
) -> np.ndarray:
    """One vector per name, float32 (classes, f): the mean of its prompts' unit vectors, made unit again.

    `encode` maps prompts to vectors (prompts, f); each template has one {} for the name.
    """
    check_templates(templates)
    vectors = [_unit(_unit(encode([template.format(name) for template in templates])).mean(axis=0)) for name in names]
    return np.stack(vectors).astype(np.float32)


def check_templates(templates: Sequence[str]) -> None:
    """Raise ValueError unless each template has one {}."""
    bad = [template for template in templates if template.count("{}") != 1]
    if bad or not templates:
        raise ValueError(f"features.templates must each have one {{}} for the name of the class, got {bad or 'none'}")


def _unit(vectors: np.ndarray) -> np.ndarray:
    vectors = np.asarray(vectors, np.float64)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(np.float64).tiny)


def save_text(path: Path | str, text: TextEmbeddings) -> None:
    about = {"names": text.names, "templates": text.templates, "model": text.model}
    vectors = {"embeddings": np.asarray(text.vectors, np.float32)}
    save_headed(path, {"format": FORMAT, "version": VERSION, **about}, vectors, "header")


def load_text(path: Path | str, model: dict, names: Sequence[str] = ()) -> TextEmbeddings:
    """Read the embeddings of `names` (none: all) from a file; ValueError if it lacks one or is of another model."""
    found = read_text(path)
    if found.model != model:
        raise ValueError(f"{path} was embedded by {found.model}, but the features are of {model}: {REMEDY}")
    if missing := found.missing(names):
        raise ValueError(f"{path} has no embedding of {missing}, only of {[*found.names]}: {REMEDY}")
    return found.only(names) if names else found


def read_text(path: Path | str) -> TextEmbeddings:
    """Read all embeddings of a file, of whatever model; ValueError if it is damaged or of another format."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} is no file: {REMEDY}")
    try:
        header, arrays = load_headed(path, {"format": FORMAT, "version": VERSION}, "header")
        vectors = arrays["embeddings"]
    except (ValueError, KeyError) as error:
        raise ValueError(f"{path} is no file of text embeddings, or damaged ({error}): {REMEDY}") from error
    is_whole = {"names", "templates", "model"} <= header.keys() and vectors.ndim == 2
    is_whole = is_whole and vectors.dtype == np.float32 and bool(np.isfinite(vectors).all())
    if not is_whole or len(vectors) != len(header["names"]):
        raise ValueError(f"{path} is damaged (its embeddings are not those of its header): {REMEDY}")
    return TextEmbeddings(tuple(header["names"]), vectors, tuple(header["templates"]), header["model"])


def random_embeddings(names: Sequence[str], size: int) -> np.ndarray:
    """One pseudo-random unit vector per name, float32 (classes, f); (0, 0) without names."""
    if not names:
        return np.zeros((0, 0), np.float32)
    seeds = [int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") for name in names]
    vectors = np.stack([np.random.default_rng(seed).standard_normal(size) for seed in seeds])
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
