"""What is known from frame to frame: against samples of the errors, and against the textbook's Kalman filter."""

import equinox as eqx
import jax
import jaxlie
import numpy as np
import pytest
from scene import device, on_host, pose, replace

from emgs_jax.registration import pose_estimate
from emgs_jax.registration.depth_field import DepthField
from emgs_jax.registration.icp import IcpInfo
from emgs_jax.registration.pose_estimate import exact_estimate

measured, moved, next_belief, predict, rescaled, root_information, update = (
    on_host(f)
    for f in (
        *(
            pose_estimate.correct,
            pose_estimate.propagate,
            pose_estimate.correct_by_points,
            pose_estimate.propagate_covariance,
        ),
        *(pose_estimate.rescale_estimate, pose_estimate.root_information, pose_estimate.kalman_update),
    )
)
MOTION = pose((0.2, -0.1, 0.3), (0.3, 0.05, -0.4))
NOISE, STEP = np.float32(np.linspace(0.005, 0.02, 7)), np.float32(np.linspace(-0.1, 0.1, 7))


def covariance(seed: int = 0) -> np.ndarray:
    """Positive definite, centimetres and hundredths."""
    factor = np.random.default_rng(seed).normal(size=(7, 7)) * 0.01
    return np.float32(factor @ factor.T + 1e-5 * np.eye(7))


def known():
    return replace(exact_estimate(), covariance=covariance())


def test_the_errors_of_the_next_pose_are_distributed_as_predicted():
    """T Exp(ξ) Z Exp(noise) = T Z Exp(error) for 20,000 draws."""
    P, rng = covariance(), np.random.default_rng(1)
    before = rng.multivariate_normal(np.zeros(7), np.asarray(P, float), 20_000)
    own = rng.normal(size=(20_000, 7)) * NOISE

    @on_host
    def errors_of(before, own):
        moved = jaxlie.SE3.exp(before) @ MOTION @ jaxlie.SE3.exp(own)
        return (MOTION.inverse() @ moved).log()

    errors = np.column_stack([errors_of(np.float32(before[:, :6]), np.float32(own[:, :6])), before[:, 6] + own[:, 6]])
    sampled, predicted = np.cov(errors.T), predict(P, MOTION, np.diag(NOISE**2))
    std = np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(sampled / np.outer(std, std), predicted / np.outer(std, std), atol=0.04)


def test_a_motion_that_is_not_finite_only_adds_noise():
    P, lost = covariance(), jaxlie.SE3(device(np.full(7, np.nan)))
    np.testing.assert_allclose(predict(P, lost, 0.01 * np.eye(7, dtype=np.float32)), P + 0.01 * np.eye(7), rtol=1e-6)


def test_in_another_unit_of_length_all_is_known_as_well_as_before():
    """Of which a metre has three times as many: motion, noise and errors of the pose are three times as long."""
    factor, units = np.float32(3.0), np.float32([3.0] * 3 + [1.0] * 4)
    longer = jaxlie.SE3(MOTION.wxyz_xyz * np.float32([1.0] * 4 + [3.0] * 3))
    found = moved(rescaled(known(), factor), longer, np.diag((units * NOISE) ** 2))
    expected = rescaled(moved(known(), MOTION, np.diag(NOISE**2)), factor)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(rescaled(known(), factor).covariance[3:, 3:], covariance()[3:, 3:])
    assert expected.log_scale == pytest.approx(np.log(3.0))


def test_an_update_is_that_of_the_kalman_filter():
    P, R = (covariance(seed).astype(float) for seed in (0, 1))
    gain = P @ np.linalg.inv(P + R)
    step, after = update(np.float32(P), STEP, np.float32(np.linalg.inv(R)))
    np.testing.assert_allclose(step, gain @ STEP, atol=2e-3)
    np.testing.assert_allclose(after, (np.eye(7) - gain) @ P, atol=1e-5)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("rank", [1, 7])
def test_an_update_is_a_covariance_in_every_unit_however_well_directions_are_known(unit, rank):
    """Metres beside what is known a thousand times as well; with rank 1 all errors are one and the same."""
    axes, known = np.linalg.qr(np.random.default_rng(0).normal(size=(7, 7)))[0], np.logspace(0, -6, 7)
    units = np.array([unit] * 3 + [1.0] * 4)
    P = units[:, None] * (np.ones((7, 7)) if rank == 1 else (axes * known) @ axes.T) * units
    W = 1e6 * (axes * known[::-1]) @ axes.T / units / units[:, None]
    _, after = update(np.float32(P), STEP, np.float32(W))
    expected = P - P @ W @ np.linalg.inv(np.eye(7) + P @ W) @ P
    std = np.sqrt(np.diag(P))
    after, expected = (x / std / std[:, None] for x in (np.float64(after), expected))
    assert np.linalg.eigvalsh(after).min() > -1e-9
    np.testing.assert_allclose(after, expected, atol=2.0**-9)  # the root of what is added to correlations


