"""Choose pairs of images to match: all while that is cheap, else neighbours and recognised places."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from emgs_jax.loop_closure.place_recognition import train_words, vlad
from emgs_jax.structure.config import StructureConfig

NUM_WORDS, MAX_TRAINING, NUM_ITERATIONS = 64, 10000, 15
MAX_DESCRIPTORS = 500  # of one image


def choose_pairs(database: Any, names: Sequence[str], config: StructureConfig) -> list[tuple[str, str]]:
    """Pairs of the names, in order of time, of images with features in COLMAP's database."""
    ids = {image.name: image.image_id for image in database.read_all_images()}
    names = [name for name in names if name in ids]
    count = len(names)
    if count <= config.max_exhaustive:
        return list(itertools.combinations(names, 2))
    steps = {*range(1, config.overlap + 1), *(2**power for power in range(count.bit_length()))}
    steps = {step for step in steps if step <= max(config.overlap, 2 ** (config.overlap - 1))}
    found = {(row, row + step) for row in range(count) for step in steps if row + step < count}
    found |= similar([_descriptors(database, ids[name]) for name in names], config)
    return [(names[a], names[b]) for a, b in sorted(found)]


def _descriptors(database: Any, image: int) -> np.ndarray:
    """Unit descriptors of an image, at most MAX_DESCRIPTORS, evenly chosen."""
    found = np.asarray(database.read_descriptors(image).to_float().data, np.float32)
    found = found[np.linspace(0, len(found) - 1, min(len(found), MAX_DESCRIPTORS)).astype(int)]
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)


def similar(descriptors: Sequence[np.ndarray], config: StructureConfig) -> set[tuple[int, int]]:
    """The `num_similar` most similar rows, by VLAD, for each image, except for neighbours, as pairs."""
    if not config.num_similar:
        return set()
    words = train_words(np.concatenate(descriptors), (NUM_WORDS, MAX_TRAINING, NUM_ITERATIONS), config.seed)
    vectors = np.stack([vlad(one, words) for one in descriptors])
    rows, found = np.arange(len(vectors)), set()
    for row, vector in enumerate(vectors):  # the matrix of all similarities would be large
        likeness = np.where(np.abs(rows - row) > config.overlap, vectors @ vector, -np.inf)
        for other in np.argsort(-likeness, kind="stable")[: config.num_similar]:
            if likeness[other] > 0:
                found.add((min(row, int(other)), max(row, int(other))))
    return found
