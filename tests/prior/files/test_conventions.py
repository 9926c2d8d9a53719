"""Poses that depths contradict, and truth that does: against a wall and a floor, known in closed form, and a plane."""

import re
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.prior.files.conventions import Sight, check_conventions, check_truth, misfit
from tests.data.written_scene import plane_depth, scalar_first, scene_pose

INTRINSICS, SIZE = (60.0, 60.0, 31.5, 23.5), (48, 64)


def sight(pose: np.ndarray, said: np.ndarray | None = None, noise: float = 0.0) -> Sight:
    """What a camera sees of the wall z = 3 and the floor y = 1; `said`: what is said of its pose."""
    rays = backproject(np.ones(SIZE), INTRINSICS) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        wall, floor = (3 - pose[2, 3]) / rays[..., 2], (1 - pose[1, 3]) / rays[..., 1]
    depth = np.minimum(np.where(wall > 0, wall, np.inf), np.where(floor > 0, floor, np.inf))
    depth = np.where(np.isfinite(depth), depth, 0) * np.exp(noise * np.random.default_rng(0).normal(size=SIZE))
    return Sight(backproject(depth, INTRINSICS), depth > 0, pose if said is None else said)


def pose(turn: float, x: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.05, turn, 0.02]).as_matrix(), (x, 0, z)
    return T


A, B = pose(0.1, 0.2, 0.1), pose(-0.15, -0.3, 0.5)


def test_true_poses_fit_and_others_do_not():
    assert misfit(sight(A), sight(B), INTRINSICS) < 0.01  # to the nearest pixel
    assert misfit(sight(A, said=B), sight(B, said=A), INTRINSICS) > 0.05
    assert misfit(sight(A, said=np.eye(4)), sight(B, said=pose(3.0, 0, 0)), INTRINSICS) == np.inf


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


class Planes:
    """Depths of so many raw units a metre that are read as if they were of `depth_scale`."""

    name, sequence, size, intrinsics, has_ground_truth = "planes", "one", SIZE[::-1], INTRINSICS, True

    def __init__(self, raw: float, depth_scale: float, broken: int | None = None, said: Callable = np.array) -> None:
        self.factor, self.broken, self.said = raw / depth_scale, broken, said

    def __len__(self) -> int:
        return 9

    def __getitem__(self, row: int) -> Frame:
        if row == self.broken:
            raise BadFrameError("damaged")
        depth = self.factor * plane_depth(scene_pose(row), INTRINSICS, SIZE[::-1])
        return Frame(row, row, str(row), np.zeros((*depth.shape, 3), np.uint8), depth, self.said(scene_pose(row)))


@pytest.mark.parametrize(("raw", "depth_scale"), [(1000.0, 5000.0), (5000.0, 1000.0), (1000.0, 1.0), (256.0, 5000.0)])
def test_depths_of_another_scale_are_refused_with_the_right_one(raw, depth_scale):
    """A RealSense's millimetres in TUM's layout came five times too near, without a word."""
    with pytest.raises(ValueError, match=rf"planes one: .* give dataset\.depth_scale={raw:g}, or poses in metres"):
        check_truth(Planes(raw, depth_scale), depth_scale)


def test_what_fits_or_cannot_be_told_is_accepted():
    for scale in (1000.0, 5000.0, 4720.1, 6553.5):
        check_truth(Planes(scale, scale), scale)
    check_truth(Planes(1000.0, 1000.0, broken=0), 1000.0)
    check_truth(SimpleNamespace(has_ground_truth=False), 1000.0)


@pytest.mark.parametrize("depth_scale", [1000.0, None])
def test_true_poses_of_another_convention_are_refused(depth_scale):
    """COLMAP's world -> camera in a list of TUM's layout became a truth that every score was taken against."""
    with pytest.raises(ValueError, match="planes one, true poses and depths: .* taken as world -> camera:"):
        check_truth(Planes(1000.0, 1000.0, said=np.linalg.inv), depth_scale)
