"""Poses that depths contradict: against views of a wall and a floor, which are known in closed form."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.data.backprojection import backproject
from emgs_jax.prior.files.conventions import Sight, check_conventions, misfit

INTRINSICS, SIZE = (60.0, 60.0, 31.5, 23.5), (48, 64)


def sight(pose: np.ndarray, said: np.ndarray | None = None, noise: float = 0.0) -> Sight:
    """What a camera sees of the wall z = 3 and the floor y = 1; `said`: what is said of its pose."""
    rays = backproject(np.ones(SIZE), INTRINSICS) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        wall, floor = (3 - pose[2, 3]) / rays[..., 2], (1 - pose[1, 3]) / rays[..., 1]
    depth = np.minimum(np.where(wall > 0, wall, np.inf), np.where(floor > 0, floor, np.inf))
    depth = np.where(np.isfinite(depth), depth, 0) * np.exp(noise * np.random.default_rng(0).normal(size=SIZE))
    return Sight(backproject(depth, INTRINSICS), depth > 0, pose if said is None else said)


def scalar_first(pose: np.ndarray) -> np.ndarray:
    """What a reader of x y z w makes of the pose's quaternion, written w x y z."""
    changed = pose.copy()
    w_x_y_z = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
    changed[:3, :3] = Rotation.from_quat(w_x_y_z).as_matrix()
    return changed


def pose(turn: float, x: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.05, turn, 0.02]).as_matrix(), (x, 0, z)
    return T


A, B = pose(0.1, 0.2, 0.1), pose(-0.15, -0.3, 0.5)


def test_true_poses_fit_and_others_do_not():
    assert misfit(sight(A), sight(B), np.linalg.inv(A) @ B, INTRINSICS) < 0.01  # to the nearest pixel
    assert misfit(sight(A), sight(B), np.linalg.inv(B) @ A, INTRINSICS) > 0.05
    assert misfit(sight(A), sight(B), pose(3.0, 0, 0), INTRINSICS) == np.inf


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_right_poses_are_left_alone_however_noisy_the_depths(noise):
    check_conventions([(sight(A, noise=noise), sight(B, noise=noise))], INTRINSICS, "poses", 0.1)


def test_what_is_measured_is_said_and_what_no_convention_explains_stops_a_run_that_is_not_told_to_go_on():
    """Depths of one image at a time made a map of nothing, whose advice was another stride."""
    pair = [(sight(A), sight(B))]
    assert re.search(r"differ by 0\.\d %$", check_conventions(pair, INTRINSICS, "poses", 0.1))
    scaled = [(sight(A)._replace(points=1.5 * sight(A).points), sight(B)._replace(points=0.8 * sight(B).points))]
    with pytest.raises(ValueError, match=r"differ by \d\d\.\d %, by [0-4]\.\d % where each view has a scale"):
        check_conventions(scaled, INTRINSICS, "poses", 0.1)
    assert "each view has a scale of its own" in check_conventions(scaled, INTRINSICS, "poses", 1.0)
    with pytest.raises(ValueError, match="they share nothing"):
        check_conventions([(sight(A), sight(pose(2.0, 0, 0)))], INTRINSICS, "poses", 0.1)
    check_conventions([], INTRINSICS, "poses", 0.1)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (np.linalg.inv, "as world -> camera:"),
        (lambda T: T * [1, -1, -1, 1], "as camera -> world of OpenGL's axes:"),
        (lambda T: np.linalg.inv(T * [1, -1, -1, 1]), "as world -> camera of OpenGL's axes:"),
        (
            lambda T: T * np.where(np.eye(4)[3] > 0, [[1000]] * 3 + [[1]], 1),
            "by about 1000, or the positions by 0.001:",
        ),
        (lambda T: scalar_first(T), "as with quaternions w, x, y, z:"),
        (lambda T: scalar_first(np.linalg.inv(T)), "as world -> camera with quaternions w, x, y, z:"),
        (lambda T: T[:, [2, 0, 1, 3]] * [1, -1, -1, 1], "as of axes x ahead, y left, z up:"),
        (lambda T: T[:, [2, 0, 1, 3]], "as of axes x ahead, y right, z down:"),
    ],
)
def test_a_pose_of_another_convention_is_named(said, words):
    with pytest.raises(ValueError, match=f"poses.txt: the depths .*{words}"):
        check_conventions([(sight(A, said(A)), sight(B, said(B)))], INTRINSICS, "poses.txt", 0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda points: points * np.linalg.norm(points / points[..., 2:], axis=-1, keepdims=True),
            "lengths of the ray",
        ),
        (lambda points: points / points[..., 2:] * points[:, ::-1, 2:], "mirrored"),
        (lambda points: points / points[..., 2:] ** 2, "1 / depth"),
        (lambda points: 0.4 * points / points[..., 2:] ** 2, "0.398. / depth"),
        (lambda points: points * 5, "multiplied by about 0.1995"),
    ],
)
def test_depths_of_another_kind_are_named(change, words):
    """Lengths of rays, disparities and sixteen-bit depths of another scale made a bent or flat map without a word."""
    with np.errstate(invalid="ignore", divide="ignore"):
        pair = [seen._replace(points=change(seen.points)) for seen in (sight(A), sight(B))]
    with pytest.raises(ValueError, match=f"where the depths are .*{words}"):
        check_conventions([(pair[0], pair[1])], INTRINSICS, "depths", 0.1)


def test_points_of_the_world_are_named():
    pair = [seen._replace(points=seen.points @ T[:3, :3].T + T[:3, 3]) for T, seen in ((A, sight(A)), (B, sight(B)))]
    with pytest.raises(ValueError, match="points are taken as those of the world"):
        check_conventions([(pair[0], pair[1])], INTRINSICS, "points", 0.1)
