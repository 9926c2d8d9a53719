"""The features for tests: the stated projection of the mean colours, the same in every process."""

import numpy as np
import pytest

from emgs_jax.data.base import Frame
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.random import RandomFeatures
from emgs_jax.features.text import random_embeddings


def make(seed=0, templates=("{}",), **changes):
    arguments = {"width": 6, "cell": 8, "seed": seed, "classes": ("a", "b"), "templates": templates, "text": None}
    return RandomFeatures(**arguments | changes)


def test_a_cell_is_the_unit_projection_of_its_mean_colour():
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (24, 32, 3), np.uint8)
    features = make(seed=4).extract(Frame(0, 0.0, "", image))
    colors = image.reshape(3, 8, 4, 8, 3).mean(axis=(1, 3)) / 255
    weights = np.random.default_rng(4).standard_normal((6, 4))
    expected = np.concatenate([colors, np.ones((3, 4, 1))], axis=-1) @ weights.T
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert features.dtype == np.float16
    np.testing.assert_allclose(features, expected, atol=1e-3)  # float16
    assert features.tobytes() == make(seed=4).extract(Frame(0, 0.0, "", image)).tobytes()
    assert features.tobytes() != make(seed=5).extract(Frame(0, 0.0, "", image)).tobytes()


def test_an_embedding_is_the_mean_of_its_prompts_and_a_width_or_cell_of_nothing_is_refused():
    model = make(templates=("a {}.", "the {}."))
    assert isinstance(model, FeatureModel)
    mean = random_embeddings(["a b.", "the b."], 6).mean(axis=0)
    np.testing.assert_allclose(model.text.vectors[1], mean / np.linalg.norm(mean), atol=1e-6)
    assert make(classes=()).text.vectors.shape == (0, 6)
    for changes in ({"width": 0}, {"cell": 0}, {"seed": -1}):
        with pytest.raises(ValueError, match="must be ≥"):
            make(**changes)
