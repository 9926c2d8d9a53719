"""A run in another unit; oracles: a pinhole sees the same picture; bytes that must stay."""

import json
import math
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hand_run import random_poses
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation
from written_run import written_run

from emgs_jax import load_map
from emgs_jax.config import configure
from emgs_jax.geometry import Sim3
from emgs_jax.io.mesh import save_mesh_ply
from emgs_jax.io.ply import save_gaussians_ply, save_points_ply
from emgs_jax.io.ply_reader import read_vertices, transform_ply
from emgs_jax.io.trajectory import load_trajectory_tum, save_trajectory_tum
from emgs_jax.prior.base import UP_KEYS
from emgs_jax.runs.export import factor_of, measured_up, to_export, write_moved
from emgs_jax.runs.finished_run import read_run
from experiments.export import export_run

pytestmark = pytest.mark.slow


FACTOR = 1.7


@pytest.fixture
def run(tmp_path):
    rng = np.random.default_rng(3)
    folder = written_run(tmp_path / "run")
    run = read_run(folder)
    poses = random_poses(rng, run.is_placed.sum())
    times, _ = load_trajectory_tum(folder / "trajectory.txt")
    save_trajectory_tum(folder / "trajectory.txt", times, poses)
    points = rng.normal(size=(300, 3)).astype(np.float32)
    save_points_ply(folder / "points.ply", points, points, np.full((300, 3), 0.5), np.ones(300, int), ("wall", "sofa"))
    save_gaussians_ply(
        folder / "map.ply", points[:20], np.tile(np.diag([0.04, 0.01, 0.0025]), (20, 1, 1)), points[:20], 0.9
    )
    return read_run(folder)


@cache
def composed():
    return configure.compose("folder=nowhere", name="export")


def exported(run, **values):
    return export_run(OmegaConf.merge(composed(), {"folder": str(run.folder), **values}))


def test_poses_map_and_clouds_grow_together_and_everything_else_stays(run, tmp_path):
    folder = tmp_path / "new"
    folder.mkdir()
    scaled = write_moved(run, folder, Sim3.about(np.zeros(3), FACTOR))
    times, poses = load_trajectory_tum(folder / "trajectory.txt")
    np.testing.assert_array_equal(times, load_trajectory_tum(run.folder / "trajectory.txt")[0])
    np.testing.assert_allclose(poses[:, :3, 3], FACTOR * run.poses[run.is_placed, :3, 3], atol=1e-8)
    np.testing.assert_allclose(poses[:, :3, :3], run.poses[run.is_placed, :3, :3], atol=1e-8)
    np.testing.assert_array_equal(scaled.poses[:, 3], run.poses[:, 3])
    map, valid = load_map(folder / "map.npz"), np.asarray(run.map.gaussians.valid)
    np.testing.assert_allclose(map.gaussians.means, FACTOR * run.map.gaussians.means, rtol=1e-6)
    np.testing.assert_allclose(map.gaussians.covs[valid], FACTOR**2 * run.map.gaussians.covs[valid], rtol=1e-6)
    for name in ("colors", "normals", "features", "valid"):
        np.testing.assert_array_equal(getattr(map.gaussians, name), getattr(run.map.gaussians, name))
    online = [load_trajectory_tum(at / "trajectory_online.txt")[1] for at in (run.folder, folder)]
    np.testing.assert_allclose(online[1][:, :3, 3], FACTOR * online[0][:, :3, 3], atol=1e-8)

    # A scale shows in no image: pixels of all points from all cameras are the same.
    (before, seen), (after, _) = pixels(run.folder), pixels(folder)
    np.testing.assert_allclose(after[seen], before[seen], atol=1e-5)


def pixels(folder):
    """Pixels of all points from all cameras, and which are in front."""
    cloud, (_, poses) = read_vertices(folder / "points.ply"), load_trajectory_tum(folder / "trajectory.txt")
    points = np.stack([cloud[name] for name in "xyz"], 1).astype(float)
    local = np.einsum("nji,npj->npi", poses[:, :3, :3], points - poses[:, None, :3, 3])
    return local[..., :2] / local[..., 2:], local[..., 2] > 0.1


