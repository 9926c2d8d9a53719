"""Oracles: closed forms on planes and spheres, brute force, Open3D, equivariance, the real Replica mesh."""

import dataclasses
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from cloud_scene import INTRINSICS, SHAPE, plane_depth, random_cloud
from scene import compose, evaluation_config
from scipy.spatial.transform import Rotation

from emgs_jax.config.configure import build
from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Frame
from emgs_jax.evaluation.clouds import PointCloud, fuse_clouds, spooled, transform_cloud
from emgs_jax.evaluation.reconstruction import (
    camera_cloud,
    compare_clouds,
    compare_means,
    compare_placements,
    ground_truth_cloud,
    posed,
    reference,
)
from emgs_jax.geometry import Sim3

REPLICA = Path(__file__).resolve().parents[3] / "shared" / "data" / "replica"
CONFIG = evaluation_config()


def reconstruction_metrics(estimate, truth, config):
    return compare_means(spooled([estimate], np.float64, has_colors=False).averaged(config.voxel_m), truth, config)


def grid_cloud(offset=0.0, n=40, spacing=0.05):
    x, y = np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing)
    points = np.stack([x.ravel(), y.ravel(), np.full(n * n, offset)], 1) + 0.003
    return PointCloud(points, np.tile([0.0, 0.0, 1.0], (n * n, 1)), np.full((n * n, 3), 0.5))


def a_frame(depth, pose=None, index=0):
    image = np.full((*depth.shape, 3), 51, np.uint8)
    return Frame(index, float(index), "f", image, depth.astype(np.float32), np.eye(4) if pose is None else pose)


@pytest.mark.parametrize("value", ["alignment=sim2", "statistic=median", "voxel_m=0.0", "max_distance_m=nan"])
def test_wrong_config_values_are_named(value):
    with pytest.raises(ValueError, match=f"evaluation.{value.partition('=')[0]} must be .*got"):
        build(compose(f"evaluation.{value}"), "evaluation")


@pytest.mark.parametrize("protocol", ["paper", "mast3r", "nice_slam"])
def test_a_protocol_and_its_alignment_name_themselves_and_a_cloud_against_itself_is_perfect(protocol):
    config = evaluation_config(f"evaluation={protocol}", "evaluation.alignment=se3")
    assert (config.protocol, config.alignment) == (f"{protocol}/se3", "se3") and CONFIG.protocol == "paper/sim3"
    cloud = random_cloud(np.random.default_rng(0))
    metrics = reconstruction_metrics(cloud, reference(cloud, config), config)
    assert metrics["reconstruction/accuracy_m"] == metrics["reconstruction/completion_m"] == 0.0
    np.testing.assert_allclose([value for key, value in metrics.items() if key.endswith("percent")], 100.0)


@pytest.mark.parametrize(("statistic", "limit"), [("mean", np.inf), ("rmse", 0.1)])
def test_metrics_are_those_of_brute_force(statistic, limit):
    """A far point of the estimate counts in full, unless distances are clipped, which does not touch the F1."""
    rng = np.random.default_rng(1)
    estimate, truth = random_cloud(rng, 300), random_cloud(rng, 200)
    estimate.points[0] = [0.0, 0.0, 1600.0]
    estimate.normals[1], truth.normals[2] = 0.0, 0.0
    config = dataclasses.replace(CONFIG, voxel_m=1e-4, statistic=statistic, max_distance_m=limit)
    metrics = reconstruction_metrics(estimate, reference(truth, config), config)
    distances = np.linalg.norm(estimate.points[:, None] - truth.points[None], axis=-1)
    cosines = np.abs(estimate.normals @ truth.normals.T)
    there, back = distances.argmin(1), distances.argmin(0)
    both = [cosines[np.arange(300), there], cosines[back, np.arange(200)]]
    both = [cos[cos > 0] for cos in both]  # but where a normal is unknown
    expected = {"num_points": 300, "normals_abs_cos_percent": 50 * (both[0].mean() + both[1].mean())}
    within = [100 * (cos >= np.cos(np.pi / 6)).mean() for cos in both]
    expected["normals_within_30deg_percent"] = np.mean(within)
    nearest = {"accuracy_m": distances.min(1), "completion_m": distances.min(0)}
    for name, values in nearest.items():
        clipped = np.minimum(values, limit)
        expected[name] = clipped.mean() if statistic == "mean" else np.sqrt((clipped**2).mean())
    for threshold in (20, 5):
        precision, recall = (100 * (values <= threshold / 100).mean() for values in nearest.values())
        expected[f"precision_{threshold}cm_percent"], expected[f"recall_{threshold}cm_percent"] = precision, recall
        expected[f"f1_{threshold}cm_percent"] = 2 * precision * recall / (precision + recall)
    found = {key.removeprefix("reconstruction/"): value for key, value in metrics.items()}
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-6, err_msg=name)


