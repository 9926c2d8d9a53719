"""A loop, measured once more by an inference with both visits; oracles: exact geometry, and Gaussians multiplied."""

from dataclasses import replace

import numpy as np
import pytest
from loop_scene import INTRINSICS, SIZE, loops_config, matrix

from emgs_jax.geometry import pose_difference, scale_pose
from emgs_jax.loop_closure.place_recognition import Keyframe, sampled_depths
from emgs_jax.loop_closure.prior_query import JointPrediction, fuse_measurements, measure_by_prior
from emgs_jax.loop_closure.two_view_refinement import Similarity
from emgs_jax.loop_closure.verification import LoopMeasurement

CONFIG = loops_config()["prior_query"]
T_A_B = matrix((3.0, -8.0, 2.0), (0.4, 0.1, -0.3))


def seen(scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (h, w, 3) of an uneven wall in units of an inference, `scale` a metre, and their mask; a corner is off."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    z = scale * (2.0 + 0.001 * x + 0.3 * np.sin(0.02 * y))
    fx, fy, cx, cy = INTRINSICS
    mask = (x > 40) | (y > 60)
    return np.float32(np.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], -1)), mask


def keyframe(frame: int, scale: float) -> Keyframe:
    points, mask = seen(scale)
    pixels, descriptors = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    depths = sampled_depths(points, mask, (80, 60))
    return Keyframe(frame, pixels, descriptors, np.zeros((0, 3), np.float32), INTRINSICS, SIZE, depths)


def told(T_a_b: np.ndarray = T_A_B, scale: float = 1.0) -> JointPrediction:
    points, mask = seen(scale)
    return JointPrediction(scale_pose(T_a_b, scale), (points, points), (mask, mask))


def measured(error=(0.0, 0.0, 0.0), std: float = 0.02, log_ratio: float = 0.0) -> LoopMeasurement:
    sqrt_info = np.diag([1 / std] * 3 + [1 / np.radians(0.5)] * 3 + [100.0])
    return LoopMeasurement(3, 70, T_A_B @ matrix((0, 0, 0), error), log_ratio, sqrt_info, 50)


def test_an_exact_answer_in_any_unit_is_the_similarity_between_the_two_inferences():
    """A metre is 1.1 of a's inference, .9 of b's and 3 of the new one: the pose is in a's, the ratio a's over b's."""
    found = measure_by_prior(told(scale=3.0), keyframe(3, 1.1), keyframe(70, 0.9), CONFIG)
    np.testing.assert_allclose(found.T_a_b, scale_pose(T_A_B, 1.1), atol=1e-3)
    assert found.log_ratio == pytest.approx(np.log(1.1 / 0.9), abs=1e-3)


def test_its_deviation_grows_with_the_distance_and_what_agrees_is_within_the_limit():
    config = replace(CONFIG, std=0.03, std_share=0.1, std_deg=2.0, log_ratio_std=0.05)
    a, b = keyframe(3, 1.0), keyframe(70, 1.0)
    found = measure_by_prior(told(), a, b, config)
    stds = [0.03 + 0.1 * np.linalg.norm(T_A_B[:3, 3])] * 3 + [np.radians(2.0)] * 3 + [0.05]
    np.testing.assert_allclose(found.covariance, np.diag(np.square(stds)), rtol=1e-3)
    assert fuse_measurements(measured((0.02, 0, 0)), measure_by_prior(told(), a, b, CONFIG))[1] < CONFIG.max_misfit
    twin = matrix((0, 0, 0), (6.0, 0.0, 0.0)) @ T_A_B  # a room that looks the same, 6 m on
    assert fuse_measurements(measured(), measure_by_prior(told(twin), a, b, CONFIG))[1] > CONFIG.max_misfit


def test_without_a_pose_or_depths_in_common_nothing_is_said():
    a, b = keyframe(3, 1.0), keyframe(70, 1.0)
    assert measure_by_prior(told(np.full((4, 4), np.nan)), a, b, CONFIG) is None
    points, mask = seen(1.0)
    for masks in ((mask & False, mask), (mask, mask & False)):
        assert measure_by_prior(JointPrediction(T_A_B, (points, points), masks), a, b, CONFIG) is None
    assert measure_by_prior(told(), a, b, replace(CONFIG, min_cells=4801)) is None
    points = points.copy()
    points[100:, 100:] = np.inf  # as a sky
    far = replace(a, depths=np.where(np.arange(80) > 40, np.float32(np.inf), a.depths))
    found = measure_by_prior(JointPrediction(T_A_B, (points, points), (mask, mask)), far, b, CONFIG)
    np.testing.assert_allclose(found.T_a_b, T_A_B, atol=1e-3)


def test_two_measurements_are_one_by_their_information():
    """Along x: .02 and .04 of std, .05 apart; the sum of information, the mean that is weighted by it, and one χ²."""
    covariance = np.diag([0.04**2] * 3 + [1e-4] * 3 + [0.02**2])
    other = Similarity(T_A_B @ matrix((0, 0, 0), (0.05, 0, 0)), 0.03, covariance)
    both, misfit = fuse_measurements(measured(std=0.02), other)
    share = (1 / 0.04**2) / (1 / 0.02**2 + 1 / 0.04**2)
    np.testing.assert_allclose((np.linalg.inv(T_A_B) @ both.Z_a_b)[:3, 3], [share * 0.05, 0, 0], atol=1e-9)
    assert both.log_ratio == pytest.approx(0.03 * (1 / 0.02**2) / (1 / 0.01**2 + 1 / 0.02**2))
    assert misfit == pytest.approx(0.05**2 / (0.02**2 + 0.04**2) + 0.03**2 / (0.01**2 + 0.02**2))
    information = both.sqrt_info.T @ both.sqrt_info
    np.testing.assert_allclose(np.diag(information)[:3], 1 / 0.02**2 + 1 / 0.04**2)
    assert (both.a, both.b, both.num_inliers) == (3, 70, 50) and np.allclose(both.sqrt_info, np.triu(both.sqrt_info))
    covariance = np.diag([0.01] * 3 + [np.radians(0.5) ** 2] * 3 + [1.0])  # a rotation is shared likewise
    both, _ = fuse_measurements(measured(), Similarity(T_A_B @ matrix((0, 2.0, 0)), 0.0, covariance))
    assert pose_difference(T_A_B, both.Z_a_b)[1] == pytest.approx(1.0, abs=1e-6)
