"""The synthetic room: exact geometry, a path that is free and smooth, textures that stay on their surfaces."""

from functools import cache

import numpy as np
import pytest
import trimesh
from written_scene import moved

from emgs_jax.data.synthetic import Synthetic

SMALL = (80, 60)
room = cache(Synthetic)  # of a seed


def test_a_ray_of_an_off_centre_camera_ends_where_its_first_triangle_is():
    """fx != fy, cx and cy off the centre, one literal pixel: pins pixel centres, axes and the meaning of depth."""
    dataset = Synthetic(size=SMALL, intrinsics=(70.0, 60.0, 45.0, 25.0))
    frame = dataset[7]
    u, v = 13, 41
    ray = np.array([(u - 45.0) / 70.0, (v - 25.0) / 60.0, 1.0])
    rotation, center = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    triangles = trimesh.util.concatenate([mesh for _, mesh in dataset.parts]).triangles
    assert frame.depth[v, u] == pytest.approx(first_hit(triangles, center, rotation @ ray), abs=1e-5)  # its z is 1
    assert frame.depth.dtype == np.float32 and frame.labels.dtype == np.int32 and frame.image.dtype == np.uint8


def first_hit(triangles: np.ndarray, origin: np.ndarray, ray: np.ndarray) -> float:
    """Smallest t > 0 at which origin + t ray lies in one of the triangles (n, 3, 3), by solving for t and weights."""
    a, b, c = triangles.transpose(1, 0, 2)
    solvable = np.stack([np.broadcast_to(-ray, a.shape), b - a, c - a], axis=-1)
    keep = np.abs(np.linalg.det(solvable)) > 1e-12
    t, beta, gamma = np.linalg.solve(solvable[keep], (origin - a[keep])[..., None])[..., 0].T
    return t[(t > 0) & (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1)].min()


@pytest.mark.parametrize("seed", [0, 1])
def test_neighbours_see_the_same_surfaces_in_the_same_colours(seed, depth_gaps):
    dataset = room(seed)
    gaps = np.concatenate([depth_gaps(dataset, i, i + 1, edge=0.02) for i in (0, 20, 38)])
    assert np.median(np.abs(gaps)) < 0.003  # half a pixel of rounding on slants
    assert np.quantile(gaps, 0.9999) < 0.02  # a point may be hidden, but none floats in front of what is seen
    a, b, (w, h) = dataset[10], dataset[11], dataset.size
    pixels, (column, row, z) = moved(dataset, 10, 11)
    column, row = np.rint(column).astype(int), np.rint(row).astype(int)
    inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
    assert inside.mean() > 0.85  # overlap
    inside[inside] = np.abs(b.depth[row[inside], column[inside]] - z[inside]) < 0.02
    at_a, at_b = tuple(pixels[:, inside]), (row[inside], column[inside])
    assert np.corrcoef(a.image[at_a].ravel(), b.image[at_b].ravel())[0, 1] > 0.95
    assert np.mean(a.labels[at_a] == b.labels[at_b]) > 0.99
    assert np.mean(np.abs(np.diff(a.image.astype(float).mean(-1), axis=1))) > 2.0  # grey levels a pixel, for colour ICP


def test_normals_are_those_of_the_neighbouring_points():
    dataset = room(1)
    depth, normals = dataset[5].depth.astype(np.float64), dataset.normals(5)
    fx, fy, cx, cy = dataset.intrinsics
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=-1)
    cross = np.cross(points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1])
    cross /= -np.linalg.norm(cross, axis=-1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert ((normals * points).sum(-1) < 0).all(), "normals face the camera"
    agree = (cross * normals[1:-1, 1:-1]).sum(-1)
    assert np.median(agree) > 0.999 and (agree > 0.99).mean() > 0.85  # edges are the rest


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_keeps_clear_of_the_furniture_and_moves_smoothly(seed):
    dataset = Synthetic(seed, size=SMALL)
    poses = np.array([dataset.pose(i) for i in range(len(dataset))])
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (40, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(rotations[:, 2, 0], 0, atol=1e-12)  # x stays level: no roll
    assert (rotations[:, 2, 1] < 0).all()  # y points down, z of the world up
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    cosines = (np.einsum("nij,nij->n", rotations[:-1], rotations[1:]) - 1) / 2
    turns = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert steps.min() > 0.05 and steps.max() < 0.09
    assert turns.min() > 2.5 and turns.max() < 4.6
    corners = np.concatenate([mesh.sample(2000, seed=0) for _, mesh in dataset.parts])
    gaps = np.linalg.norm(corners[None] - poses[::4, None, :3, 3], axis=-1)
    assert gaps.min() > 0.35


def test_the_same_seed_gives_the_same_room_another_seed_another_and_a_stride_frames_of_the_same_path():
    first, again, other = Synthetic(4, size=SMALL), Synthetic(4, size=SMALL), Synthetic(5, size=SMALL)
    np.testing.assert_array_equal(first[3].image, again[3].image)
    np.testing.assert_array_equal(first[3].depth, again[3].depth)
    assert first.fingerprint() == again.fingerprint() != other.fingerprint()
    assert np.abs(first[3].depth - other[3].depth).max() > 0.1
    part = Synthetic(4, size=SMALL, start=4, stop=20, stride=5)
    assert [frame.timestamp for frame in part] == [4, 9, 14, 19]
    np.testing.assert_array_equal(part[1].image, first[9].image)


def test_the_room_of_published_tables_and_recorded_predictions_stays_what_it_is_and_shows_most_classes():
    """Numbers of version 1: whoever changes one on purpose changes the version too. Rounded, as machines round."""
    dataset = Synthetic(0, size=SMALL)
    frame = dataset[7]
    assert dataset.fingerprint() == "dde8ac42b7e742865238e45966615fbe1ce36568385f889bb4b0cd6790edd7a5"
    np.testing.assert_allclose(frame.image.mean(axis=(0, 1)), [124.0458, 94.0144, 113.7223], atol=0.02)
    assert frame.depth.mean() == pytest.approx(2.55788, abs=1e-4)
    pixels = np.bincount(frame.labels.ravel(), minlength=12)
    np.testing.assert_allclose(pixels, [2655, 474, 0, 518, 297, 0, 0, 0, 0, 170, 532, 154], atol=3)
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], [0.40188799, 0.8585547, 1.48029516], atol=1e-8)
    np.testing.assert_allclose(frame.T_world_camera[:3, 2], [-0.3275244, -0.90583982, -0.26866706], atol=1e-8)
    seen = {dataset.classes[label] for i in range(0, 40, 6) for label in np.unique(dataset[i].labels)}
    assert seen >= {"wall", "floor", "table", "chair", "shelf", "cabinet", "box", "ball", "picture"}
