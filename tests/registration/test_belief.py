"""What is known from frame to frame: against samples of the errors, and against the textbook's Kalman filter."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scene import pose

from emgs_jax.registration.belief import certain, measured, moved, next_belief, predict, root_information, update
from emgs_jax.registration.icp import IcpInfo

MOTION = pose((0.2, -0.1, 0.3), (0.3, 0.05, -0.4))


def covariance(seed: int = 0) -> jax.Array:
    """Positive definite, centimetres and hundredths."""
    factor = np.random.default_rng(seed).normal(size=(7, 7)) * 0.01
    return jnp.asarray(factor @ factor.T + 1e-5 * np.eye(7), jnp.float32)


def test_the_errors_of_the_next_pose_are_distributed_as_predicted():
    """T Exp(ξ) Z Exp(noise) = T Z Exp(error) for 20,000 draws."""
    P, noise = covariance(), jnp.linspace(0.005, 0.02, 7)
    rng = np.random.default_rng(1)
    before = rng.multivariate_normal(np.zeros(7), np.asarray(P, float), 20_000)
    own = rng.normal(size=(20_000, 7)) * np.asarray(noise)
    moved = jaxlie.SE3.exp(jnp.asarray(before[:, :6])) @ MOTION @ jaxlie.SE3.exp(jnp.asarray(own[:, :6]))
    errors = np.column_stack([(MOTION.inverse() @ moved).log(), before[:, 6] + own[:, 6]])
    sampled, predicted = np.cov(errors.T), np.asarray(predict(P, MOTION, noise))
    std = np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(sampled / np.outer(std, std), predicted / np.outer(std, std), atol=0.04)


def test_a_motion_that_is_not_finite_only_adds_noise():
    P, noise = covariance(), jnp.full(7, 0.1)
    lost = jaxlie.SE3(jnp.full(7, jnp.nan))
    np.testing.assert_allclose(predict(P, lost, noise), P + 0.01 * jnp.eye(7), rtol=1e-6)


def test_an_update_is_that_of_the_kalman_filter():
    P, R, d = np.asarray(covariance(), float), np.asarray(covariance(1), float), np.linspace(-0.1, 0.1, 7)
    gain = P @ np.linalg.inv(P + R)
    step, after = update(
        jnp.asarray(P, jnp.float32), jnp.asarray(d, jnp.float32), jnp.asarray(np.linalg.inv(R), jnp.float32)
    )
    np.testing.assert_allclose(step, gain @ d, atol=2e-3)
    np.testing.assert_allclose(after, (np.eye(7) - gain) @ P, atol=1e-5)


def test_what_is_certain_stays_and_what_is_not_measured_says_nothing():
    step, after = update(jnp.zeros((7, 7)), jnp.ones(7), jnp.eye(7))
    assert not np.any(step) and not np.any(after)
    step, after = update(covariance(), jnp.ones(7), jnp.zeros((7, 7)))
    assert not np.any(step)
    np.testing.assert_allclose(after, covariance(), rtol=1e-4, atol=1e-8)


def test_both_covariances_take_motion_and_measurement_and_the_step_is_that_in_the_map():
    before = eqx.tree_at(lambda b: (b.covariance, b.world_covariance), certain(), (covariance(), covariance(2)))
    noise, d, W = jnp.linspace(0.005, 0.02, 7), jnp.linspace(-0.1, 0.1, 7), jnp.linalg.inv(covariance(1))
    step, after = measured(moved(before, MOTION, noise), d, W, jnp.asarray(4.0))
    expected_step, expected = update(predict(covariance(), MOTION, noise), d, W)
    np.testing.assert_allclose(step, expected_step, rtol=1e-5)
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-5)
    _, expected = update(predict(covariance(2), MOTION, noise), d, W / 4.0)  # four frames err alike in the world
    np.testing.assert_allclose(after.world_covariance, expected, rtol=1e-5)


def test_the_root_measures_the_mahalanobis_distance():
    P, x = covariance(), jnp.linspace(-0.1, 0.2, 7)
    expected = np.asarray(x, float) @ np.linalg.solve(np.asarray(P, float), np.asarray(x, float))
    assert float(jnp.sum((root_information(P) @ x) ** 2)) == pytest.approx(expected, rel=1e-2)


def test_a_frame_that_is_tracked_is_known_as_its_points_say_and_another_as_before():
    before = eqx.tree_at(lambda b: (b.covariance, b.world_covariance), certain(), (covariance(), covariance(2)))
    before = eqx.tree_at(lambda b: b.repeats.said, before, jaxlie.SE3(jnp.tile(MOTION.wxyz_xyz, (2, 1))))
    zero, one = jnp.zeros(()), jnp.ones((), jnp.int32)
    found = IcpInfo(one, zero, zero, jnp.asarray(0.04), jnp.zeros(8), 1e4 * jnp.eye(7), zero, zero, one, one > 0)
    arguments = before, found, jnp.asarray(0.02), jnp.asarray(1.1)
    after = next_belief(*arguments, jnp.asarray(True), jnp.asarray(5.0))
    # Twice the noise is four times P, and five frames whose points err alike say of the scale what one of them does.
    said = jnp.diag(jnp.asarray([1e4] * 6 + [2e3]))
    _, expected = update(4.0 * covariance(), jnp.zeros(7), said)
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-5)
    _, expected = update(4.0 * covariance(2), jnp.zeros(7), found.information / 5.0)  # and so of the place in the world
    np.testing.assert_allclose(after.world_covariance, expected, rtol=1e-5)
    np.testing.assert_allclose(after.log_scale, np.log(1.1) / 2, rtol=1e-5)
    assert after.num_scales == 2 and after.depth_noise == pytest.approx(0.04)
    same = next_belief(*arguments, jnp.asarray(False), jnp.asarray(5.0))
    # What the prior said of the poses is said, whether its points fit or not: in the unit of its final scale.
    for belief in (after, same):
        np.testing.assert_allclose(belief.repeats.said.translation(), 1.1 * before.repeats.said.translation())
    same = eqx.tree_at(lambda b: b.repeats, same, before.repeats)
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a, b)
