"""Open-set classification against hand-made features, and end to end on labels that a prior has seen."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from emgs_jax.gaussians import empty_gaussians
from emgs_jax.semantics import classify, similarities


@pytest.fixture
def three():
    """Three valid Gaussians with known features, and one row of padding."""
    features = jnp.array([[1.0, 0.0, 0.0], [1.2, 1.6, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    valid = jnp.array([True, True, True, False])
    return eqx.tree_at(lambda g: (g.features, g.valid), empty_gaussians(4, 3), (features, valid))


def test_the_closest_text_embedding_wins_and_rows_without_meaning_get_none(three):
    classes = classify(three, jnp.array([[2.0, 0.0, 0.0], [0.0, 3.0, 0.0]]))
    # Row 2 has no feature and row 3 is not valid; lengths of the embeddings do not matter.
    np.testing.assert_array_equal(classes, [0, 1, -1, -1])


def test_similarities_are_cosines(three):
    cosines = similarities(three, jnp.array([[2.0, 0.0, 0.0], [0.0, 3.0, 0.0]]))
    np.testing.assert_allclose(cosines[:3], [[1.0, 0.0], [0.6, 0.8], [0.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("shape", [(0, 3), (2, 4)])
def test_embeddings_of_another_model_are_refused(three, shape):
    with pytest.raises(ValueError, match="embed the classes"):
        classify(three, jnp.zeros(shape))