def test_a_random_choice_of_points_is_the_same_each_time_and_distances_grow_with_the_gaps():
    truth, few = grid_cloud(), dataclasses.replace(CONFIG, max_points=400)
    first, second = (reconstruction_metrics(grid_cloud(0.1), reference(truth, few), few) for _ in range(2))
    assert first == second and first["reconstruction/num_points"] == 1600
    assert 0.1 < first["reconstruction/accuracy_m"] < 0.12 and first["reconstruction/f1_20cm_percent"] == 100.0


def test_empty_clouds_and_unknown_normals_give_null_with_a_reason():
    empty = PointCloud(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)))
    truth = grid_cloud()
    for estimate, true, word in ((empty, truth, "estimate"), (truth, empty, "ground truth")):
        metrics = reconstruction_metrics(estimate, reference(true, CONFIG), CONFIG)
        assert metrics["reconstruction/accuracy_m"] is None
        assert word in metrics["reconstruction/reason"]
    blank = dataclasses.replace(truth, normals=np.zeros_like(truth.points))
    metrics = reconstruction_metrics(blank, reference(truth, CONFIG), CONFIG)
    assert metrics["reconstruction/accuracy_m"] == 0.0
    assert metrics["reconstruction/normals_abs_cos_percent"] is None
    assert metrics["reconstruction/reason"] == "no normals to compare"


def test_the_prior_of_true_points_is_the_ground_truth_and_moves_with_the_poses():
    rng = np.random.default_rng(6)
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.random(rng=rng).as_matrix(), [1.0, 2.0, 3.0]
    frame = a_frame(plane_depth((0.3, 0.2, 0.9), 2.0).clip(0.0, 5.0), move)
    no_truth = Frame(1, 1.0, "g", frame.image)
    nowhere = Frame(2, 2.0, "h", frame.image, frame.depth)  # where it was taken nobody knows
    truth = ground_truth_cloud([frame, no_truth, nowhere], INTRINSICS, CONFIG)
    seen = camera_cloud(backproject(frame.depth, INTRINSICS), frame.depth > 0, frame.image, CONFIG)
    raw = fuse_clouds([posed(seen, frame.T_world_camera)], CONFIG.voxel_m)
    np.testing.assert_array_equal(raw.points, truth.points)
    np.testing.assert_allclose(truth.colors, 0.2)
    # In the camera's frame the points lie on the plane again.
    camera = (truth.points - move[:3, 3]) @ move[:3, :3]
    on_plane = camera[:, 2] < 4.9
    normal = np.array([0.3, 0.2, 0.9])
    np.testing.assert_allclose(camera[on_plane] @ normal, 2.0, atol=1e-5)
    cosines = truth.normals @ move[:3, :3] @ normal / np.linalg.norm(normal)
    assert (cosines[on_plane] < -0.99).mean() > 0.95
    depth = np.full(SHAPE, 3.0)
    depth[:, 60:] = 5.0  # beyond the limit of a protocol
    cloud = ground_truth_cloud([a_frame(depth)], INTRINSICS, evaluation_config("evaluation=mast3r"))
    assert len(cloud) > 1000
    np.testing.assert_allclose(cloud.points[:, 2], 3.0)


def test_a_cloud_is_aligned_by_the_poses_with_scale_or_without():
    """The estimate is half the size; without scale it keeps its size about the poses' centre."""
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(6, 3))
    cloud, half = random_cloud(rng), poses.copy()
    half[:, :3, 3] *= 0.5
    estimate = dataclasses.replace(cloud, points=0.5 * cloud.points)
    metrics = compare_clouds(estimate, reference(cloud, CONFIG), (half, poses), CONFIG)
    assert metrics["reconstruction/alignment_note"] is None
    np.testing.assert_allclose(metrics["reconstruction/accuracy_m"], 0.0, atol=1e-12)
    kept = dataclasses.replace(estimate, points=estimate.points + 0.5 * poses[:, :3, 3].mean(0))
    rigid = evaluation_config("evaluation.alignment=se3")
    metrics = compare_clouds(estimate, reference(kept, rigid), (half, poses), rigid)
    np.testing.assert_allclose(metrics["reconstruction/accuracy_m"], 0.0, atol=1e-12)


def test_icp_of_a_protocol_takes_back_a_small_motion_that_the_poses_do_not_show():
    rng = np.random.default_rng(9)
    truth = random_cloud(rng, 1500)
    small = Sim3(1.0, Rotation.from_rotvec([0.01, -0.01, 0.005]).as_matrix(), np.array([0.01, 0.0, -0.01]))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    # The estimate has a frame and a size of its own.
    rotation = Rotation.random(rng=rng).as_matrix()
    away = Sim3(0.5, rotation, np.array([1.0, -2.0, 3.0]))
    moved, estimated = transform_cloud(transform_cloud(truth, small), away), away.apply_to_poses(poses)
    without = compare_clouds(moved, reference(truth, CONFIG), (estimated, poses), CONFIG)
    refined = dataclasses.replace(CONFIG, icp_distance_m=0.1, icp_voxel_m=1e-4)
    assert without["reconstruction/accuracy_m"] > 0.01
    found = compare_clouds(moved, reference(truth, refined), (estimated, poses), refined)
    assert found["reconstruction/accuracy_m"] < 1e-9


