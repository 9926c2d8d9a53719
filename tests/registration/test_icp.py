"""Rigid fits against Umeyama, ICP against the true pose of a closed room and against Open3D from the same starts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import open3d as o3d
import pytest
import reference
from jaxlie import SE3
from scene import (
    as_numpy,
    assert_same,
    at,
    move_gaussians,
    observe_room,
    path_pose,
    pose,
    pose_error,
    random_gaussians,
)

from emgs_jax.gaussians import color_gradients, fit_to_points
from emgs_jax.observation import transform
from emgs_jax.registration.icp import icp
from emgs_jax.registration.rigid import fit_rigid, median

RNG = np.random.default_rng(0)
pytestmark = pytest.mark.slow  # the solver compiles for 10 s; the quick subset has test_localization
RESIDUALS = {"colored": 0, "distribution": 1, "colored+distribution": 2}
NOISE = jnp.asarray(0.02), jnp.asarray(0.01)
STARTS = [
    pose((0.02, -0.02, 0.01), (0.03, 0.02, -0.03)),
    pose((-0.01, 0.03, 0.0), (-0.04, 0.01, 0.02)),
    pose((0.015, 0.01, -0.025), (0.01, -0.04, 0.03)),
    pose((0.0, 0.0, 0.03), (0.03, 0.03, 0.03)),
]
solve = eqx.filter_jit(icp)
TRUTH = path_pose(2)


@pytest.fixture(scope="module")
def source(camera):
    return observe_room(TRUTH, camera)


@pytest.fixture(scope="module")
def target(camera, config):
    """Gaussians of the room, fitted to the exact points of another view."""
    other = path_pose(0)
    world = transform(other, observe_room(other, camera), jnp.ones(()))
    return eqx.filter_jit(fit_to_points)(world.points[::2], jnp.ones(384, bool), world, config().fit)


@pytest.fixture(scope="module")
def settings(config):
    """No prior, wide gates, enough steps: what is tested is where the data term has its minimum."""
    settings = config("slam.localization.icp.max_steps=20", "slam.localization.icp.num_points=768").localization.icp
    return at(at(settings, "prior_information", 0.0), "max_mahalanobis_sq", 25.0)


def test_a_rigid_fit_equals_umeyama_and_recovers_scale():
    source, weights = RNG.normal(size=(50, 3)), RNG.uniform(0, 1, 50)
    truth = pose((0.5, -1.0, 0.7), (1, 2, 3))
    matrix = np.asarray(truth.as_matrix(), float)
    target = 1.3 * source @ matrix[:3, :3].T + matrix[:3, 3] + RNG.normal(size=(50, 3)) * 0.05
    rotation, _, scale = reference.umeyama(source, target, weights)
    share = weights / weights.sum()
    T, actual = fit_rigid(*(jnp.asarray(x, jnp.float32) for x in (source, target, weights)))
    np.testing.assert_allclose(T.rotation().as_matrix(), rotation, atol=1e-5)  # float32 SVD
    # Rigid, so the translation is that of scale 1.
    np.testing.assert_allclose(T.translation(), share @ target - rotation @ (share @ source), atol=1e-5)
    np.testing.assert_allclose(actual, scale, rtol=1e-5)


@pytest.mark.parametrize("flatten", [(1, 1, 0), (1, 1, 1), (-1, 1, 1)])
def test_exact_pairs_give_a_proper_rotation_even_from_a_plane_or_a_mirror(flatten):
    source = (RNG.normal(size=(30, 3)) * [1, 1, abs(flatten[2])]).astype(np.float32)
    truth = pose((0.2, 2.0, -0.4), (0.1, 0, -3))
    mirrored = source * np.float32([flatten[0], 1, 1])
    target = jnp.asarray(mirrored) @ truth.rotation().as_matrix().T + truth.translation()
    T, _ = fit_rigid(jnp.asarray(source), target, jnp.ones(30))
    assert np.linalg.det(np.asarray(T.rotation().as_matrix(), float)) == pytest.approx(1, abs=1e-4)
    if flatten[0] > 0:
        assert max(pose_error(T, truth)) < 1e-3  # quaternions from float32 matrices


def test_pairs_without_weight_do_not_count_and_none_at_all_give_the_identity():
    source = jnp.asarray(RNG.normal(size=(20, 3)), jnp.float32)
    target = (source + jnp.array([1.0, 0, 0])).at[10:].set(1e3)
    T, scale = fit_rigid(source, target, (jnp.arange(20) < 10).astype(jnp.float32))
    assert max(pose_error(T, pose(translation=(1, 0, 0)))) < 1e-3  # float32 means over values up to 1000
    T, scale = fit_rigid(source, target, jnp.zeros(20))
    assert max(pose_error(T, pose())) == 0 and scale == 1


def test_the_median_is_the_lower_one_of_the_valid_values():
    values = jnp.array([5.0, 1.0, jnp.nan, 3.0, 9.0])
    assert median(values, jnp.array([1, 1, 0, 1, 1], bool)) == 3
    assert median(values, jnp.array([1, 1, 0, 0, 1], bool)) == 5
    assert median(values, jnp.zeros(5, bool)) == 1


def test_a_linear_intensity_on_a_plane_has_its_gradient_within_the_plane():
    g = random_gaussians(80)
    normal = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
    means = np.asarray(g.means, float)
    means -= (means @ normal)[:, None] * normal
    slope = np.array([0.1, 0.2, -0.1])
    light = 0.5 + means @ slope
    colors = np.tile(light[:, None], (1, 3))  # luminance of grey is grey
    arrays = [jnp.asarray(x, jnp.float32) for x in (means, colors, np.tile(normal, (80, 1)))]
    g = eqx.tree_at(lambda x: (x.means, x.colors, x.normals), g, tuple(arrays))
    gradients = np.asarray(color_gradients(g, 12))
    expected = slope - (slope @ normal) * normal
    np.testing.assert_allclose(gradients @ normal, 0, atol=1e-6)
    # The documented ridge of a hundredth of the spread shrinks the gradient by a few per cent.
    np.testing.assert_allclose(gradients, np.tile(expected, (80, 1)), atol=0.12 * np.linalg.norm(expected))


def errors(target, source, config, starts):
    return np.array([pose_error(solve(source, target, TRUTH @ start, NOISE, config)[0], TRUTH) for start in starts])


@pytest.mark.parametrize("residual", RESIDUALS)
def test_every_residual_recovers_the_pose_in_a_closed_room(source, target, settings, residual):
    found = errors(target, source, at(settings, "residual", RESIDUALS[residual]), STARTS)
    # From 5 cm and 2 degrees; pixels and Gaussians are 10 cm apart. Gaussians across the edges are no planes
    # and leave some millimetres; the offsets from such sparse means (R9) leave up to a quarter of the spacing.
    limit = 0.01 if residual == "colored" else 0.025
    assert found[:, 0].max() < limit, found
    assert found[:, 1].max() < limit, found


def cloud(points, normals, colors):
    result = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    result.normals, result.colors = o3d.utility.Vector3dVector(normals), o3d.utility.Vector3dVector(colors)
    return result


@pytest.mark.parametrize(("residual", "rival"), [("colored", "colored"), ("distribution", "plane")])
def test_the_error_is_no_larger_than_open3ds_from_the_same_starts(source, target, settings, residual, rival):
    method = o3d.pipelines.registration
    g, o = as_numpy(target), [np.asarray(x, float) for x in (source.points, source.normals, source.colors)]
    clouds = cloud(*o), cloud(g["means"], g["normals"], g["colors"])
    limit = method.ICPConvergenceCriteria(max_iteration=50)
    theirs = []
    for start in STARTS:
        begin = np.asarray((TRUTH @ start).as_matrix(), float)
        if rival == "colored":
            estimate = method.TransformationEstimationForColoredICP()
            result = method.registration_colored_icp(*clouds, 0.3, begin, estimate, limit)
        else:
            estimate = method.TransformationEstimationPointToPlane()
            result = method.registration_icp(*clouds, 0.3, begin, estimate, limit)
        theirs.append(pose_error(SE3.from_matrix(jnp.asarray(result.transformation, jnp.float32)), TRUTH))
    ours = errors(target, source, at(settings, "residual", RESIDUALS[residual]), STARTS)
    assert (ours.mean(0) <= 1.2 * np.mean(theirs, axis=0) + 1e-4).all(), (ours.mean(0), np.mean(theirs, axis=0))


def test_an_overwhelming_prior_holds_the_coarse_pose(source, target, settings):
    start = TRUTH @ STARTS[0]
    held, _, _ = solve(source, target, start, NOISE, at(settings, "prior_information", 1e9))
    free, _, _ = solve(source, target, start, NOISE, settings)
    assert max(pose_error(held, start)) < 1e-4 < 0.02 < pose_error(free, start)[0]


def test_the_info_counts_inliers_and_measures_their_planes(source, target, settings):
    T, _, info = solve(source, target, TRUTH @ STARTS[0], NOISE, settings)
    assert 0.5 * 768 < info.num_inliers <= 768
    assert info.inlier_fraction == pytest.approx(float(info.num_inliers) / 768)
    assert info.residual < 0.02 and info.misfit < 0.02  # exact points: only edges are off their planes
    assert info.min_eigenvalue > 0 and info.num_steps > 0
    _, _, strict = solve(source, target, TRUTH, NOISE, at(settings, "min_normal_cos", 1.1))
    assert strict.num_inliers == 0 and strict.inlier_fraction == 0 and strict.residual == 0


def test_a_single_plane_does_not_determine_the_pose(source, target, settings):
    wall = np.asarray(target.normals[:, 2]) < -0.99
    plain = eqx.tree_at(lambda g: (g.valid, g.colors), target, (jnp.asarray(wall), jnp.full((384, 3), 0.5)))
    facing = eqx.tree_at(lambda o: o.colors, source, jnp.full((768, 3), 0.5))
    config = at(settings, "residual", RESIDUALS["colored"])
    _, _, whole = solve(source, target, TRUTH, NOISE, config)
    _, _, flat = solve(facing, plain, TRUTH, NOISE, config)
    assert wall.sum() > 30 and flat.num_inliers > 50
    assert flat.min_eigenvalue < 1e-3 * whole.min_eigenvalue


@pytest.mark.parametrize("residual", RESIDUALS)
def test_the_pose_moves_with_a_rigid_motion_of_the_world(source, target, settings, residual):
    config, motion = at(settings, "residual", RESIDUALS[residual]), pose((0.7, 0.2, -0.4), (1.0, -2.0, 0.5))
    start = TRUTH @ STARTS[0]
    still, _, _ = solve(source, target, start, NOISE, config)
    moved, _, _ = solve(source, move_gaussians(motion, target), motion @ start, NOISE, config)
    # The solver stops where a step changes the cost by 1e-4 of it; both stop near the same minimum.
    assert max(pose_error(moved, motion @ still)) < 2e-3


def test_without_any_gaussian_or_point_the_coarse_pose_stays(source, target, settings):
    empty = eqx.tree_at(lambda g: g.valid, target, jnp.zeros(384, bool))
    blind = eqx.tree_at(lambda o: o.valid, source, jnp.zeros(768, bool))
    for points, gaussians in ((source, empty), (blind, target)):
        T, _, info = solve(points, gaussians, TRUTH, NOISE, settings)
        assert info.num_inliers == 0
        assert max(pose_error(T, TRUTH)) < 1e-6


@pytest.mark.parametrize("poison", [1e6, -1e6])
def test_invalid_points_and_gaussians_change_nothing(source, target, settings, poison):
    put = lambda tree, mask: jax.tree.map(  # noqa: E731
        lambda x: x if x.dtype != jnp.float32 else jnp.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, poison), tree
    )
    seen, known = jnp.arange(768) % 3 > 0, jnp.arange(384) % 3 > 0
    points = eqx.tree_at(lambda o: o.valid, source, seen)
    gaussians = eqx.tree_at(lambda g: g.valid, target, known)
    clean = solve(points, gaussians, TRUTH @ STARTS[1], NOISE, settings)
    poisoned = solve(put(points, seen), put(gaussians, known), TRUTH @ STARTS[1], NOISE, settings)
    assert_same(poisoned, clean)


def test_a_common_error_of_scale_is_found_only_where_it_may_be(source, target, settings):
    small = eqx.tree_at(lambda o: o.points, source, source.points / 1.03)
    _, none, _ = solve(small, target, TRUTH, NOISE, at(settings, "scale_noise", 0.0))
    _, found, _ = solve(small, target, TRUTH, NOISE, at(settings, "scale_noise", 10.0))
    assert none == 1.0
    assert found == pytest.approx(1.03, abs=0.01)  # points are matched with the centres of sparse Gaussians
