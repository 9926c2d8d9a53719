"""Query a finished map for words: the Gaussians that answer, their objects, and the files with both.

`semantic.npz`, format `emgs_jax.semantic` version 1, is an npz without pickled objects. Of each confirmed Gaussian, in
the order of the map: `rows` (n,) int32, where it stands in map.npz; `means` (n, 3) float32; `features` (n, f) float16,
unit or zero; `cosines` and `leads` (n, c) float16; `labels` (n,) int16, the word it answers to, -1 = none; `instances`
(n,) int32, the object in query.json's list for that word, -1 = none. `header` is a JSON string with `format`,
`version`, `words`, `against`, `margin`, `min_cosine` and `model`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

from emgs_jax.drawing.colors import class_colors
from emgs_jax.evaluation.instances import Instance, InstanceConfig, find_instances, reach_of
from emgs_jax.features.text import TextEmbeddings
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.io.files import write_json
from emgs_jax.io.npz import save_headed
from emgs_jax.io.ply import save_points_ply
from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.runs.finished_run import FinishedRun
from emgs_jax.semantics import Relevance, relevance

QUERY_FILE, SEMANTIC_FILE, SEMANTIC_PLY = "query.json", "semantic.npz", "semantic.ply"
FORMAT, SEMANTIC_FORMAT, VERSION = "emgs_jax.query", "emgs_jax.semantic", 1
GREY = 0.75  # of a Gaussian without a feature
_relevance = eqx.filter_jit(relevance)


@dataclass(frozen=True)
class Question:
    """Query to a map."""

    words: TextEmbeddings
    against: TextEmbeddings  # rivals, which are not searched for, in the same space; may be empty
    margin: float
    min_cosine: float
    instances: InstanceConfig


@dataclass(frozen=True)
class Answer:
    """Result of a query to a map."""

    question: Question
    gaussians: Gaussians  # the confirmed ones are valid; on the device
    relevance: Relevance  # of all rows of the map, on the host
    rows: np.ndarray  # of the confirmed ones
    instances: list[list[Instance]]  # of each word
    reach: float  # distance within which answers are one object, in the unit of the map


def ask(run: FinishedRun, question: Question) -> Answer:
    """Query the map of a run."""
    gaussians = confirmed(run.map)
    vectors = (jnp.asarray(text.vectors, jnp.float32) for text in (question.words, question.against))
    limits = (jnp.asarray(value, jnp.float32) for value in (question.margin, question.min_cosine))
    found = jax.device_get(_relevance(gaussians, *vectors, *limits))
    rows = np.flatnonzero(gaussians.valid)
    means, covs = np.asarray(gaussians.means), np.asarray(gaussians.covs)
    reach = reach_of(means[rows].astype(np.float64), question.instances)
    instances = []
    for word in range(len(question.words.names)):
        answers, strength = np.flatnonzero(found.labels == word), (found.cosines[:, word], found.leads[:, word])
        instances.append(find_instances(answers, (means, covs), strength, reach, question.instances.min_gaussians))
    return Answer(question, gaussians, found, rows, instances, reach)


def write_answer(folder: Path, source: Path, answer: Answer) -> dict[str, Any]:
    """Write query.json, semantic.npz and semantic.ply into `folder`; return the contents of query.json.

    `source` is the folder of the run.
    """
    rows, gaussians, labels = answer.rows, answer.gaussians, answer.relevance.labels[answer.rows]
    _save_semantic(folder / SEMANTIC_FILE, answer)
    shown = (np.asarray(values)[rows] for values in (gaussians.means, gaussians.normals, painted(answer)))
    save_points_ply(folder / SEMANTIC_PLY, *shown, labels, answer.question.words.names)
    said = _said(source, answer, labels)
    write_json(folder / QUERY_FILE, said)
    return said


def _said(source: Path, answer: Answer, labels: np.ndarray) -> dict[str, Any]:
    question, features = answer.question, np.asarray(answer.gaussians.features)[answer.rows]
    count, width = features.shape
    return {
        "format": FORMAT,
        "version": VERSION,
        "map": str(source),
        "frame": "that of map.npz and trajectory.txt",
        "features": {
            "model": question.words.model,
            "templates": question.words.templates,
            "width": width,
            "num_gaussians": count,
            "num_with_feature": int(features.any(1).sum()),
            "bytes_per_gaussian": 4 * width,
            "bytes_per_gaussian_in_semantic_npz": 2 * width,
        },
        "against": question.against.names,
        "margin": question.margin,
        "min_cosine": question.min_cosine,
        "reach_m": answer.reach,
        "min_gaussians": question.instances.min_gaussians,
        "words": [
            {"word": word, "num_gaussians": int((labels == number).sum()), "instances": list(map(_described, found))}
            for number, (word, found) in enumerate(zip(question.words.names, answer.instances, strict=True))
        ],
        "none_of_these": int((labels < 0).sum()),
    }


def _described(instance: Instance) -> dict[str, Any]:
    about = {"center_m": instance.center, "low_m": instance.low, "high_m": instance.high}
    about |= {"extent_m": instance.high - instance.low, "score": instance.score, "lead": instance.lead}
    return about | {"num_gaussians": len(instance.rows)}


def heat(answer: Answer, word: int) -> np.ndarray:
    """Return every Gaussian's lead for a word, scaled from its 1st to its 99th percentile to [0, 1]; nan without."""
    leads = answer.relevance.leads[:, word].astype(np.float64)
    known = np.zeros(len(leads), bool)
    known[answer.rows] = np.asarray(answer.gaussians.features)[answer.rows].any(1)
    if not known.any():
        return np.full(len(leads), np.nan)
    low, high = np.percentile(leads[known], [1, 99])
    return np.where(known, ((leads - low) / max(high - low, 1e-9)).clip(0.0, 1.0), np.nan)


def painted(answer: Answer) -> np.ndarray:
    """Colour all Gaussians (n, 3) by the relevance of a single word, or by class; grey without either."""
    count, labels = len(answer.question.words.names), answer.relevance.labels
    return hot(heat(answer, 0)) if count == 1 else np.where(labels[:, None] >= 0, class_colors(count)[labels], GREY)


def hot(values: np.ndarray) -> np.ndarray:
    """Colour numbers in [0, 1], (…, 3); grey for nan."""
    colors = matplotlib.colormaps["inferno"](np.nan_to_num(values))[..., :3]
    return np.where(np.isfinite(values)[..., None], colors, GREY)


def _save_semantic(path: Path, answer: Answer) -> None:
    question, rows, found = answer.question, answer.rows, answer.relevance
    header = {"format": SEMANTIC_FORMAT, "version": VERSION, "words": question.words.names}
    header |= {"against": question.against.names, "margin": question.margin, "min_cosine": question.min_cosine}
    header |= {"model": question.words.model}
    numbers = np.full(len(found.labels), -1)
    for instances in answer.instances:
        for number, instance in enumerate(instances):
            numbers[instance.rows] = number
    arrays = {
        "rows": rows.astype(np.int32),
        "means": np.asarray(answer.gaussians.means, np.float32)[rows],
        "features": np.asarray(safe_normalize(answer.gaussians.features[rows])).astype(np.float16),
        "cosines": found.cosines[rows].astype(np.float16),
        "leads": found.leads[rows].astype(np.float16),
        "labels": found.labels[rows].astype(np.int16),
        "instances": numbers[rows].astype(np.int32),
    }
    save_headed(path, header, arrays, "header")