def test_a_sample_of_the_estimate_changes_its_accuracy_by_chance_and_its_completion_not_at_all(monkeypatch):
    """The raw cloud of 1,000 frames has 60 million voxels: its parts are searched one after the other."""
    rng = np.random.default_rng(12)
    truth, estimate = random_cloud(rng, 900), random_cloud(rng, 4000)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    away = Sim3(0.5, Rotation.random(rng=rng).as_matrix(), np.array([1.0, -2.0, 3.0]))
    given = transform_cloud(estimate, away), reference(truth, CONFIG), (away.apply_to_poses(poses), poses)
    whole = compare_placements(*given, CONFIG, [0.0, 0.1])
    monkeypatch.setattr("emgs_jax.evaluation.clouds.PART_ROWS", 500)
    sampled = compare_placements(*given, dataclasses.replace(CONFIG, num_sampled=1000), [0.0, 0.1])
    assert whole[0] != whole[1], "the second is moved by ICP"
    for found, expected in zip(sampled, whole, strict=True):
        for name in ("completion_m", "recall_5cm_percent", "num_points"):
            np.testing.assert_allclose(found[f"reconstruction/{name}"], expected[f"reconstruction/{name}"], rtol=1e-9)
        accuracy = (other["reconstruction/accuracy_m"] for other in (found, expected))
        assert 1e-6 < abs(np.subtract(*accuracy)) < 0.05 * expected["reconstruction/accuracy_m"]


def test_a_sample_of_the_truth_is_searched_in_all_of_the_estimate():
    """A completion by a thinned estimate is 25 % too large; one by fewer true points differs by chance."""
    rng = np.random.default_rng(13)
    truth, estimate = random_cloud(rng, 8000), random_cloud(rng, 4000)
    whole = reconstruction_metrics(estimate, reference(truth, CONFIG), CONFIG)["reconstruction/completion_m"]
    few = dataclasses.replace(CONFIG, num_sampled=2000)
    found = reconstruction_metrics(estimate, reference(truth, few), few)["reconstruction/completion_m"]
    assert 1e-6 < abs(found - whole) < 0.04 * whole


def test_a_cloud_twice_as_long_takes_a_fraction_of_its_points_more(monkeypatch):
    """A point is 36 bytes on the disk; two placements of all points and their searches took 580 in memory."""
    monkeypatch.setattr("emgs_jax.evaluation.clouds.PART_ROWS", 5000)
    config, rng = dataclasses.replace(CONFIG, num_sampled=1000), np.random.default_rng(0)

    def wall(x):
        points = np.column_stack([x + rng.random(2000) * 0.1, rng.random(2000) * 0.6, rng.normal(0, 0.02, 2000)])
        return PointCloud(points, np.zeros((2000, 3)), np.zeros((2000, 3)))

    truth, poses = reference(wall(0.0), config), np.tile(np.eye(4), (10, 1, 1))
    poses[:, :3, 3] = rng.random((10, 3))

    def peak(num_frames):
        tracemalloc.start()
        try:
            cloud = spooled(wall(0.1 * frame) for frame in range(num_frames))
            compare_placements(cloud, truth, (poses, poses), config, [0.0, 0.1])
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2)  # what is imported late
    assert peak(40) - peak(20) < 12 * 40_000


@pytest.mark.skipif(not REPLICA.exists(), reason="the shared Replica sequence is not here")
def test_the_ground_truth_of_replica_lies_on_its_mesh_with_its_normals():
    import cv2
    import open3d as o3d

    poses = np.loadtxt(REPLICA / "office0_from_mesh" / "traj.txt").reshape(-1, 4, 4)
    frames = []
    for index in (0, 90):
        depth = cv2.imread(str(REPLICA / f"office0_from_mesh/results/depth{index:06d}.png"), cv2.IMREAD_UNCHANGED)
        frames.append(a_frame(depth / 6553.5, poses[index], index))
    cloud = ground_truth_cloud(frames, (300.0, 300.0, 299.5, 169.5), CONFIG)
    mesh = o3d.t.io.read_triangle_mesh(str(REPLICA / "office0_mesh.ply"))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh)
    answer = scene.compute_closest_points(o3d.core.Tensor(cloud.points.astype(np.float32)))
    distances = np.linalg.norm(answer["points"].numpy() - cloud.points, axis=1)
    cosines = np.abs(np.einsum("nk,nk->n", answer["primitive_normals"].numpy(), cloud.normals))
    assert np.mean(distances) < 1e-3
    assert np.median(cosines) > 0.995
    assert cosines.mean() > 0.95