def test_a_ply_keeps_labels_comments_and_triangles(run, tmp_path):
    before, target = run.folder / "points.ply", tmp_path / "points.ply"
    transform_ply(before, target, Sim3.about(np.zeros(3), 2.0))
    old, new = read_vertices(before), read_vertices(target)
    for name in old:
        np.testing.assert_array_equal(new[name], old[name] * (2 if name in "xyz" else 1), name)
    head = before.read_bytes().split(b"end_header")[0]
    assert b"comment label 1 sofa" in head and target.read_bytes().split(b"end_header")[0] == head
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3) / 20
    assert (
        save_mesh_ply(tmp_path / "m.ply", grid, np.tile([0.0, 0, 1], (400, 1)), (grid, np.full((400, 3), 0.5))) is None
    )
    transform_ply(tmp_path / "m.ply", tmp_path / "m2.ply", Sim3.about(np.zeros(3), 2.0))
    faces = [path.read_bytes()[-130:] for path in (tmp_path / "m.ply", tmp_path / "m2.ply")]
    assert faces[0] == faces[1]


def test_gaussians_of_a_ply_are_as_much_wider(run, tmp_path):
    transform_ply(run.folder / "map.ply", tmp_path / "map.ply", Sim3.about(np.zeros(3), FACTOR))
    old, new = read_vertices(run.folder / "map.ply"), read_vertices(tmp_path / "map.ply")
    widths = np.exp([new[f"scale_{i}"][0] for i in range(3)])
    np.testing.assert_allclose(sorted(widths), FACTOR * np.array([0.05, 0.1, 0.2]), rtol=1e-5)
    np.testing.assert_array_equal(new["opacity"], old["opacity"])


def test_a_known_length_between_two_cameras_becomes_that_length(run):
    factor = factor_of(run, [1, 5, 3.4])
    a, b = run.poses[1][:3, 3], run.poses[5][:3, 3]
    assert math.dist(factor * a, factor * b) == pytest.approx(3.4)
    exported(run, length=[1, 5, 3.4], formats=["frustums"])
    _, poses = load_trajectory_tum(run.folder / "scaled" / "trajectory.txt")
    assert math.dist(poses[1][:3, 3], poses[-1][:3, 3]) == pytest.approx(3.4, abs=1e-7)
    assert json.loads((run.folder / "scaled" / "scale.json").read_text())["factor"] == pytest.approx(factor)
    assert (run.folder / "scaled" / "cameras.ply").is_file()


