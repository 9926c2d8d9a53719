"""Rigid fits against Umeyama, robust ones against NumPy, screw motions and medians against what they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from scene import assert_same, matrix_of, on_host, path_pose, pose, pose_error, product, stack_poses

from emgs_jax.registration import rigid
from emgs_jax.registration.rigid import pose_row

fit_rigid, fit_rigid_robust, median, scale_translation = (
    on_host(f) for f in (rigid.fit_rigid, rigid.fit_rigid_robust, rigid.median, rigid.scale_translation)
)
NUM_PAIRS = 200
RNG = np.random.default_rng(0)


def test_a_row_of_poses_is_that_pose():
    poses = [path_pose(i) for i in range(3)]
    for row in (0, 2, -1):
        assert_same(pose_row(stack_poses(poses), row), poses[row])


def test_scaling_a_translation_keeps_the_rotation():
    T, given = scale_translation(path_pose(2), np.float32(3.0)).wxyz_xyz, np.asarray(path_pose(2).wxyz_xyz)
    np.testing.assert_allclose(T[4:], 3 * given[4:], rtol=1e-6)
    np.testing.assert_array_equal(T[:4], given[:4])


def test_a_rigid_fit_equals_umeyama_and_recovers_scale():
    source, weights = RNG.normal(size=(NUM_PAIRS, 3)), RNG.uniform(0, 1, NUM_PAIRS)
    matrix = matrix_of(pose((0.5, -1.0, 0.7), (1, 2, 3)))
    target = 1.3 * source @ matrix[:3, :3].T + matrix[:3, 3] + RNG.normal(size=(NUM_PAIRS, 3)) * 0.05
    rotation, _, scale = reference.umeyama(source, target, weights)
    share = weights / weights.sum()
    T, actual = fit_rigid(*(np.float32(x) for x in (source, target, weights)))
    np.testing.assert_allclose(matrix_of(T)[:3, :3], rotation, atol=1e-5)  # float32 SVD
    # Rigid, so the translation is that of scale 1.
    np.testing.assert_allclose(matrix_of(T)[:3, 3], share @ target - rotation @ (share @ source), atol=1e-5)
    np.testing.assert_allclose(actual, scale, rtol=1e-5)


@pytest.mark.parametrize("flatten", [(1, 1, 0), (1, 1, 1), (-1, 1, 1)])
def test_exact_pairs_give_a_proper_rotation_even_from_a_plane_or_a_mirror(flatten):
    source = (RNG.normal(size=(NUM_PAIRS, 3)) * [1, 1, abs(flatten[2])]).astype(np.float32)
    truth = pose((0.2, 2.0, -0.4), (0.1, 0, -3))
    mirrored, matrix = source * np.float32([flatten[0], 1, 1]), matrix_of(truth)
    target = np.float32(mirrored @ matrix[:3, :3].T + matrix[:3, 3])
    T, _ = fit_rigid(source, target, np.ones(NUM_PAIRS, np.float32))
    turn = on_host(lambda T: T.rotation().as_matrix())(T)
    assert np.linalg.det(turn.astype(float)) == pytest.approx(1, abs=1e-4)
    if flatten[0] > 0:
        assert max(pose_error(T, truth)) < 1e-3  # quaternions from float32 matrices


def test_pairs_without_weight_do_not_count_and_none_at_all_give_the_identity():
    source, count = RNG.normal(size=(NUM_PAIRS, 3)).astype(np.float32), np.arange(NUM_PAIRS) < 10
    target = np.where(count[:, None], source + np.float32([1, 0, 0]), np.float32(1e3))
    T, scale = fit_rigid(source, target, np.float32(count))
    assert max(pose_error(T, pose(translation=(1, 0, 0)))) < 1e-3  # float32 means over values up to 1000
    T, scale = fit_rigid(source, target, np.zeros(NUM_PAIRS, np.float32))
    assert max(pose_error(T, pose())) == 0 and scale == 1


def test_the_median_is_the_lower_one_of_the_valid_values():
    values = np.float32([5.0, 1.0, np.nan, 3.0, 9.0])
    for valid, expected in (([1, 1, 0, 1, 1], 3), ([1, 1, 0, 0, 1], 5), ([0] * 5, 1)):
        assert median(values, np.array(valid, bool)) == expected


@pytest.fixture
def contaminated():
    """Pairs with noise of a centimetre, of which one in five is wrong by half a metre, all to the same side."""
    source, truth = RNG.uniform(-1, 1, (NUM_PAIRS, 3)), pose((0.1, -0.2, 0.3), (0.3, -0.1, 0.2))
    matrix = matrix_of(truth)
    target = source @ matrix[:3, :3].T + matrix[:3, 3] + RNG.normal(size=(NUM_PAIRS, 3)) * 0.01
    target[::5, 0] += 0.5
    return np.float32(source), np.float32(target), truth


def test_a_robust_fit_equals_its_reweightings_in_numpy_and_withstands_wrong_pairs(contaminated):
    source, target, truth = contaminated
    start, paired = product(truth, pose((0.05, 0.02, -0.04), (0.05, -0.1, 0.02))), np.arange(NUM_PAIRS) % 7 > 0
    T = fit_rigid_robust(source, np.where(paired[:, None], target, np.float32(1e3)), paired, start)
    arrays = source.astype(float), target.astype(float), matrix_of(start)
    rotation, translation = reference.rigid_robust(*arrays, paired)
    np.testing.assert_allclose(matrix_of(T)[:3, :3], rotation, atol=2e-5)  # three SVDs in float32
    np.testing.assert_allclose(matrix_of(T)[:3, 3], translation, atol=2e-5)
    distance, angle = pose_error(T, truth)
    assert distance < 0.02 and angle < 0.02  # a plain fit is off by 50 cm / 5


@pytest.mark.parametrize(("count", "is_kept"), [(15, True), (16, False), (0, True)])
def test_too_few_pairs_leave_the_start(contaminated, count, is_kept):
    source, target, truth = contaminated
    start = product(truth, pose(translation=(0.1, 0, 0)))
    T = fit_rigid_robust(source, target, np.arange(NUM_PAIRS) < count, start)
    assert np.array_equal(T.wxyz_xyz, start.wxyz_xyz) == is_kept


def test_exact_pairs_keep_the_pose_that_fits_them():
    source = RNG.uniform(-1, 1, (NUM_PAIRS, 3)).astype(np.float32)
    T = fit_rigid_robust(source, source, np.ones(NUM_PAIRS, bool), pose())
    assert max(pose_error(T, pose())) < 1e-3  # quaternions from float32 matrices


SQUARE = np.stack([*np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-1, 1, 6)), np.full((6, 6), 2.0)], -1).reshape(-1, 3)
CUBE = np.float64(list(np.ndindex(2, 2, 2))) + [0, 0, 3.0]


@pytest.mark.parametrize("source", [SQUARE, CUBE, RNG.normal(size=(20, 3))], ids=["square", "cube", "any"])
def test_slopes_of_a_fit_are_those_of_float64_differences_however_symmetric_the_points_are(source):
    """Singular values that are equal, as those of a square wall, made all of them NaN."""
    matrix = matrix_of(pose((0.2, -0.4, 0.3), (1, 2, 3)))
    weights, direction = RNG.uniform(0.5, 1, len(source)), RNG.normal(size=(2, *source.shape))
    weights = np.ones(len(source)) if len(source) != 20 else weights
    ends = source, source @ matrix[:3, :3].T + matrix[:3, 3]

    def placed(source, target):
        T, scale = rigid.fit_rigid(source, target, jnp.float32(weights))
        return jnp.append(T.rotation().as_matrix().ravel(), jnp.append(T.translation(), scale))

    def exact(step):
        R, _, scale = reference.umeyama(ends[0] + step * direction[0], ends[1] + step * direction[1], weights)
        share = weights / weights.sum()
        t = share @ (ends[1] + step * direction[1]) - R @ (share @ (ends[0] + step * direction[0]))
        return np.concatenate([R.ravel(), t, [scale]])

    slopes = on_host(lambda *x: jax.jvp(placed, x[:2], x[2:])[1])(*map(np.float32, (*ends, *direction)))
    np.testing.assert_allclose(slopes, (exact(1e-5) - exact(-1e-5)) / 2e-5, atol=2e-4)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_where_nothing_determines_a_rotation_it_has_no_slope(weight):
    same = np.ones((16, 3), np.float32)  # whose mean is exact

    def total(source):
        T, scale = rigid.fit_rigid(source, jnp.asarray(same), jnp.full(16, np.float32(weight)))
        return jnp.sum(T.rotation().wxyz) + scale

    assert not on_host(jax.grad(total))(same).any()
