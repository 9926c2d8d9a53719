"""Text embeddings: averaged over prompt templates, and kept in a file so that no text model is needed later.

The file, format `emgs_jax.text` version 1, is an npz without pickled objects: `embeddings`, float32 (classes, f), and
`header`, a JSON string with `format`, `version`, `names`, `templates` and `model` (identity of the model whose
features the embeddings can be compared with).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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


def average_over_templates(
    names: Sequence[str], templates: Sequence[str], encode: Callable[[list[str]], np.ndarray]
) -> np.ndarray:
    """Return one unit vector per name, float32 (classes, f): the mean of its prompts' unit vectors, unit again.

    Args:
        templates: each has one {} for the name.
        encode: prompts -> vectors (prompts, f).
    """
    check_templates(templates)
    vectors = [_unit(_unit(encode([template.format(name) for template in templates])).mean(axis=0)) for name in names]
    return np.stack(vectors).astype(np.float32)


def check_templates(templates: Sequence[str]) -> None:
    """Raise ValueError where a template has no place for the name."""
    bad = [template for template in templates if template.count("{}") != 1]
    if bad or not templates:
        raise ValueError(f"features.templates must each have one {{}} for the name of the class, got {bad or 'none'}")


def _unit(vectors: np.ndarray) -> np.ndarray:
    vectors = np.asarray(vectors, np.float64)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(np.float64).tiny)


def save_text(path: Path | str, text: TextEmbeddings) -> None:
    """Write the embeddings, whole or not at all."""
    header = {"format": FORMAT, "version": VERSION, "names": text.names, "templates": text.templates}
    header |= {"model": text.model}
    save_headed(path, header, {"embeddings": np.asarray(text.vectors, np.float32)}, "header")


def load_text(path: Path | str, model: dict, names: Sequence[str] = ()) -> TextEmbeddings:
    """Read embeddings, in the order of `names`; all that are there where no names are given.

    Args:
        path: a file of `experiments.embed`.
        model: identity of the model whose features they will be compared with.

    Raises:
        ValueError: the file is damaged, foreign, newer, of another model, or lacks a name.
    """
    header, vectors = _read(Path(path))
    if header["model"] != model:
        raise ValueError(f"{path} was embedded by {header['model']}, but the features are of {model}: {REMEDY}")
    known = {name: row for row, name in enumerate(header["names"])}
    missing = [name for name in names if name not in known]
    if missing:
        raise ValueError(f"{path} has no embedding of {missing}, only of {[*known]}: {REMEDY}")
    chosen = tuple(names or known)
    return TextEmbeddings(chosen, vectors[[known[name] for name in chosen]], tuple(header["templates"]), model)


def read_text(path: Path | str) -> TextEmbeddings:
    """All embeddings of a file, whatever their model is; raises ValueError as `load_text`."""
    header, vectors = _read(Path(path))
    return TextEmbeddings(tuple(header["names"]), vectors, tuple(header["templates"]), header["model"])


def _read(path: Path) -> tuple[dict, np.ndarray]:
    """Return header and vectors of a file that is whole."""
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
    return header, vectors


def random_embeddings(names: Sequence[str], size: int) -> np.ndarray:
    """Return one pseudo-random unit vector per name, float32 (classes, f); (0, 0) without names."""
    if not names:
        return np.zeros((0, 0), np.float32)
    seeds = [int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") for name in names]
    vectors = np.stack([np.random.default_rng(seed).standard_normal(size) for seed in seeds])
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
