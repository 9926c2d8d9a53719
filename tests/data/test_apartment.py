"""The apartment: walks that are free and smooth, loops that come back, and rooms that are mistaken for each other."""

from functools import cache

import numpy as np
import open3d as o3d
import pytest

from emgs_jax.data.apartment import Apartment
from emgs_jax.data.plan import APART, BAY, WALL, Area, Plan, draw_plan
from emgs_jax.data.walks import WALKS

pytestmark = pytest.mark.slow

SEEDS_AND_WALKS = [*((0, walk) for walk in WALKS), (1, "two_laps"), (1, "twin_rooms")]


@cache
def apartment(walk: str = "two_laps", seed: int = 0) -> Apartment:
    return Apartment(seed, walk=walk, size=(80, 60))


@cache
def poses(walk: str, seed: int = 0) -> np.ndarray:
    dataset = apartment(walk, seed)
    return np.array([dataset.pose(index) for index in range(len(dataset))])


def surfaces(seed: int) -> o3d.t.geometry.RaycastingScene:
    return apartment(seed=seed)._scene


def rooms(plan: Plan) -> tuple[Area, ...]:
    """The four of the laps, and a twin."""
    return plan.living, plan.dining, plan.study, plan.bedroom, plan.twin


def cast(seed: int, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance in lengths of the direction, and class, of what the rays from (n, 3) meet first."""
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).astype(np.float32)
    hit = surfaces(seed).cast_rays(o3d.core.Tensor(rays))
    names = np.array([name for name, _ in apartment(seed=seed).parts])
    return hit["t_hit"].numpy(), names[hit["geometry_ids"].numpy().astype(int)]


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between the viewing directions of poses."""
    return np.degrees(np.arccos(np.clip((a[..., :3, 2] * b[..., :3, 2]).sum(-1), -1, 1)))


def nearest(of: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres to, and row of, the pose `among` that is nearest to each."""
    gaps = np.linalg.norm(of[:, None, :3, 3] - among[None, :, :3, 3], axis=-1)
    return gaps.min(axis=1), gaps.argmin(axis=1)


@pytest.mark.parametrize(("seed", "walk"), SEEDS_AND_WALKS)
def test_the_walker_keeps_clear_of_everything_and_goes_smoothly(seed, walk):
    path = poses(walk, seed)
    centers, rotations = path[:, :3, 3], path[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(path), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(rotations[:, 2, 0], 0, atol=1e-12)  # x stays level: no roll
    steps = np.diff(centers, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert 200 <= len(path) <= 600
    assert lengths.min() > 0.03 and lengths.max() < 0.08
    assert angles(path[:-1], path[1:]).max() < 6
    assert np.abs(centers[:, 2] - 1.5).max() < 0.05
    gaps = surfaces(seed).compute_distance(o3d.core.Tensor(centers.astype(np.float32))).numpy()
    assert gaps.min() > 0.35
    free, _ = cast(seed, centers[:-1], steps)
    assert free.min() > 1, "no surface between a frame and the next"
    _, below = cast(seed, centers, np.array([0.0, 0.0, -1.0]))
    assert set(below) == {"floor"}, "nobody walks on furniture"


def test_the_rooms_are_of_different_sizes_and_furnished():
    for seed in range(8):
        sizes = [np.subtract(room.high, room.low) for room in rooms(draw_plan(np.random.default_rng(seed)))]
        assert np.min(sizes) > 3.5 and len(np.unique(np.prod(sizes, axis=1).round(2))) == 5
    for seed in (0, 1):
        parts = apartment(seed=seed).parts
        middles = np.array([mesh.bounds.mean(axis=0)[:2] for _, mesh in parts])
        for room in rooms(apartment(seed=seed).plan):
            inside = np.flatnonzero((middles > room.low).all(axis=1) & (middles < room.high).all(axis=1))
            names = {parts[i][0] for i in inside}
            assert len(names - {"wall", "floor", "ceiling", "door", "picture"}) >= 3, names


def test_a_wall_has_two_sides_and_a_doorway_has_none():
    """From the middle of the doorway's height, west and east of the wall between living and dining room."""
    plan = apartment().plan
    x, y = plan.north_door
    sides, inward = np.array([[x - 0.4, 0, 1.2], [x + 0.4, 0, 1.2]]), np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    distances, names = cast(0, sides + [0, y + 1.0, 0], inward)
    np.testing.assert_allclose(distances, 0.4 - WALL, atol=1e-5)
    assert set(names) == {"wall"}
    assert cast(0, sides + [0, y, 0], inward)[0].min() > 0.8


def test_two_laps_go_through_four_rooms_and_the_second_sees_what_the_first_saw():
    path = poses("two_laps")
    half = len(path) // 2
    for lap in (path[:half], path[half:]):
        for room in rooms(apartment().plan)[:4]:
            assert ((lap[:, :2, 3] > room.low) & (lap[:, :2, 3] < room.high)).all(axis=1).sum() > 20
    gaps, rows = nearest(path[half:], path[:half])
    assert gaps.max() < 0.3
    assert angles(path[half:], path[:half][rows]).max() < 15


def test_the_figure_of_eight_crosses_the_doorway_both_ways_and_turns_as_much_left_as_right():
    plan, path = apartment().plan, poses("figure_of_eight")
    at_door = np.linalg.norm(path[:, :2, 3] - plan.north_door, axis=1) < 0.2
    visits = np.split(np.flatnonzero(at_door), np.flatnonzero(np.diff(np.flatnonzero(at_door)) > 50) + 1)
    assert [np.sign(path[visit, 0, 2].mean()) for visit in visits] == [1, -1]  # eastward, then westward
    yaw = np.unwrap(np.arctan2(path[:, 1, 2], path[:, 0, 2]))
    assert abs(yaw[-1] - yaw[0]) < np.radians(20) and np.ptp(yaw) > np.radians(220)


def test_the_way_back_is_the_way_out_seen_from_the_other_side():
    path = poses("out_and_back")
    out, back = path[: len(path) // 3], path[-len(path) // 4 :]
    gaps, rows = nearest(back, out)
    turns = angles(back, out[rows])
    assert gaps.max() < 0.3
    assert np.median(turns) > 150  # both look 9 degrees down
    assert np.mean(turns > 120) > 0.7  # one looks into a corner before one walks round it: on both ways


def lookalikes(path: np.ndarray, shift: np.ndarray, first: np.ndarray) -> list[tuple[int, int]]:
    """Frames (i, j), i among the first, of which j is seen best from i's pose shifted: the sway is never the same."""
    shifted = path[first].copy()
    shifted[:, :3, 3] += shift
    gaps = np.linalg.norm(shifted[:, None, :3, 3] - path[None, :, :3, 3], axis=-1)
    off = gaps + 0.03 * angles(shifted[:, None], path[None])
    return [(int(first[row]), int(off[row].argmin())) for row in np.argsort(off.min(axis=1))[:3]]


def test_the_twin_rooms_look_the_same_though_they_are_six_metres_apart():
    path, dataset = poses("twin_rooms"), apartment("twin_rooms")
    inside = np.flatnonzero((path[:, 0, 3] < APART) & (path[:, 1, 3] > 1.5))
    for i, j in lookalikes(path, np.array([APART, 0, 0]), inside):
        a, b, other = dataset[i], dataset[j], dataset[j + 60]
        assert abs(b.T_world_camera[0, 3] - a.T_world_camera[0, 3] - APART) < 0.05
        assert np.corrcoef(a.image.ravel(), b.image.ravel())[0, 1] > 0.8
        assert np.corrcoef(a.image.ravel(), other.image.ravel())[0, 1] < 0.5
        assert np.median(np.abs(a.depth - b.depth)) < 0.05 and np.mean(a.labels == b.labels) > 0.93


def test_the_corridor_looks_the_same_again_three_metres_on():
    path, dataset = poses("corridor"), apartment("corridor")
    assert np.ptp(path[:, 1, 3]) > 15
    nearer = np.s_[30:]  # the lower half: the far end gives the place away
    for i, j in lookalikes(path, np.array([0, BAY, 0]), np.arange(180)):
        a, b, other = (dataset[k].image[nearer].ravel() for k in (i, j, j - 20))
        assert np.corrcoef(a, b)[0, 1] > 0.7
        assert np.corrcoef(a, other)[0, 1] < 0.6


def test_every_pixel_of_a_walk_has_a_surface_with_a_name_and_the_laps_see_most_of_what_is_there():
    for walk in WALKS:
        dataset = apartment(walk)
        for frame in (dataset[i] for i in range(5, len(dataset), 90)):
            assert frame.image.shape == (60, 80, 3) and frame.image.dtype == np.uint8 and frame.labels.dtype == np.int32
            assert np.isfinite(frame.depth).all() and frame.depth.min() > 0.35
            assert frame.labels.min() >= 0 and frame.labels.max() < len(dataset.classes)
            assert len(np.unique(frame.image.reshape(-1, 3), axis=0)) > 200, frame.name
    dataset = apartment()
    seen = {dataset.classes[label] for i in range(0, 300, 20) for label in np.unique(dataset[i].labels)}
    assert seen >= {"wall", "floor", "ceiling", "door", "table", "chair", "shelf", "lamp", "picture", "box", "plant"}


def test_a_frame_depends_on_seed_walk_and_number_only_and_all_walks_go_through_the_same_apartment():
    first, again, other = apartment(), Apartment(0, size=(80, 60)), apartment(seed=1)
    frames = [first[i] for i in (2, 90)]
    for a, b in zip(frames, [again[90], again[2]][::-1], strict=True):  # in the other order
        for name in ("image", "depth", "labels", "T_world_camera"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert np.abs(first[2].depth - other[2].depth).max() > 0.1
    elsewhere = apartment("corridor")
    for (name, mesh), (other_name, same) in zip(first.parts, elsewhere.parts, strict=True):
        assert name == other_name
        np.testing.assert_array_equal(mesh.vertices, same.vertices)
    assert first.fingerprint() == again.fingerprint() not in (other.fingerprint(), elsewhere.fingerprint())
    assert first.sequence != elsewhere.sequence


def test_fewer_frames_and_a_stride_go_the_same_way():
    few, part = Apartment(walk="corridor", num_frames=3), Apartment(walk="corridor", stride=140)
    path = poses("corridor")
    assert len(few) == 3
    np.testing.assert_allclose([few.pose(0), few.pose(2)], path[[0, -1]], atol=1e-9)
    np.testing.assert_array_equal([part.pose(index) for index in range(len(part))], path[::140])
