"""Oracles: closed forms on planes and spheres, brute force, equivariance, the real Replica mesh, config = YAML."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import Frame
from emgs_jax.evaluation.clouds import PointCloud, transform_cloud
from emgs_jax.evaluation.reconstruction import (
    EvaluationConfig,
    align_cloud,
    backproject,
    ground_truth_cloud,
    raw_prior_cloud,
    reconstruction_metrics,
)
from emgs_jax.evaluation.trajectory import Alignment

ROOT = Path(__file__).resolve().parents[2]
REPLICA = ROOT.parent / "shared" / "data" / "replica"
CONFIG = EvaluationConfig()
INTRINSICS = (110.0, 95.0, 61.0, 47.0)  # fx ≠ fy, centre not in the middle
SHAPE = (90, 120)


def plane_depth(normal, distance):
    """Depth image of the plane normal · p = distance."""
    rays = backproject(np.ones(SHAPE), INTRINSICS)
    return distance / (rays @ np.asarray(normal))


def grid_cloud(offset=0.0, n=40, spacing=0.05):
    x, y = np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing)
    points = np.stack([x.ravel(), y.ravel(), np.full(n * n, offset)], 1) + 0.003
    return PointCloud(points, np.tile([0.0, 0.0, 1.0], (n * n, 1)), np.full((n * n, 3), 0.5))


def random_cloud(rng, n=400):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(rng.uniform(-1, 1, (n, 3)), normals, rng.uniform(size=(n, 3)))


def a_frame(depth, pose=None, index=0):
    image = np.full((*depth.shape, 3), 51, np.uint8)
    return Frame(index, float(index), "f", image, depth.astype(np.float32), np.eye(4) if pose is None else pose)


def test_every_yaml_key_is_a_config_field_and_its_value_the_default():
    values = yaml.safe_load((ROOT / "conf" / "evaluation" / "default.yaml").read_text())
    assert values.pop("_target_") == f"{EvaluationConfig.__module__}.{EvaluationConfig.__name__}"
    assert set(values) == {field.name for field in dataclasses.fields(EvaluationConfig)}
    assert EvaluationConfig(**values) == CONFIG


def test_wrong_config_values_are_named():
    with pytest.raises(ValueError, match="alignment must be sim3 or se3, got 'sim2'"):
        EvaluationConfig(alignment="sim2")
    with pytest.raises(ValueError, match="voxel_m"):
        EvaluationConfig(voxel_m=0.0)


def test_a_cloud_against_itself_is_perfect():
    cloud = random_cloud(np.random.default_rng(0))
    metrics = reconstruction_metrics(cloud, cloud, CONFIG)
    assert metrics["reconstruction/accuracy_m"] == metrics["reconstruction/completion_m"] == 0.0
    percents = [value for key, value in metrics.items() if key.endswith("percent")]
    assert len(percents) == 8
    np.testing.assert_allclose(percents, 100.0)


def test_parallel_planes_differ_by_their_distance():
    """10 cm apart: inside the 20 cm threshold, outside the 5 cm one; normals agree up to sign."""
    estimate = grid_cloud(0.1)
    estimate = dataclasses.replace(estimate, normals=-estimate.normals)
    metrics = reconstruction_metrics(estimate, grid_cloud(), CONFIG)
    np.testing.assert_allclose(metrics["reconstruction/accuracy_m"], 0.1, rtol=1e-9)
    np.testing.assert_allclose(metrics["reconstruction/completion_m"], 0.1, rtol=1e-9)
    assert metrics["reconstruction/f1_20cm_percent"] == 100.0
    assert metrics["reconstruction/f1_5cm_percent"] == 0.0
    assert metrics["reconstruction/normals_abs_cos_percent"] == 100.0
    assert metrics["reconstruction/num_points"] == 1600


def test_half_a_plane_has_full_precision_and_half_the_recall():
    truth = grid_cloud()
    left = truth.points[:, 0] < 1.0
    half = PointCloud(truth.points[left], truth.normals[left], truth.colors[left])
    metrics = reconstruction_metrics(half, truth, EvaluationConfig(f1_thresholds_m=(0.01,)))
    assert metrics["reconstruction/precision_1cm_percent"] == 100.0
    assert metrics["reconstruction/recall_1cm_percent"] == 50.0
    np.testing.assert_allclose(metrics["reconstruction/f1_1cm_percent"], 200.0 / 3.0)
    assert metrics["reconstruction/accuracy_m"] == 0.0
    # Columns 1 … 20 of the missing half are 5, 10 … 100 cm away: the mean over all is half their mean.
    np.testing.assert_allclose(metrics["reconstruction/completion_m"], 0.5 * 0.05 * 10.5)


def test_one_far_outlier_counts_in_full():
    truth = grid_cloud()
    points = np.concatenate([truth.points, [[0.003, 0.003, 1600.003]]])
    estimate = PointCloud(points, np.zeros_like(points), np.zeros_like(points))
    metrics = reconstruction_metrics(estimate, truth, CONFIG)
    np.testing.assert_allclose(metrics["reconstruction/accuracy_m"], 1600.0 / 1601.0, rtol=1e-9)


def test_distances_and_normals_are_those_of_brute_force():
    rng = np.random.default_rng(1)
    estimate, truth = random_cloud(rng, 300), random_cloud(rng, 200)
    config = EvaluationConfig(voxel_m=1e-4)
    metrics = reconstruction_metrics(estimate, truth, config)
    distances = np.linalg.norm(estimate.points[:, None] - truth.points[None], axis=-1)
    cosines = np.abs(estimate.normals @ truth.normals.T)
    there, back = distances.argmin(1), distances.argmin(0)
    both = [cosines[np.arange(300), there], cosines[back, np.arange(200)]]
    expected = {
        "accuracy_m": distances.min(1).mean(),
        "completion_m": distances.min(0).mean(),
        "precision_20cm_percent": 100 * (distances.min(1) <= 0.2).mean(),
        "recall_20cm_percent": 100 * (distances.min(0) <= 0.2).mean(),
        "normals_abs_cos_percent": 50 * (both[0].mean() + both[1].mean()),
        "normals_within_30deg_percent": 50 * sum((cos >= np.cos(np.pi / 6)).mean() for cos in both),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[f"reconstruction/{name}"], value, rtol=1e-6, err_msg=name)


def test_metrics_follow_a_similarity_of_both_clouds():
    rng = np.random.default_rng(2)
    estimate, truth = random_cloud(rng), random_cloud(rng)
    move = Alignment(2.0, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    small = EvaluationConfig(voxel_m=1e-4, f1_thresholds_m=(0.1,))
    large = EvaluationConfig(voxel_m=1e-4, f1_thresholds_m=(0.2,))
    before = list(reconstruction_metrics(estimate, truth, small).values())
    after = list(reconstruction_metrics(transform_cloud(estimate, move), transform_cloud(truth, move), large).values())
    np.testing.assert_allclose(after[:2], 2.0 * np.array(before[:2]), rtol=1e-6)
    np.testing.assert_allclose(after[2:], before[2:], rtol=1e-6)


def test_empty_clouds_and_unknown_normals_give_null_with_a_reason():
    empty = PointCloud(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)))
    truth = grid_cloud()
    for estimate, reference, word in ((empty, truth, "estimate"), (truth, empty, "ground truth")):
        metrics = reconstruction_metrics(estimate, reference, CONFIG)
        assert metrics["reconstruction/accuracy_m"] is None
        assert word in metrics["reconstruction/reason"]
    blank = dataclasses.replace(truth, normals=np.zeros_like(truth.points))
    metrics = reconstruction_metrics(blank, truth, CONFIG)
    assert metrics["reconstruction/accuracy_m"] == 0.0
    assert metrics["reconstruction/normals_abs_cos_percent"] is None
    assert metrics["reconstruction/reason"] == "no normals to compare"


def test_the_prior_of_true_points_is_the_ground_truth_and_moves_with_the_poses():
    rng = np.random.default_rng(6)
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.random(rng=rng).as_matrix(), [1.0, 2.0, 3.0]
    frame = a_frame(plane_depth((0.3, 0.2, 0.9), 2.0).clip(0.0, 5.0), move)
    no_truth = Frame(1, 1.0, "g", frame.image)
    truth = ground_truth_cloud([frame, no_truth], INTRINSICS, CONFIG)
    view = (backproject(frame.depth, INTRINSICS), frame.depth > 0, frame.image, frame.T_world_camera)
    raw = raw_prior_cloud([view], CONFIG)
    np.testing.assert_array_equal(raw.points, truth.points)
    np.testing.assert_allclose(truth.colors, 0.2)
    # In the camera's frame the points lie on the plane again.
    camera = (truth.points - move[:3, 3]) @ move[:3, :3]
    on_plane = camera[:, 2] < 4.9
    normal = np.array([0.3, 0.2, 0.9])
    np.testing.assert_allclose(camera[on_plane] @ normal, 2.0, atol=1e-5)
    cosines = truth.normals @ move[:3, :3] @ normal / np.linalg.norm(normal)
    assert (cosines[on_plane] < -0.99).mean() > 0.95


def test_a_cloud_is_aligned_by_the_poses_with_scale_or_without():
    """The estimate is half the size; without scale it keeps its size about the poses' centre."""
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(6, 3))
    cloud, half = random_cloud(rng), poses.copy()
    half[:, :3, 3] *= 0.5
    estimate = dataclasses.replace(cloud, points=0.5 * cloud.points)
    found, note = align_cloud(estimate, half, poses, CONFIG)
    assert note is None
    np.testing.assert_allclose(found.points, cloud.points, atol=1e-12)
    found, _ = align_cloud(estimate, half, poses, EvaluationConfig(alignment="se3"))
    np.testing.assert_allclose(found.points, estimate.points + 0.5 * poses[:, :3, 3].mean(0), atol=1e-12)


@pytest.mark.skipif(not REPLICA.exists(), reason="the shared Replica sequence is not here")
def test_the_ground_truth_of_replica_lies_on_its_mesh_with_its_normals():
    cv2, o3d = pytest.importorskip("cv2"), pytest.importorskip("open3d")
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
