"""Bundle adjustment against the truth, against SciPy on the problem with all points, and under poison."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.optimize import least_squares
from stereo_scene import arc, cloud, matrix, projected, small_camera, structure_config

from emgs_jax.prior.multiview.bundle_adjustment import Tracks, Unknowns, adjust

pytestmark = pytest.mark.slow  # compiling the solver takes ten seconds
NUM_VIEWS, NUM_POINTS = 4, 24
OVERRIDES = tuple(f"prior.structure.bundle.{key}" for key in ("max_steps=30", "tolerance=1e-6", "damping=1e-7"))
jitted_adjust = eqx.filter_jit(adjust)


@pytest.fixture(scope="module")
def scene():
    """Poses, points and exact pixels."""
    poses, points = arc(NUM_VIEWS), cloud(NUM_POINTS)
    return poses, points, np.stack([projected(T, points) for T in poses])


def solve(poses, points, pixels, is_seen=None, is_fixed=(True, True, False, False), pixel_std=1.0):
    is_seen = np.ones(pixels.shape[:2], bool) if is_seen is None else is_seen
    config = structure_config(*OVERRIDES, f"prior.structure.bundle.pixel_std={pixel_std}").bundle
    return jitted_adjust(
        jaxlie.SE3.from_matrix(jnp.asarray(poses, jnp.float32)),
        jnp.asarray(points, jnp.float32),
        Tracks(jnp.asarray(pixels, jnp.float32), jnp.asarray(is_seen)),
        Unknowns(jnp.asarray(np.flatnonzero(~np.asarray(is_fixed))), *jnp.zeros(2)),
        small_camera(),
        config,
    )


def disturbed(poses, points, seed=0):
    """Two views moved by some 2 cm and 1 degree an axis, all points by 5 cm."""
    rng = np.random.default_rng(seed)
    T = jaxlie.SE3.from_matrix(jnp.asarray(poses, jnp.float32))
    xi = 0.02 * rng.normal(size=(NUM_VIEWS, 6))
    xi[:2] = 0
    moved = T @ jaxlie.SE3.exp(jnp.asarray(xi, jnp.float32))
    return np.asarray(moved.as_matrix()), points + 0.05 * rng.normal(size=points.shape)


def pose_errors(T, poses):
    """Distance (m) and angle (rad) of every view from the truth, (v, 2)."""
    xi = np.asarray((jaxlie.SE3.from_matrix(jnp.asarray(poses, jnp.float32)).inverse() @ T).log(), float)
    return np.stack([np.linalg.norm(xi[:, :3], axis=1), np.linalg.norm(xi[:, 3:], axis=1)], axis=1)


def test_exact_tracks_give_back_the_poses_and_points_and_fixed_views_stay_bit_for_bit(scene):
    poses, points, pixels = scene
    start, moved = disturbed(poses, points)
    T, found, distortion, error = solve(start, moved, pixels)
    before = jaxlie.SE3.from_matrix(jnp.asarray(start, jnp.float32))
    assert distortion == 0
    assert pose_errors(before, poses)[2:].min() > 0.01, "the two free views start centimetres and degrees away"
    assert pose_errors(T, poses).max() < 1e-3
    np.testing.assert_allclose(found, points, atol=5e-3)
    assert np.max(error) < 0.02  # pixels
    assert np.array_equal(T.wxyz_xyz[:2], before.wxyz_xyz[:2])
    assert not np.array_equal(T.wxyz_xyz[2:], before.wxyz_xyz[2:])


def test_eliminating_the_points_gives_the_solution_of_the_whole_problem(scene):
    poses, points, pixels = scene
    pixels = pixels + 0.4 * np.random.default_rng(3).normal(size=pixels.shape)

    def unpack(x):
        moved = [poses[2 + k] @ matrix(x[6 * k : 6 * k + 3], x[6 * k + 3 : 6 * k + 6]) for k in range(2)]
        return np.stack([poses[0], poses[1], *moved]), x[12:].reshape(-1, 3)

    dense = least_squares(lambda x: cauchy(*unpack(x), pixels), np.concatenate([np.zeros(12), points.ravel()]))
    true_poses, true_points = unpack(dense.x)
    T, found, *_ = solve(poses, points, pixels)
    loss = (cauchy(np.asarray(T.as_matrix(), float), np.asarray(found, float), pixels) ** 2).sum()
    assert loss == pytest.approx(2 * dense.cost, rel=2e-3)
    np.testing.assert_allclose(T.as_matrix(), true_poses, atol=2e-3)
    np.testing.assert_allclose(found, true_points, atol=0.03)
    assert np.abs(true_points - points).max() > 0.1  # so far the noise moved them


def cauchy(poses, points, pixels):
    error = np.stack([projected(T, points) for T in poses]) - pixels
    length = np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), 1e-9)
    return (np.sqrt(np.log1p(length**2)) * error / length).ravel()


def test_an_outlier_moves_the_poses_far_less_than_it_would_least_squares(scene):
    poses, points, pixels = scene
    wrong = pixels.copy()
    wrong[2, 5] += (30.0, -20.0)
    robust, _, _, error = solve(poses, points, wrong)
    plain, *_ = solve(poses, points, wrong, pixel_std=300.0)  # the loss is quadratic below it
    moved = pose_errors(robust, poses).max(axis=0)
    assert (moved < 0.1 * pose_errors(plain, poses).max(axis=0)).all()
    assert moved.max() < 5e-3
    assert np.argmax(error) == 2 * NUM_POINTS + 5


def test_what_no_view_sees_stays_and_what_is_not_seen_is_not_read(scene):
    poses, points, pixels = scene
    is_seen = np.ones(pixels.shape[:2], bool)
    is_seen[:, 7] = False  # a landmark that no view sees
    is_seen[3] = False  # a view that sees no landmark
    start, moved = disturbed(poses, points)
    poisoned = np.where(is_seen[..., None], pixels, np.nan)
    T, found, distortion, error = solve(start, moved, pixels, is_seen)
    assert eqx.tree_equal((T, found, distortion, error), solve(start, moved, poisoned, is_seen))
    np.testing.assert_array_equal(found[7], np.float32(moved[7]))
    np.testing.assert_array_equal(T.wxyz_xyz[3], jaxlie.SE3.from_matrix(jnp.asarray(start[3], jnp.float32)).wxyz_xyz)
    assert np.isinf(np.asarray(error)[~is_seen]).all() and np.isfinite(np.asarray(error)[is_seen]).all()


def test_a_point_behind_a_view_is_no_observation_of_it(scene):
    poses, points, pixels = scene
    points = points.copy()
    points[0, 2] = -1.0
    is_seen = np.ones(pixels.shape[:2], bool)
    is_seen[1:, 0] = False
    _, found, _, error = solve(poses, points, pixels, is_seen)
    np.testing.assert_array_equal(found[0], np.float32(points[0]))
    assert np.isinf(error[0, 0])
