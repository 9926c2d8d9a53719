"""One point per pixel: exact on a plane of Gaussians, moved by rigid motions, silent where surfaces mix."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import at, move_gaussians, pose

from emgs_jax.gaussians import Gaussians
from emgs_jax.render.composite import render
from emgs_jax.render.densify import DensifyConfig, densify, in_dominant_layer

dense = eqx.filter_jit(densify)


def wall(depth: float, normal=(0.0, 0.0, -1.0), step: float = 0.15) -> Gaussians:
    """Discs on a grid on the plane through (0, 0, depth) with a normal."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    x, y = (a.reshape(-1) for a in np.meshgrid(np.arange(-2, 2, step), np.arange(-1.5, 1.5, step)))
    z = depth - (normal[0] * x + normal[1] * y) / normal[2]
    cov = (step / 2) ** 2 * (np.eye(3) - np.outer(normal, normal)) + 1e-4 * np.outer(normal, normal)
    count = len(x)
    rows = np.stack([x, y, z], -1), np.tile(cov, (count, 1, 1)), np.tile([0.2, 0.5, 0.8], (count, 1))
    arrays = [jnp.asarray(a, jnp.float32) for a in (*rows, np.tile(normal, (count, 1)))]
    return Gaussians(*arrays, jnp.zeros((count, 0)), jnp.ones(count, bool))


@pytest.fixture(scope="module")
def densify_config(config):
    return DensifyConfig(0.9, 0.3, 0.05, 0.75, config("render.tile_capacity=600").refinement.render)


def test_the_points_of_a_slanted_wall_lie_on_it_with_its_normal_and_colour(camera, densify_config):
    normal = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    # Without the blur: a splat's depth is kept within its own extent, which blur widens on the image only.
    view = dense(wall(2.0, normal), pose(), camera, at(densify_config, "render.blur", 0.0))
    valid = np.asarray(view.valid)
    assert view.rendering.overflow == 0 and valid.mean() > 0.95
    distance = (np.asarray(view.points)[valid] - [0, 0, 2]) @ normal
    assert np.abs(distance).max() < 1e-3  # m; every splat's depth is exact for its plane
    np.testing.assert_allclose(np.asarray(view.normals)[valid], np.tile(normal, (valid.sum(), 1)), atol=1e-4)
    np.testing.assert_allclose(np.asarray(view.colors)[valid], np.tile([0.2, 0.5, 0.8], (valid.sum(), 1)), atol=1e-4)


def test_the_map_is_drawn_with_the_opacity_and_coverage_of_densification(camera, densify_config):
    view = dense(wall(2.0), pose(), camera, at(at(densify_config, "opacity", 0.2), "min_alpha", 0.35))
    soft = at(at(densify_config.render, "opacity", 0.2), "min_alpha", 0.35)
    expected = eqx.filter_jit(render)(wall(2.0), wall(2.0).colors, pose(), camera, soft)
    for name in ("alpha", "depth", "depth_std"):  # roundings; a standard deviation is the root of a difference
        np.testing.assert_allclose(getattr(view.rendering, name), getattr(expected, name), atol=1e-3, err_msg=name)
    np.testing.assert_array_equal(view.valid, view.rendering.depth > 0)
    np.testing.assert_allclose(view.depth, view.rendering.depth, atol=1e-5)
    assert view.valid.sum() > 0


@pytest.mark.parametrize(("opacity", "share", "is_valid"), [(0.8, 0.8, True), (0.8, 0.85, False), (0.4, 0.6, True)])
def test_of_two_discs_behind_each_other_the_pixel_shows_the_nearer_if_it_has_the_share(
    camera, densify_config, opacity, share, is_valid
):
    """At the centre they weigh a and (1 - a) a, so the nearer has the share 1 / (2 - a): .83 and .625."""
    size = wall(2.0).valid.shape[0]
    two = eqx.tree_at(lambda g: g.valid, wall(2.0), jnp.arange(size) < 2)
    on_axis = (np.array([15, 12]) - np.asarray(camera.center)) / np.asarray(camera.focal)  # of pixel (15, 12)
    means = jnp.asarray([[*(on_axis * z), z] for z in (2.0, 1.0)], jnp.float32)
    colors, normals = jnp.array([[0.9, 0.1, 0.1], [0.2, 0.5, 0.8]]), jnp.array([[0.6, 0, -0.8], [0, 0, -1.0]])
    put = lambda rows, values: rows.at[:2].set(values)  # noqa: E731
    covs = jnp.diag(jnp.array([0.09, 0.09, 1e-6]))
    two = eqx.tree_at(
        lambda g: (g.means, g.covs, g.colors, g.normals),
        two,
        (put(two.means, means), put(two.covs, covs), put(two.colors, colors), put(two.normals, normals)),
    )
    config = at(at(densify_config, "opacity", opacity), "min_layer_share", share)
    view = dense(two, pose(), camera, config)
    assert view.rendering.depth_std[12, 15] > 0.1 and view.valid[12, 15] == is_valid
    np.testing.assert_allclose(view.depth[12, 15], 1.0, atol=1e-5)  # roundings, here and below
    np.testing.assert_allclose(view.points[12, 15], [*on_axis, 1.0], atol=1e-5)
    np.testing.assert_allclose(view.colors[12, 15], colors[1], atol=1e-5)
    np.testing.assert_allclose(view.normals[12, 15], normals[1], atol=1e-5)
    share_of_nearer = 1 / (2 - opacity)
    mean = share_of_nearer * 1.0 + (1 - share_of_nearer) * 2.0
    np.testing.assert_allclose(view.rendering.depth[12, 15], mean, atol=1e-4)


