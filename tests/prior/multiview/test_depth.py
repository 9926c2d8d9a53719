"""Depth of painted planes, holes where nothing is known, the parabola, and the median."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.ndimage
from stereo_scene import depth_config, matrix, plane_image, small_camera

from emgs_jax.prior.multiview.depth import _between_planes, _median, _spread, estimate_depth

POSES = [matrix(translation=t) for t in ((0.2, 0, 0), (-0.2, 0, 0), (0, 0.2, 0), (0, -0.2, 0))]
INSIDE = np.s_[8:-8, 8:-8]
jitted_depth = eqx.filter_jit(estimate_depth)


def relative(poses) -> jaxlie.SE3:
    return jaxlie.SE3.from_matrix(jnp.asarray(np.linalg.inv(np.stack(poses)), jnp.float32))


def estimate(gray, sources, is_used=(True,) * 4, near=1.2, far=5.0, overrides=()):
    depth_range = jnp.asarray([near, far], jnp.float32)
    arrays = jnp.asarray(gray), jnp.asarray(np.stack(sources)), relative(POSES), jnp.asarray(is_used)
    return np.asarray(jitted_depth(*arrays, depth_range, small_camera(), depth_config(*overrides))[0])


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_a_painted_plane_has_its_depth_between_the_planes_that_were_tried(slope):
    gray, depth = plane_image(np.eye(4), slope)
    found = estimate(gray, [plane_image(T, slope)[0] for T in POSES])
    spacing = (1 / 1.2 - 1 / 5.0) / 23
    error = np.abs(1 / np.maximum(found, 1e-3) - 1 / depth)[INSIDE]
    assert np.mean(found[INSIDE] > 0) > 0.97
    assert np.mean(error < spacing) > 0.97
    assert np.median(error) < 0.25 * spacing  # which rounding to planes would have


def test_without_a_source_at_the_end_of_the_range_or_with_nothing_like_it_there_are_holes():
    gray, _ = plane_image(np.eye(4), 0.0)
    sources = [plane_image(T, 0.0)[0] for T in POSES]
    assert not estimate(gray, sources, is_used=(False,) * 4).any()
    assert np.mean(estimate(gray, sources, near=2.0)[INSIDE] > 0) < 0.05  # the wall is the nearest plane
    noise = np.random.default_rng(0).uniform(size=(4, *gray.shape)).astype(np.float32)
    strict = "prior.dense.depth.max_cost=0.2"  # a random match costs about .35, the better two of four
    assert np.mean(estimate(gray, noise, overrides=(strict,)) > 0) < 0.05
    assert np.mean(estimate(gray, sources, overrides=(strict,))[INSIDE] > 0) > 0.9
    for margin, share in ((0, 1.0), (9, 0.0)):  # a plane must stand out by so much
        found = estimate(gray, sources, overrides=(f"prior.dense.depth.min_margin={margin}",))
        assert np.mean(found[INSIDE] > 0) == pytest.approx(share, abs=0.03)


def test_the_parabola_through_three_costs_has_its_minimum_where_the_cost_had_it():
    places = np.array([2.3, 1.6, 3.0, 0.0, 4.0])
    total = (np.arange(5.0) - places[:, None]) ** 2
    best = total.argmin(axis=-1)
    offset = _between_planes(jnp.asarray(total[None], jnp.float32), jnp.asarray(best[None]))
    np.testing.assert_allclose(best[:3] + np.asarray(offset)[0, :3], places[:3], atol=1e-6)
    assert np.abs(offset).max() <= 0.5
    np.testing.assert_array_equal(_between_planes(jnp.ones((1, 1, 5)), jnp.full((1, 1), 2)), 0.0)


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
    gray, _ = plane_image(np.eye(4), 0.0)
    sources = np.stack([plane_image(T, 0.0)[0] for T in POSES])
    found = {}
    for name, contrast in (("painted", 1.0), ("bare", 1e-3)):
        images = jnp.asarray(0.5 + contrast * (gray - 0.5)), jnp.asarray(0.5 + contrast * (sources - 0.5))
        rest = jnp.asarray((True,) * 4), jnp.asarray([1.2, 5.0]), small_camera(), depth_config()
        found[name] = np.median(np.asarray(jitted_depth(*images, relative(POSES), *rest)[1])[INSIDE])
    assert found["painted"] < 1.0 and found["bare"] > 4.0


def test_the_median_is_scipys_and_keeps_holes():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 2, (12, 10)).astype(np.float32)
    expected = scipy.ndimage.median_filter(depth, size=5, mode="nearest")
    np.testing.assert_array_equal(_median(jnp.asarray(depth), 2), expected)
    np.testing.assert_array_equal(_median(jnp.asarray(depth), 0), depth)
    depth[:, 3:] = 0
    assert not np.asarray(_median(jnp.asarray(depth), 2))[:, 3:].any()
