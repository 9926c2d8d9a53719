"""Similarities of the host: laws of a group, and what a change of unit does to poses and covariances."""

import numpy as np
import pytest
from hand_run import random_poses, random_similarity

from emgs_jax.geometry import Sim3, scale_covariance

RNG = np.random.default_rng(0)
ONE, OTHER, POINTS = random_similarity(RNG, 2.0), random_similarity(RNG, 0.3), RNG.normal(size=(5, 3))


def same(one: Sim3, other: Sim3) -> None:
    np.testing.assert_allclose(one.as_matrix(), other.as_matrix(), atol=1e-12)


def test_similarities_are_composed_and_inverted_as_their_matrices():
    np.testing.assert_allclose((ONE @ OTHER).as_matrix(), ONE.as_matrix() @ OTHER.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(ONE.inverse().as_matrix(), np.linalg.inv(ONE.as_matrix()), atol=1e-12)
    same(Sim3.from_matrix(ONE.as_matrix()), ONE)


def test_points_of_a_camera_go_with_its_pose_and_scale():
    (pose,) = random_poses(RNG, 1)
    world, moved = POINTS @ pose[:3, :3].T + pose[:3, 3], ONE.apply_to_poses(pose)
    np.testing.assert_allclose(ONE.scale * POINTS @ moved[:3, :3].T + moved[:3, 3], ONE.apply(world), atol=1e-12)
    np.testing.assert_allclose(ONE.apply_to_poses(np.stack([pose] * 2)), [moved] * 2)


def test_a_change_of_the_unit_keeps_its_center_and_acts_on_lengths_of_a_covariance_alone():
    center = np.array([1.0, -2.0, 3.0])
    grown = Sim3.about(center, 1.5)
    np.testing.assert_allclose(grown.apply(center), center)
    np.testing.assert_allclose(grown.apply(center + POINTS), center + 1.5 * POINTS)
    errors = RNG.normal(size=(7, 40))
    scaled = np.append([1.5] * 3, np.ones(4))[:, None] * errors
    np.testing.assert_allclose(scale_covariance(np.cov(errors), 1.5), np.cov(scaled), atol=1e-12)
    assert scale_covariance(np.eye(6), 2.0).trace() == pytest.approx(15)
