"""The key functions as users get them, at the sizes of a run.

Other tests switch the compiler's optimisations off. Versions of jaxlib whose optimised sums are wrong are right for few
rows.
"""

import os

import jax
import numpy as np
import pytest
import reference
import scene as sc
from compiled_rows import largest_difference, random_problem
from scipy.spatial import cKDTree

from emgs_jax.em import em_update
from emgs_jax.observation import observe
from emgs_jax.ops.neighbours import knn

pytestmark = pytest.mark.slow
AS_USERS_HAVE_IT = {"xla_backend_optimization_level": 3}
if "fusion_emitters" in os.environ["XLA_FLAGS"]:  # newer versions do not know it
    AS_USERS_HAVE_IT["xla_cpu_use_fusion_emitters"] = True


def optimised(function, *arguments):
    return jax.device_get(jax.jit(function).lower(*arguments).compile(AS_USERS_HAVE_IT)(*arguments))


def test_the_derivative_of_icps_rows_is_that_by_every_unknown_by_itself():
    """Versions that pyproject.toml excludes fail here: with 0.10.2 the scale's column of the colour rows was x's."""
    assert largest_difference(*random_problem(np.random.default_rng(0)), AS_USERS_HAVE_IT) < 1e-4


def test_neighbours_are_the_nearest():
    rng = np.random.default_rng(0)
    points, queries = (np.float32(rng.uniform(-1, 1, (count, 3))) for count in (3000, 4800))
    valid = rng.uniform(size=3000) < 0.9
    rows, found = optimised(lambda *arrays: knn(*arrays, 8), queries, points, valid)
    assert found.all() and valid[rows].all()
    expected, _ = cKDTree(points[valid].astype(float)).query(queries, 8)
    # Squared distances that differ by a part of 3000 · 2⁻²³ count as equal.
    np.testing.assert_allclose(np.linalg.norm(points[rows] - queries[:, None], axis=-1), expected, rtol=4e-4)


def test_an_update_is_that_of_equations_2_to_4():
    num_points, num_gaussians = 600, 300
    config = sc.changed(sc.slam_config().em, max_mahalanobis_sq=60.0, min_normal_cos=0.85, min_responsibility=0.1)
    gaussians, points = sc.random_gaussians(num_gaussians, 1, 3), sc.random_observation(num_points, 1, 3)
    noise = np.float32(0.05 * np.random.default_rng(2).normal(size=(num_points, 3)))
    weight = np.linspace(0.5, 3.0, num_gaussians)
    map, step, _ = optimised(em_update, sc.fresh_map(gaussians, weight), points, noise, config)
    names, every = ("points", "normals", "features", "colors"), np.ones(num_points, bool)
    arrays = *(np.asarray(getattr(points, name), float) for name in names), noise.astype(float), every
    rows, fused, _ = reference.em_update(*arrays, sc.as_numpy(gaussians), weight, config)
    assert np.mean(step.is_fused != fused) < 0.005 and 0.2 < fused.mean() < 1  # at a gate a rounding decides
    g, apart = map.gaussians, []
    for k, expected in rows.items():
        actual = g.means[k], g.covs[k], g.normals[k], g.colors[k], map.weight[k]
        apart.append(max(np.abs(a - b).max() for a, b in zip(actual, expected, strict=True)))
    # Exponents near 60 lose 1e-5 each in float32, and shares are divided by totals down to .1; and so at a gate.
    assert len(apart) > 100 and np.quantile(apart, 0.98) < 1e-3


def test_normals_are_those_of_least_squares_over_the_window():
    """A slanted plane with errors of 1 %, and holes."""
    config = sc.slam_config("slam.observation.normal_radius=2", "slam.observation.normal_spacing=2").observation
    rng, (height, width) = np.random.default_rng(0), (96, 128)
    x, y = (np.arange(width) - 62.5) / 100, (np.arange(height) - 47.25) / 110
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
    points = np.float32(1.5 * rays / (1 + rays @ [0.1, 0.15, 0.0])[..., None])
    points *= 1 + 0.01 * rng.normal(size=(height, width, 1)).astype(np.float32)
    valid, ones = rng.uniform(size=(height, width)) < 0.8, np.ones((height, width), np.float32)
    images = np.abs(rays).astype(np.float32), np.zeros((height, width, 0), np.float32), ones
    seen = optimised(observe, points, *images, valid, sc.at(config, "max_depth_step", 0.03))
    normals, is_known = seen.normals.reshape(height, width, 3), seen.valid.reshape(height, width)
    assert is_known[valid].mean() > 0.95 and not is_known[~valid].any()
    for row, column in np.argwhere(is_known)[::97]:
        taps = range(-2, 3, 2)
        expected = reference.normal_of_window(points.astype(float), valid, row, column, taps, 0.03)
        # Sums of a window relative to its pixel in float32; .1 rad wide, so 1e-6 of them is 1e-5 rad.
        assert normals[row, column] @ expected > np.cos(np.radians(0.05))