def test_what_is_certain_stays_and_what_is_not_measured_says_nothing():
    ones, nothing = np.ones(7, np.float32), np.zeros((7, 7), np.float32)
    step, after = update(nothing, ones, np.eye(7, dtype=np.float32))
    assert not np.any(step) and not np.any(after)
    step, after = update(covariance(), ones, nothing)
    assert not np.any(step)
    np.testing.assert_allclose(after, covariance(), rtol=1e-4, atol=1e-8)


def test_the_estimate_takes_motion_and_measurement():
    W = np.linalg.inv(covariance(1))
    step, after = measured(moved(known(), MOTION, np.diag(NOISE**2)), STEP, W)
    expected_step, expected = update(predict(covariance(), MOTION, np.diag(NOISE**2)), STEP, W)
    np.testing.assert_allclose(step, expected_step, rtol=1e-5)
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-5)


def test_the_root_measures_the_mahalanobis_distance():
    P, x = covariance(), np.linspace(-0.1, 0.2, 7)
    expected = x @ np.linalg.solve(P.astype(float), x)
    assert np.sum((root_information(P) @ x) ** 2) == pytest.approx(expected, rel=1e-2)


def found_with(information: np.ndarray, misfit: float = 0.04) -> IcpInfo:
    zero, one = device(0.0), device(np.int32(1))
    numbers = zero, zero, device(misfit), device(np.zeros(8)), device(np.zeros(7)), device(information), zero, zero
    field = DepthField(*map(device, (np.zeros((5, 5)), np.zeros(2), np.zeros(2))))
    return IcpInfo(one, *numbers, field, one, device(True))


def test_a_pose_that_is_given_keeps_its_weight_and_its_unit_and_has_little_of_the_maps_error():
    """P and points that do not fit: the textbook's posterior, and the gain of the points as the part of the map."""
    before = replace(known(), is_given=np.array(True), log_scale=np.float32(0.3))
    W = np.float32(np.diag([1e4] * 6 + [0.0]))
    arguments = before, found_with(W), np.float32(0.02), np.float32(1.1)
    after, by_map = next_belief(*arguments, np.array(True), np.float32(1.0))
    P = (
        np.diag([1.0] * 6 + [2.0]) @ covariance().astype(float) @ np.diag([1.0] * 6 + [2.0])
    )  # a scale is held as before
    expected = np.linalg.inv(np.linalg.inv(P) + W)
    np.testing.assert_allclose(after.covariance, expected, rtol=2e-2, atol=1e-7)
    np.testing.assert_allclose(by_map, (expected @ W)[:6, :6], atol=1e-2)
    assert after.log_scale == np.float32(0.3) and after.num_scales == before.num_scales
    _, by_map = next_belief(*arguments, np.array(False), np.float32(1.0))
    assert not np.any(by_map)


def test_a_frame_that_is_tracked_is_known_as_its_points_say_and_another_as_before():
    twice = jaxlie.SE3(device(np.tile(MOTION.wxyz_xyz, (2, 1))))
    before = jax.device_get(eqx.tree_at(lambda b: b.repeats.predicted, replace(known(), log_scale=0.3), twice))
    arguments = before, found_with(1e4 * np.eye(7)), np.float32(0.02), np.float32(1.1)
    after, by_map = next_belief(*arguments, np.array(True), np.float32(5.0))
    # Twice the noise is four times P, and five frames whose points err alike say of the scale what one of them does.
    nothing, said = np.zeros(7, np.float32), np.float32(np.diag([1e4] * 6 + [2e3]))
    _, expected = update(4.0 * covariance(), nothing, said)
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-5)
    np.testing.assert_allclose(after.log_scale, (0.3 + np.log(1.1)) / 2, rtol=1e-5)
    assert after.num_scales == 2 and after.depth_noise == pytest.approx(0.04)
    np.testing.assert_array_equal(by_map, np.eye(6))  # the estimate is relative to the map
    same, _ = next_belief(*arguments, np.array(False), np.float32(5.0))
    # What the prior said of the poses is said, whether its points fit or not: in the unit of its final scale.
    for one in (after, same):
        said = one.repeats.predicted.wxyz_xyz[:, 4:]
        np.testing.assert_allclose(said, 1.1 * before.repeats.predicted.wxyz_xyz[:, 4:], rtol=1e-6)
    same = eqx.tree_at(lambda b: b.repeats, same, before.repeats)
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a, b)
