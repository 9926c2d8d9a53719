"""The census against NumPy, and the cheapest plane of painted planes against their true depth."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from stereo_scene import AROUND, depth_config, matrix, painted, small_camera, sources

from emgs_jax.prior.multiview.plane_sweep import census, inverse_depths, sweep

pytestmark = pytest.mark.slow

jitted_sweep = eqx.filter_jit(sweep)
PLANES = inverse_depths(jnp.asarray(1.2), jnp.asarray(5.0), depth_config().sweep)


def costs(gray, others, config, planes=PLANES):
    return np.asarray(jitted_sweep(jnp.asarray(gray), others, planes, small_camera(), config))


@pytest.mark.parametrize("scale", [1, 2])
def test_the_census_is_numpys(scale):
    config = depth_config().sweep
    gray = np.random.default_rng(0).uniform(size=(14, 11)).astype(np.float32)
    radius, spacing, margin = config.census_radius, config.census_spacing, np.float32(config.census_margin)
    expected = np.zeros(gray.shape, np.uint32)
    for y, x in np.ndindex(*gray.shape):
        bit = 0
        for dy in range(-radius, radius + 1, spacing):
            for dx in range(-radius, radius + 1, spacing):
                if dy or dx:
                    other = gray[np.clip(y + scale * dy, 0, 13), np.clip(x + scale * dx, 0, 10)]
                    expected[y, x] |= np.uint32(int(other > gray[y, x] + margin) << bit)
                    bit += 1
    np.testing.assert_array_equal(census(jnp.asarray(gray), config, scale), expected)


def test_the_census_does_not_see_exposure_and_planes_are_uniform_in_inverse_depth_from_far_to_near():
    config = depth_config("prior.dense.depth.sweep.census_margin=0.0").sweep
    gray = jnp.asarray(np.random.default_rng(1).uniform(size=(14, 11)).astype(np.float32))
    np.testing.assert_array_equal(census(gray, config), census(0.5 * gray + 0.25, config))
    planes = inverse_depths(jnp.asarray(1.0), jnp.asarray(4.0), depth_config().sweep)
    np.testing.assert_allclose(planes, np.linspace(0.25, 1.0, 24), rtol=1e-6)
    with pytest.raises(Exception, match="larger spacing"):  # more than 32 comparisons
        depth_config("prior.dense.depth.sweep.census_spacing=1")


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_the_cheapest_plane_is_the_true_inverse_depth(slope):
    gray, depth, others = painted(slope)
    cost = costs(gray, sources(others), depth_config().sweep)
    error = np.abs(np.asarray(PLANES)[cost.argmin(axis=-1)] - 1 / depth)[8:-8, 8:-8]
    spacing = float(PLANES[1] - PLANES[0])
    assert np.mean(error < 1.5 * spacing) > 0.9  # the paint repeats itself; aggregation is to resolve that
    assert np.median(error) < 0.5 * spacing


def test_the_view_itself_confirms_every_plane_at_no_cost():
    gray, _, _ = painted(0.4)
    cost = costs(gray, sources([gray], [np.eye(4)]), depth_config("prior.dense.depth.sweep.num_best=1").sweep)
    assert cost.shape == (48, 64, 24) and not cost.any()


def test_the_sources_that_agree_best_decide_and_those_that_do_not_see_the_point_have_no_say():
    """Two good sources and two of noise; oracle: each by itself, and the mean of the two that cost least."""
    gray, depth, others = painted()
    planes = jnp.asarray([1 / 4.0, 1 / depth.mean(), 1 / 1.2], jnp.float32)
    noise = np.random.default_rng(0).uniform(size=(2, *gray.shape)).astype(np.float32)
    images = [noise[0], *others[1:3], noise[1]]
    one, two = (depth_config(f"prior.dense.depth.sweep.num_best={count}").sweep for count in (1, 2))
    each = [costs(gray, sources([image], [T]), one, planes) for image, T in zip(images, AROUND, strict=True)]
    together = costs(gray, sources(images), two, planes)
    np.testing.assert_allclose(together, np.sort(each, axis=0)[:2].mean(axis=0), rtol=1e-6)
    assert np.median(together[8:-8, 8:-8, 1]) < 0.1


def test_a_source_that_does_not_count_is_not_read_and_nowhere_costs_the_same():
    config, (gray, _, others) = depth_config().sweep, painted()
    poisoned = [*others[:3], np.full_like(gray, np.nan)]
    clean, same = (costs(gray, sources(each, is_used=[True] * 3 + [False]), config) for each in (others, poisoned))
    np.testing.assert_array_equal(clean, same)
    far_away = costs(gray, sources(others, [matrix(translation=(50.0, 0, 0))] * 4), config)
    np.testing.assert_array_equal(far_away, np.float32(config.unseen_cost))
