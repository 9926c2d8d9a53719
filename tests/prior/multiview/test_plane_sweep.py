"""The census against NumPy, and the cheapest plane of painted planes against their true depth."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from stereo_scene import depth_config, matrix, plane_image, small_camera

from emgs_jax.prior.multiview.plane_sweep import census, inverse_depths, sweep

POSES = [matrix(translation=t) for t in ((0.2, 0, 0), (-0.2, 0, 0), (0, 0.2, 0), (0, -0.2, 0))]
jitted_sweep = eqx.filter_jit(sweep)


def relative(poses) -> jaxlie.SE3:
    """T_source_reference for the reference at the origin."""
    return jaxlie.SE3.from_matrix(jnp.asarray(np.linalg.inv(np.stack(poses)), jnp.float32))


def costs(gray, sources, poses, is_used, planes, config):
    arrays = jnp.asarray(gray), jnp.asarray(np.stack(sources)), relative(poses), jnp.asarray(is_used)
    return np.asarray(jitted_sweep(*arrays, planes, small_camera(), config))


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
    config = depth_config().sweep
    gray, depth = plane_image(np.eye(4), slope)
    planes = inverse_depths(jnp.asarray(1.2), jnp.asarray(5.0), config)
    cost = costs(gray, [plane_image(T, slope)[0] for T in POSES], POSES, [True] * 4, planes, config)
    inside = np.s_[8:-8, 8:-8]
    error = np.abs(np.asarray(planes)[cost.argmin(axis=-1)] - 1 / depth)[inside]
    spacing = float(planes[1] - planes[0])
    assert np.mean(error < 1.5 * spacing) > 0.9  # the paint repeats itself; aggregation is to resolve that
    assert np.median(error) < 0.5 * spacing


def test_the_view_itself_confirms_every_plane_at_no_cost():
    config = depth_config("prior.dense.depth.sweep.num_best=1").sweep
    gray, _ = plane_image(np.eye(4), 0.4)
    planes = inverse_depths(jnp.asarray(1.2), jnp.asarray(5.0), config)
    cost = costs(gray, [gray], [np.eye(4)], [True], planes, config)
    assert cost.shape == (48, 64, 24)
    assert not cost.any()


def test_the_sources_that_agree_best_decide_and_those_that_do_not_see_the_point_have_no_say():
    """Two good sources and two of noise; oracle: each by itself, and the mean of the two that cost least."""
    gray, depth = plane_image(np.eye(4), 0.0)
    planes = jnp.asarray([1 / 4.0, 1 / depth.mean(), 1 / 1.2], jnp.float32)
    noise = np.random.default_rng(0).uniform(size=(2, *gray.shape)).astype(np.float32)
    sources = [noise[0], *(plane_image(T, 0.0)[0] for T in POSES[1:3]), noise[1]]
    one, two = (depth_config(f"prior.dense.depth.sweep.num_best={count}").sweep for count in (1, 2))
    each = [costs(gray, [image], [T], [True], planes, one) for image, T in zip(sources, POSES, strict=True)]
    together = costs(gray, sources, POSES, [True] * 4, planes, two)
    np.testing.assert_allclose(together, np.sort(each, axis=0)[:2].mean(axis=0), rtol=1e-6)
    assert np.median(together[8:-8, 8:-8, 1]) < 0.1


def test_a_source_that_does_not_count_is_not_read_and_nowhere_costs_the_same():
    config = depth_config().sweep
    gray, _ = plane_image(np.eye(4), 0.0)
    planes = inverse_depths(jnp.asarray(1.2), jnp.asarray(5.0), config)
    sources = [plane_image(T, 0.0)[0] for T in POSES[:3]]
    used = [True, True, False]
    clean = costs(gray, sources, POSES[:3], used, planes, config)
    poisoned = costs(gray, [*sources[:2], np.full_like(gray, np.nan)], POSES[:3], used, planes, config)
    np.testing.assert_array_equal(clean, poisoned)
    far_away = [matrix(translation=(50.0, 0, 0))] * 3
    np.testing.assert_array_equal(
        costs(gray, sources, far_away, [True] * 3, planes, config), np.float32(config.unseen_cost)
    )