def test_exports_are_in_the_new_unit_and_the_run_stays(run):
    before = {path.name: path.read_bytes() for path in run.folder.iterdir()}
    exported(run, scale=FACTOR, formats=["nerfstudio"])
    frames = json.loads((run.folder / "scaled" / "nerfstudio" / "transforms.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    np.testing.assert_allclose(centers, FACTOR * np.delete(run.poses, 3, 0)[:, :3, 3], atol=1e-7)
    cloud = read_vertices(run.folder / "scaled" / "nerfstudio" / "points.ply")
    np.testing.assert_allclose(cloud["x"], FACTOR * read_vertices(run.folder / "points.ply")["x"], rtol=1e-6)
    assert {name: (run.folder / name).read_bytes() for name in before} == before
    with pytest.raises(ValueError, match="scaled is there already: remove it, or write elsewhere"):
        exported(run, scale=2, formats=[])
    exported(run, scale=2, formats=[], out=str(run.folder / "twice"))
    assert not (run.folder / "twice" / "nerfstudio").exists()


def test_a_failed_copy_leaves_nothing(run):
    (run.folder / "points.ply").write_bytes((run.folder / "points.ply").read_bytes()[:-1])
    with pytest.raises(ValueError, match="points.ply has .* bytes after its header"):
        exported(run, scale=2, formats=[])
    assert not [path for path in run.folder.iterdir() if "scaled" in path.name]


def test_frames_are_counted_as_frames_jsonl_counts_them(run):
    """Where unreadable images were left out, rows and numbers differ."""
    shifted = replace(run, frames=[{**frame, "index": frame["index"] + 10} for frame in run.frames])
    assert factor_of(shifted, [11, 15, 2.0]) == factor_of(run, [1, 5, 2.0])


def covariances(path):
    rows = read_vertices(path)
    turns = Rotation.from_quat(np.stack([rows[f"rot_{i}"] for i in range(4)], 1), scalar_first=True).as_matrix()
    widths = np.exp(np.stack([rows[f"scale_{i}"] for i in range(3)], 1).astype(float))
    return np.einsum("nij,nj,nkj->nik", turns, widths**2, turns)


def test_z_is_up_in_a_turned_export_of_all_files_alike_and_the_run_stays(run, capsys):
    """Level cameras that look along z, y down, as those of the built-in room; oracle: the same pictures."""
    times, _ = load_trajectory_tum(run.folder / "trajectory.txt")
    tilt = Rotation.from_euler("x", 25, degrees=True)  # they look down
    level = np.tile(np.eye(4), (len(times), 1, 1))
    for row in range(len(times)):
        level[row, :3, :3] = (Rotation.from_euler("y", 20 * row, degrees=True) * tilt.inv()).as_matrix()
        level[row, :3, 3] = [0.3 * row, 0.02 * row, 0.1 * row]
    save_trajectory_tum(run.folder / "trajectory.txt", times, level)
    before = {path.name: path.read_bytes() for path in run.folder.iterdir()}
    exported(run, up="z", formats=["nerfstudio", "frustums"])
    assert {name: (run.folder / name).read_bytes() for name in before} == before
    assert "z is up" in capsys.readouterr().out
    folder = run.folder / "upright"
    T = np.array(json.loads((folder / "T_export_map.json").read_text())["T_export_map"])
    np.testing.assert_allclose(T[:3, :3] @ [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], atol=0.03)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    _, poses = load_trajectory_tum(folder / "trajectory.txt")
    np.testing.assert_allclose(poses, T @ level, atol=1e-6)
    frames = json.loads((folder / "nerfstudio" / "transforms.json").read_text())["frames"]
    np.testing.assert_allclose([frame["transform_matrix"][2][3] for frame in frames], poses[:, 2, 3], atol=1e-6)
    (old, seen), (new, _) = pixels(run.folder), pixels(folder)
    np.testing.assert_allclose(new[seen], old[seen], atol=1e-4)
    clouds = [read_vertices(at / "points.ply") for at in (run.folder, folder)]
    normals = [np.stack([cloud[name] for name in ("nx", "ny", "nz")], 1) for cloud in clouds]
    np.testing.assert_allclose(normals[1], normals[0] @ T[:3, :3].T, atol=1e-5)
    for name in ("map.ply", "points.ply", "cameras.ply"):
        assert (b"comment z is up\n" in (folder / name).read_bytes()[:2000]) == (name != "cameras.ply")
    turned, own = (covariances(at / "map.ply") for at in (folder, run.folder))
    np.testing.assert_allclose(turned, T[:3, :3] @ own @ T[:3, :3].T, atol=1e-6)
    map = load_map(folder / "map.npz")
    valid = np.asarray(map.gaussians.valid)
    np.testing.assert_allclose(
        np.asarray(map.gaussians.means)[valid], np.asarray(run.map.gaussians.means)[valid] @ T[:3, :3].T, atol=1e-5
    )


def test_splats_and_their_poses_go_where_the_map_goes(run):
    """Symptom: a polished run was turned and scaled without its splats. Oracle: the map's Gaussians beside them."""
    shutil.copy(run.folder / "map.ply", run.folder / "splats.ply")
    shutil.copy(run.folder / "trajectory.txt", run.folder / "polish.txt")
    exported(run, up="z", scale=FACTOR, formats=[])
    folder = run.folder / "scaled"
    assert (folder / "splats.ply").read_bytes() == (folder / "map.ply").read_bytes()
    assert (folder / "polish.txt").read_bytes() == (folder / "trajectory.txt").read_bytes()
    assert (folder / "polish.txt").read_bytes() != (run.folder / "polish.txt").read_bytes()


def test_up_is_that_of_the_source_which_told_the_scale(run):
    """Known in a camera's axes, whatever cameras and walls say; symptom: those of the first one placed were taken."""
    up = np.array([0.6, 0.0, 0.8])
    told = [*map(float, run.poses[2, :3, :3].T @ up), run.frames[2]["index"]]
    known = replace(run, metrics=run.metrics | dict(zip(UP_KEYS, told, strict=True)))
    np.testing.assert_allclose(measured_up(known), up, atol=1e-9)
    np.testing.assert_allclose(to_export(known, None, "z").rotation @ up, [0.0, 0.0, 1.0], atol=1e-9)
    lost = replace(known, frames=[*run.frames[:2], run.frames[2] | {"status": "lost"}, *run.frames[3:]])
    assert measured_up(lost) is None
    assert measured_up(run) is None and to_export(known, None, "run") is None


def test_a_turned_export_can_have_another_unit_too(run):
    exported(run, up="z", scale=2.0, formats=[])
    T = np.array(json.loads((run.folder / "scaled" / "T_export_map.json").read_text())["T_export_map"])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(8.0)
    assert not (run.folder / "upright").exists()
    with pytest.raises(ValueError, match="up must be one of run, z"):
        exported(run, up="y", formats=[])
