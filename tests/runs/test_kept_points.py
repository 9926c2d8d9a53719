"""The frames' own points move into a merged map as its Gaussians do."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scene import compose, device, fresh_map, slam_config
from scipy.spatial.transform import Rotation

from emgs_jax.back_end.optimization import move_map, nodes_of
from emgs_jax.back_end.saved_map import SavedMap
from emgs_jax.back_end.state import BackEnd, Node
from emgs_jax.config.configure import graph_config
from emgs_jax.evaluation.clouds import PointCloud
from emgs_jax.gaussians import Gaussians
from emgs_jax.geometry import Sim3
from emgs_jax.io.ply import save_points_ply
from emgs_jax.loop_closure.place_recognition import Database
from emgs_jax.mapping import merging
from emgs_jax.mapping.atlas import Atlas, unvisited
from emgs_jax.mapping.merging import beside
from emgs_jax.ops.camera import Camera
from emgs_jax.pose_graph.deform import DeformConfig
from emgs_jax.runs.kept_points import Moved, moved_parts, moved_points, read_points

INTRINSICS = (50.0, 50.0, 31.5, 23.5)


def posed(seed: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = np.random.default_rng(seed).uniform(-1, 1, 3)
    return pose


def node(seed: int, log_scale: float = 0.0) -> Node:
    return Node(posed(seed), posed(seed), log_scale, seed)


def map_of(means, births):
    count = len(means)
    arrays = means, np.tile(1e-4 * np.eye(3), (count, 1, 1)), np.full((count, 3), 0.5), np.tile([0.0, 0, 1], (count, 1))
    map = fresh_map(Gaussians(*map_arrays(*arrays, np.zeros((count, 0)), np.ones(count, bool))), 1.0, 2.0, 0)
    return replace(map, birth=jnp.asarray(births, jnp.int32))


def map_arrays(*arrays):
    return (device(array) for array in arrays)


def cloud_at(points) -> PointCloud:
    normals = np.random.default_rng(3).normal(size=points.shape)
    return PointCloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), np.full(points.shape, 0.5))


@pytest.fixture(scope="module")
def scene():
    """Points around Gaussians of four frames, of which the last came a hundred frames later."""
    rng = np.random.default_rng(0)
    means, births = rng.uniform(-2, 2, (200, 3)), rng.choice([0, 1, 2, 103], 200)
    before = [node(seed) for seed in range(104)]
    return map_of(np.float32(means), births), before, means + 1e-4 * rng.normal(size=means.shape)


def shifted(before, small):
    """Each node with a small motion of its own, and another unit."""
    rng = np.random.default_rng(1)
    found = []
    for one in before:
        turn = Rotation.from_rotvec(small * rng.normal(size=3)).as_matrix()
        move = Sim3(1.0, turn, small * rng.normal(size=3))
        found.append(replace(one, pose=move.apply_to_poses(one.pose), log_scale=small * float(rng.normal())))
    return found


@pytest.mark.parametrize("num_neighbours", [1, 9])
def test_points_at_gaussians_move_as_the_gaussians_do(scene, num_neighbours):
    map, before, points = scene
    after, config = shifted(before, 0.05), DeformConfig(num_neighbours=num_neighbours)
    ends = (nodes_of(BackEnd(None, INTRINSICS, 0.01, nodes)) for nodes in (before, after))
    moved = move_map(map, *ends, jnp.asarray(0.01), config).gaussians
    found = moved_points(cloud_at(points), Moved(map, before, after), config)
    # The points lie .1 mm beside the means.
    np.testing.assert_allclose(found.points, moved.means, atol=1e-3)
    assert np.abs(found.points - points).max() > 0.05


def test_all_points_move_with_a_run_that_moves_as_one_body_and_normals_turn_with_it(scene):
    map, before, points = scene
    move = Sim3(1.25, posed(7)[:3, :3], np.array([1.0, 2, 3]))
    after = [replace(one, pose=move.apply_to_poses(one.pose), log_scale=np.log(1.25)) for one in before]
    cloud = cloud_at(points)
    cloud.normals[0] = 0.0  # unknown
    found = moved_points(cloud, Moved(map, before, after), DeformConfig())
    np.testing.assert_allclose(found.points, move.apply(points), atol=1e-9)
    np.testing.assert_allclose(found.normals, cloud.normals @ move.rotation.T, atol=1e-9)
    np.testing.assert_array_equal(found.colors, cloud.colors)


def test_gaussians_that_are_not_confirmed_move_no_points(scene):
    map, before, points = scene
    after = shifted(before, 0.05)
    twice = map_of(np.float32(np.concatenate([points, points + 1e-6])), np.concatenate([map.birth, 0 * map.birth + 50]))
    tentative = replace(twice, existence=jnp.where(jnp.arange(400) < 200, 2.0, -1.0))
    found, alone = (
        moved_points(cloud_at(points), Moved(one, before, after), DeformConfig(num_neighbours=1))
        for one in (tentative, map)
    )
    np.testing.assert_allclose(found.points, alone.points, atol=1e-9)


def atlas_of(seeds, first_node):
    nodes = [node(seed) for seed in seeds]
    map = map_of(np.zeros((len(nodes), 3), np.float32), range(len(nodes)))
    end = BackEnd(graph_config(compose("graph=default")), INTRINSICS, 0.01, nodes, first_node=first_node)
    camera, slam = Camera([50.0, 50.0], [31.5, 23.5], 64, 48), slam_config()
    return Atlas(
        camera, slam, end, {0: unvisited(SavedMap(map, end, 0.01, is_frozen=False, checksum=""), camera, slam)}
    )


def test_every_node_is_found_among_those_of_the_merged_run_saved_maps_included(monkeypatch):
    monkeypatch.setattr(merging, "with_keyframes", lambda *_: Database())  # there are none
    parts = [atlas_of(range(10, 15), 2), atlas_of(range(20, 24), 0), atlas_of(range(30, 36), 3)]
    merged = beside(beside(parts[0], parts[1]), parts[2])
    for part, moved in zip(parts, moved_parts(parts, merged.graph.nodes), strict=True):
        frames = [one.frame for one in part.graph.nodes]
        assert [one.frame for one in moved.before] == [one.frame for one in moved.after] == frames


def test_the_points_of_a_run_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(5)
    points, colors = rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 3)) / 255.0
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[3] = 0.0
    save_points_ply(tmp_path / "points.ply", points, normals, colors)
    found = read_points(tmp_path / "points.ply")
    for read, written in zip(vars(found).values(), (points, normals, colors), strict=True):
        np.testing.assert_allclose(read, written, atol=1e-6)
