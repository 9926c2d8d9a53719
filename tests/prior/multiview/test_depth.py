"""Depth of painted planes, holes where nothing is known, the parabola, and the median."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from stereo_scene import depth_config, painted, small_camera, sources

from emgs_jax.prior.multiview.depth import _median, _spread, estimate_depth

pytestmark = pytest.mark.slow

INSIDE = np.s_[8:-8, 8:-8]
jitted_depth = eqx.filter_jit(estimate_depth)


def estimate(gray, others, is_used=None, near=1.2, overrides=()):
    """Depth and spread."""
    seen = jnp.asarray(gray), sources(others, is_used=is_used), jnp.asarray([near, 5.0], jnp.float32)
    return [np.asarray(found) for found in jitted_depth(*seen, small_camera(), depth_config(*overrides))]


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_a_painted_plane_has_its_depth_between_the_planes_that_were_tried(slope):
    gray, depth, others = painted(slope)
    found, _ = estimate(gray, others)
    spacing = (1 / 1.2 - 1 / 5.0) / 23
    error = np.abs(1 / np.maximum(found, 1e-3) - 1 / depth)[INSIDE]
    assert np.mean(found[INSIDE] > 0) > 0.97
    assert np.mean(error < spacing) > 0.97
    assert np.median(error) < 0.25 * spacing  # which rounding to planes would have


def test_without_a_source_at_the_end_of_the_range_or_with_nothing_like_it_there_are_holes():
    gray, _, others = painted()
    assert not estimate(gray, others, is_used=[False] * 4)[0].any()
    assert np.mean(estimate(gray, others, near=2.0)[0][INSIDE] > 0) < 0.05  # the wall is the nearest plane
    noise = np.random.default_rng(0).uniform(size=(4, *gray.shape)).astype(np.float32)
    strict = "prior.dense.depth.max_cost=0.2"  # a random match costs about .35, the better two of four
    assert np.mean(estimate(gray, noise, overrides=(strict,))[0] > 0) < 0.05
    assert np.mean(estimate(gray, others, overrides=(strict,))[0][INSIDE] > 0) > 0.9
    for margin, share in ((0, 1.0), (9, 0.0)):  # a plane must stand out by so much
        found, _ = estimate(gray, others, overrides=(f"prior.dense.depth.min_margin={margin}",))
        assert np.mean(found[INSIDE] > 0) == pytest.approx(share, abs=0.03)


def test_the_spread_is_the_distance_of_plausible_planes():
    total = np.full((1, 4, 9), 2.0)
    total[0, 0, 3] = 0  # one plane stands out
    total[0, 1, 2:5] = 0  # a flat minimum: two of three are a plane away
    total[0, 2, [1, 7]] = 0  # repeated texture: half of it is six planes away
    total[0, 3, [1, 7]] = 0, 0.05  # likewise, a temperature above the best
    best = jnp.asarray([[3, 3, 1, 1]])
    expected = [0, np.sqrt(2 / 3), np.sqrt(36 / 2), np.sqrt(36 / (1 + np.e))]
    np.testing.assert_allclose(
        _spread(jnp.asarray(total, jnp.float32), best, jnp.asarray(0.05))[0], expected, atol=1e-4
    )


def test_a_wall_without_texture_is_uncertain_and_a_painted_one_is_not():
    gray, _, others = painted()
    bare = estimate(0.5 + 1e-3 * (gray - 0.5), 0.5 + 1e-3 * (np.float32(others) - 0.5))[1]
    assert np.median(estimate(gray, others)[1][INSIDE]) < 1.0 and np.median(bare[INSIDE]) > 4.0


def test_the_median_is_scipys_and_keeps_holes():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 2, (12, 10)).astype(np.float32)
    expected = scipy.ndimage.median_filter(depth, size=5, mode="nearest")
    np.testing.assert_array_equal(_median(jnp.asarray(depth), 2), expected)
    np.testing.assert_array_equal(_median(jnp.asarray(depth), 0), depth)
    depth[:, 3:] = 0
    assert not np.asarray(_median(jnp.asarray(depth), 2))[:, 3:].any()