def test_points_move_with_map_and_camera(camera, densify_config):
    T, motion = pose((0.05, 0.1, 0)), pose((0.7, 0.2, -0.4), (1.0, -2.0, 0.5))
    view = dense(wall(2.0), T, camera, densify_config)
    moved = dense(move_gaussians(motion, wall(2.0)), motion @ T, camera, densify_config)
    both = np.asarray(view.valid & moved.valid)
    assert both.mean() > 0.9
    expected = np.asarray(view.points) @ np.asarray(motion.rotation().as_matrix()).T + np.asarray(motion.translation())
    np.testing.assert_allclose(
        np.asarray(moved.points)[both], expected[both], atol=2e-3
    )  # a splat more or less at its edge


def two_walls(view):
    """Share of the valid pixels that lie on the wall at 1.5 m, on the one at 3 m, and between the two."""
    depth = np.asarray(view.depth)[np.asarray(view.valid)]
    on = [np.abs(depth - wall) < 0.05 * wall for wall in (1.5, 3.0)]
    return [float(x.mean()) if len(depth) else 0.0 for x in (*on, ~on[0] & ~on[1])]


def test_a_pixel_that_mixes_two_surfaces_shows_the_dominant_one_or_nothing(camera, densify_config):
    """Oracle: the depths of the two walls; their mean is the depth of nothing."""
    half_open = at(densify_config, "render.opacity", 0.5)  # so that the wall behind shines through
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), wall(1.5), wall(3.0, step=0.3))
    for opacity, share in ((0.9, 0.75), (0.5, 0.75), (0.5, 0.0)):
        view = dense(both, pose(), camera, at(at(half_open, "opacity", opacity), "min_layer_share", share))
        mixed = np.asarray(view.rendering.depth_std) > 0.05 * np.asarray(view.rendering.depth)
        near, far, between = two_walls(view)
        assert near + far > 0.999 and between == 0
        if share == 0.0:
            assert mixed.mean() > 0.5 and np.asarray(view.valid).mean() > 0.9
    strict = at(at(half_open, "opacity", 0.5), "min_layer_share", 1.01)  # which no layer has
    view = dense(both, pose(), camera, strict)
    mixed = np.asarray(view.rendering.depth_std) > 0.05 * np.asarray(view.rendering.depth)
    np.testing.assert_array_equal(np.asarray(view.valid), ~mixed & (np.asarray(view.rendering.depth) > 0))


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ((0.2, 0.4, 0.3, 0.0), [False, True, True, False]),  # about 2 m, and what is within 20 cm of that
        ((0.6, 0.2, 0.2, 0.1), [True, False, False, False]),
        ((0.3, 0.1, 0.1, 0.6), [False, False, True, True]),
    ],
)
def test_the_dominant_layer_is_a_tenth_about_the_weighted_median(weights, expected):
    weights, depth = jnp.array(weights)[:, None], jnp.array([[1.0], [2.0], [2.15], [2.25]])
    np.testing.assert_array_equal(in_dominant_layer(weights, depth, jnp.asarray(0.1))[:, 0], expected)
    nothing = in_dominant_layer(0.0 * weights, depth, jnp.asarray(0.1))  # no weight, no layer that matters
    assert nothing.shape == (4, 1)


def test_pixels_without_depth_are_invalid_and_finite(camera, densify_config):
    nothing = eqx.tree_at(lambda g: g.valid, wall(2.0), jnp.zeros(wall(2.0).valid.shape, bool))
    view = dense(nothing, pose(), camera, densify_config)
    assert not view.valid.any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(view))
