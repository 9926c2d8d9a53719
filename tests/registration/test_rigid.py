"""Rigid fits against Umeyama, robust ones against NumPy, screw motions and medians against what they are."""

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from scene import assert_same, path_pose, pose, pose_error, stack_poses

from emgs_jax.registration.rigid import (
    fit_rigid,
    fit_rigid_robust,
    interpolate,
    median,
    pose_row,
    scale_translation,
)

RNG = np.random.default_rng(0)


def test_a_row_of_poses_is_that_pose():
    poses = [path_pose(i) for i in range(3)]
    for row in (0, 2, -1):
        assert_same(pose_row(stack_poses(poses), row), poses[row])


def test_scaling_a_translation_keeps_the_rotation():
    T = scale_translation(path_pose(2), jnp.asarray(3.0))
    np.testing.assert_allclose(T.translation(), 3 * np.asarray(path_pose(2).translation()), rtol=1e-6)
    np.testing.assert_array_equal(T.rotation().wxyz, path_pose(2).rotation().wxyz)


def test_a_pose_on_the_way_shares_the_screw_motion_and_its_ends_are_the_ends():
    start, end = pose((0.4, -0.9, 0.3), (0.5, 1.0, -0.7)), pose((-0.2, 0.5, 1.1), (-1.0, 0.2, 0.4))
    # Logarithms in float32 of motions of 2 m and 2 rad.
    for share, expected in ((0.0, start), (1.0, end)):
        assert max(pose_error(interpolate(start, end, jnp.asarray(share)), expected)) < 1e-5
    whole = np.asarray((start.inverse() @ end).log())
    part = np.asarray((start.inverse() @ interpolate(start, end, jnp.asarray(0.3))).log())
    np.testing.assert_allclose(part, 0.3 * whole, atol=1e-5)


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


@pytest.fixture
def contaminated():
    """Pairs with noise of a centimetre, of which one in five is wrong by half a metre, all to the same side."""
    source, truth = RNG.uniform(-1, 1, (200, 3)), pose((0.1, -0.2, 0.3), (0.3, -0.1, 0.2))
    matrix = np.asarray(truth.as_matrix(), float)
    target = source @ matrix[:3, :3].T + matrix[:3, 3] + RNG.normal(size=(200, 3)) * 0.01
    target[::5, 0] += 0.5
    return jnp.asarray(source, jnp.float32), jnp.asarray(target, jnp.float32), truth


def test_a_robust_fit_equals_its_reweightings_in_numpy_and_withstands_wrong_pairs(contaminated):
    source, target, truth = contaminated
    start, paired = truth @ pose((0.05, 0.02, -0.04), (0.05, -0.1, 0.02)), np.arange(200) % 7 > 0
    T = fit_rigid_robust(source, jnp.where(paired[:, None], target, 1e3), jnp.asarray(paired), start)
    arrays = (np.asarray(x, float) for x in (source, target, start.as_matrix()))
    rotation, translation = reference.rigid_robust(*arrays, paired)
    np.testing.assert_allclose(T.rotation().as_matrix(), rotation, atol=2e-5)  # three SVDs in float32
    np.testing.assert_allclose(T.translation(), translation, atol=2e-5)
    distance, angle = pose_error(T, truth)
    assert distance < 0.02 and angle < 0.02  # a plain fit is off by 50 cm / 5


@pytest.mark.parametrize(("count", "is_kept"), [(15, True), (16, False), (0, True)])
def test_too_few_pairs_leave_the_start(contaminated, count, is_kept):
    source, target, truth = contaminated
    start = truth @ pose(translation=(0.1, 0, 0))
    T = fit_rigid_robust(source, target, jnp.arange(200) < count, start)
    assert np.array_equal(T.wxyz_xyz, start.wxyz_xyz) == is_kept


def test_exact_pairs_keep_the_pose_that_fits_them():
    source = jnp.asarray(RNG.uniform(-1, 1, (40, 3)), jnp.float32)
    T = fit_rigid_robust(source, source, jnp.ones(40, bool), jaxlie.SE3.identity())
    assert max(pose_error(T, pose())) < 1e-3  # quaternions from float32 matrices
