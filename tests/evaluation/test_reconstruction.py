"""Oracles: closed forms on planes and spheres, brute force, equivariance, the real Replica mesh, config = YAML."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import Frame
from emgs_jax.evaluation.reconstruction import (
    EvaluationConfig,
    PointCloud,
    backproject,
    fuse_clouds,
    ground_truth_cloud,
    raw_prior_cloud,
    reconstruction_metrics,
    transform_cloud,
    voxel_downsample,
    window_normals,
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


def test_points_of_a_voxel_become_their_mean_and_twice_is_once():
    rng = np.random.default_rng(3)
    cloud = random_cloud(rng, 5000)
    small = voxel_downsample(cloud, 0.2)
    cells, inverse = np.unique(np.floor(cloud.points / 0.2), axis=0, return_inverse=True)
    means = np.stack([cloud.points[inverse.ravel() == cell].mean(0) for cell in range(len(cells))])
    np.testing.assert_allclose(small.points, means, rtol=0, atol=1e-12)
    again = voxel_downsample(small, 0.2)
    for name in ("points", "normals", "colors"):
        np.testing.assert_allclose(getattr(again, name), getattr(small, name), atol=1e-12)


def test_fusing_pieces_is_reducing_the_whole(monkeypatch):
    monkeypatch.setattr("emgs_jax.evaluation.reconstruction._MERGE_ROWS", 50)
    cloud = random_cloud(np.random.default_rng(4), 900)
    pieces = [PointCloud(cloud.points[i::7], cloud.normals[i::7], cloud.colors[i::7]) for i in range(7)]
    whole, fused = voxel_downsample(cloud, 0.1), fuse_clouds(iter(pieces), 0.1)
    for name in ("points", "normals", "colors"):
        np.testing.assert_allclose(getattr(fused, name), getattr(whole, name), atol=1e-12)
    poisoned = PointCloud(cloud.points.copy(), cloud.normals, cloud.colors)
    poisoned.points[::2] = np.nan
    assert np.isfinite(voxel_downsample(poisoned, 0.1).points).all()
    assert len(voxel_downsample(poisoned, 1e-6)) == 450


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.3, 0.8), (-0.6, 0.5, 0.62)])
def test_normals_of_a_plane_are_exact_and_face_the_camera(normal):
    normal = np.asarray(normal) / np.linalg.norm(normal)
    depth = plane_depth(normal, 2.0)
    valid = (depth > 0.3) & (depth < 8.0)
    normals = window_normals(backproject(np.where(valid, depth, 0.0), INTRINSICS), valid, CONFIG)
    known = normals.any(-1)
    assert known[valid].mean() > 0.9
    np.testing.assert_allclose(normals[known], np.broadcast_to(-normal, normals[known].shape), atol=2e-3)


def test_normals_of_a_noisy_sphere_point_from_its_centre():
    rays = backproject(np.ones(SHAPE), INTRINSICS)
    center = np.array([0.1, -0.05, 2.5])
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - 1.0
    hit = b * b - a * c > 0
    depth = np.where(hit, (b - np.sqrt(np.maximum(b * b - a * c, 0.0))) / a, 0.0)
    noise = 1.0 + 0.002 * np.random.default_rng(5).normal(size=SHAPE)
    normals = window_normals(backproject(depth * noise, INTRINSICS), hit, CONFIG)
    truth = backproject(depth, INTRINSICS) - center
    known = normals.any(-1)
    assert not known[~hit].any()
    assert known[hit].mean() > 0.9
    angles = np.degrees(np.arccos(np.einsum("nk,nk->n", normals[known], truth[known]).clip(-1, 1)))
    assert np.median(angles) < 4.0


def test_a_depth_step_does_not_bend_the_normals_beside_it():
    depth = np.full(SHAPE, 2.0)
    depth[:, 60:] = 3.0
    normals = window_normals(backproject(depth, INTRINSICS), depth > 0, CONFIG)
    known = normals.any(-1)
    assert known.mean() > 0.95
    np.testing.assert_allclose(normals[known], np.broadcast_to([0.0, 0.0, -1.0], normals[known].shape), atol=1e-3)


def test_invalid_pixels_have_no_normal_and_change_no_other():
    depth = plane_depth((0.3, 0.2, 0.9), 2.0)
    points, valid = backproject(depth, INTRINSICS), np.ones(SHAPE, bool)
    valid[20:30, 40:55] = False
    poisoned = points.copy()
    poisoned[~valid] = np.nan
    normals = window_normals(poisoned, valid, CONFIG)
    assert not normals[~valid].any()
    points[~valid] = 0.0
    np.testing.assert_array_equal(normals, window_normals(points, valid, CONFIG))


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
