"""Open-set classification against hand-made features, and end to end on labels that a prior has seen."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import on_host, replace

from emgs_jax import semantics
from emgs_jax.gaussians import empty_gaussians
from emgs_jax.semantics import principal_colors, relevance

classify, similarities = on_host(semantics.classify), on_host(semantics.similarities)
_relevance, _colors = on_host(relevance), on_host(principal_colors)
AXES = np.float32([[2.0, 0.0, 0.0], [0.0, 3.0, 0.0]])


def gaussians_of(features, valid):
    return replace(empty_gaussians(*np.shape(features)), features=features, valid=np.asarray(valid, bool))


@pytest.fixture
def three():
    """Three valid Gaussians with known features, and one row of padding."""
    features = np.array([[1.0, 0.0, 0.0], [1.2, 1.6, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return gaussians_of(features, [True, True, True, False])


def test_the_closest_text_embedding_wins_and_rows_without_meaning_get_none(three):
    classes = classify(three, AXES)
    # Row 2 has no feature and row 3 is not valid; lengths of the embeddings do not matter.
    np.testing.assert_array_equal(classes, [0, 1, -1, -1])


def test_similarities_are_cosines(three):
    cosines = similarities(three, AXES)
    np.testing.assert_allclose(cosines[:3], [[1.0, 0.0], [0.6, 0.8], [0.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("shape", [(0, 3), (2, 4)])
def test_embeddings_of_another_model_are_refused(three, shape):
    with pytest.raises(ValueError, match="embed the classes"):
        classify(three, np.zeros(shape, np.float32))


def asked(gaussians, words, rivals=(), margin=0.0, min_cosine=-1.0):
    rivals = np.float32(rivals).reshape(-1, gaussians.features.shape[-1])
    return _relevance(gaussians, np.float32(words), rivals, np.float32(margin), np.float32(min_cosine))


def test_relevance_is_what_a_loop_over_gaussians_and_words_finds():
    rng = np.random.default_rng(0)
    features, words, rivals = (rng.normal(size=(count, 5)) for count in (40, 3, 2))
    features[7] = 0.0
    valid = np.arange(40) != 11
    gaussians = gaussians_of(features, valid)
    margin, least = 0.15, 0.3
    found = asked(gaussians, words, rivals, margin, least)
    for row in range(40):
        cosines = [f @ features[row] / max(np.linalg.norm(f) * np.linalg.norm(features[row]), 1e-9) for f in words]
        others = [f @ features[row] / max(np.linalg.norm(f) * np.linalg.norm(features[row]), 1e-9) for f in rivals]
        leads = [cosines[c] - max([*others, *cosines[:c], *cosines[c + 1 :]]) for c in range(3)]
        np.testing.assert_allclose(found.cosines[row], cosines, atol=1e-6)
        np.testing.assert_allclose(found.leads[row], leads, atol=1e-6)
        best = int(np.argmax(cosines))
        is_answer = valid[row] and features[row].any() and leads[best] >= margin and cosines[best] >= least
        assert found.labels[row] == (best if is_answer else -1)
    assert (found.labels == -1).any() and (found.labels >= 0).any()


def test_margin_rivals_and_a_least_cosine_make_none_of_these(three):
    """Row 1 has cosines .6 and .8 with the first two axes, 0 with the third."""
    axes = np.eye(3)
    assert asked(three, axes[:2]).labels.tolist() == [0, 1, -1, -1]
    assert asked(three, axes[:2], margin=0.19).labels[1] == 1 and asked(three, axes[:2], margin=0.21).labels[1] == -1
    assert asked(three, axes[:1]).labels.tolist() == [0, 0, -1, -1]  # nothing else is asked for
    assert asked(three, axes[:1], axes[1:2]).labels.tolist() == [0, -1, -1, -1]
    assert asked(three, axes[:1], min_cosine=0.61).labels.tolist() == [0, -1, -1, -1]
    with pytest.raises(ValueError, match="embed the classes"):
        asked(three, np.ones((0, 3)))


def test_the_length_of_a_feature_says_nothing(three):
    longer = replace(three, features=np.asarray(three.features) * [[0.1], [7.0], [1.0], [1.0]])
    np.testing.assert_allclose(asked(longer, np.eye(3)).cosines, asked(three, np.eye(3)).cosines, atol=1e-6)
    np.testing.assert_allclose(_colors(longer), _colors(three), atol=1e-4)


def test_colours_are_the_features_along_their_main_directions():
    """Oracle: a singular value decomposition in float64, signs by its largest entry, percentiles by NumPy."""
    rng = np.random.default_rng(1)
    features = rng.normal(size=(60, 6)) * [5.0, 3.0, 2.0, 0.3, 0.2, 0.1] + 1.0
    features[3] = 0.0
    valid = np.arange(60) != 5
    gaussians = gaussians_of(features, valid)
    known = valid & features.any(1)
    units = features[known] / np.linalg.norm(features[known], axis=1, keepdims=True)
    centered = units - units.mean(0)
    directions = np.linalg.svd(centered)[2][:3]
    directions *= np.sign(np.take_along_axis(directions, np.abs(directions).argmax(1)[:, None], 1))
    along = centered @ directions.T
    low, high = np.percentile(along, [1, 99], axis=0)
    colors = _colors(gaussians)
    np.testing.assert_allclose(colors[known], ((along - low) / (high - low)).clip(0, 1), atol=2e-3)
    np.testing.assert_array_equal(colors[~known], 0.5)


def test_features_that_do_not_differ_are_grey(three):
    same = replace(three, features=np.ones((4, 3)))
    np.testing.assert_array_equal(_colors(same), 0.5)
    np.testing.assert_array_equal(_colors(empty_gaussians(4, 2)), 0.5)
    two = replace(three, features=np.array([[1.0, 0, 0], [0, 1.0, 0], [1.0, 0, 0], [0, 1.0, 0]]))
    np.testing.assert_allclose(_colors(two)[:, 1:], 0.5)  # one direction only


@pytest.mark.slow
def test_twenty_words_to_twenty_thousand_gaussians_of_width_1024_cost_a_few_products():
    """The bar is .2 s on two quiet cores, which the bare product needs a tenth of; how busy they are cancels."""
    rng = np.random.default_rng(0)
    features = jnp.asarray(rng.normal(size=(20000, 1024)), jnp.float32)
    gaussians = gaussians_of(features, np.ones(20000))
    words, nothing = jnp.asarray(rng.normal(size=(20, 1024)), jnp.float32), jnp.zeros(())
    question, fast = (gaussians, words, words[:4], nothing, nothing), {"xla_backend_optimization_level": 3}
    ask = jax.jit(relevance).lower(*question).compile(fast)
    multiply = jax.jit(jnp.matmul).lower(features, words.T).compile(fast)
    asking, multiplying = [], []
    for _ in range(6):
        begin = time.process_time()
        jax.block_until_ready(ask(*question).labels)
        asking.append(time.process_time() - begin)
        jax.block_until_ready(multiply(features, words.T))
        multiplying.append(time.process_time() - begin - asking[-1])
    assert min(asking[1:]) < 6 * min(multiplying[1:]), (asking, multiplying)
