"""What stands where earlier frames looked through moves; what does not, or is only wrong, does not."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scene import device, on_host, pose, replace

from emgs_jax.motion import Looks, find_movers, look_again, look_back, no_looks
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.camera import Camera
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.slam import as_seen

CAMERA = Camera([40.0, 44.0], [31.5, 23.5], 64, 48)
WALL, NUM_LOOKS = np.full((48, 64), 3.0), 12
ROWS, COLUMNS = np.indices((48, 64))
BLOCK = (abs(ROWS - 24) < 12) & (abs(COLUMNS - 30) < 9)
NOTHING = np.zeros((48, 64), bool)
moved, told, looked = (on_host(f) for f in (find_movers, look_back, look_again))


@pytest.fixture(scope="module")
def settings(config):
    return config(f"slam.motion.num_looks={NUM_LOOKS}").motion


def seen(depth, valid=True) -> Observation:
    """A depth image (h, w) in its own camera."""
    depth = np.asarray(depth, float)
    rays = np.stack([(COLUMNS - 31.5) / 40, (ROWS - 23.5) / 44, np.ones_like(depth)], axis=-1)
    rows, count = (rays * depth[..., None]).reshape(-1, 3), depth.size
    o = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 0)), np.ones(count)
    return Observation(*map(device, (rows, *o)), device(np.broadcast_to(valid, depth.shape).reshape(-1)))


def with_block(depth=2.0, where=BLOCK, wall=WALL):
    return np.where(where, depth, wall)


def estimated(noise=0.02, std=0.0):
    return replace(exact_estimate(), depth_noise=device(noise), covariance=device(std**2 * np.eye(7)))


def after(views, settings, masks=(), poses=(), **errors) -> Looks:
    """Looks at depth images, oldest first, with what was taken for moving in them, from poses in the world.

    Without `errors` later frames say nothing of the earlier ones.
    """
    looks, last, estimate = no_looks(seen(WALL), settings), pose(), estimated(**(errors or {"noise": 0.0}))
    for number, depth in enumerate(views):
        T = poses[number] if len(poses) else pose()
        mask = device((masks[number] if len(masks) else NOTHING).reshape(-1))
        view, time = transform(T, seen(depth), device(1.0)), device(np.int32(number))
        looks = look_back(looks, view, mask, T, last, estimate, CAMERA, settings)
        looks, last = look_again(looks, view, mask, T, time, CAMERA), T
    return looks


def found(looks, depth, settings, noise=0.02, std=0.0, T_previous_camera=None) -> np.ndarray:
    """Image of what moves in a depth image."""
    estimate = estimated(noise, std)
    T = pose() if T_previous_camera is None else T_previous_camera
    return moved(looks, seen(depth), T, estimate, CAMERA, settings).reshape(48, 64)


def walking(count):
    """A block that goes right by 3 pixels a frame."""
    return [with_block(where=np.roll(BLOCK, 3 * step - 20, axis=1)) for step in range(count)]


HERE = with_block()
DRIFTED = [WALL * 1.03**-step for step in range(13)]  # as depths of a network
CASES = {
    "nothing new": ([WALL] * 5, WALL, {}, NOTHING),
    "a block where a wall was seen": ([WALL] * 5, HERE, {}, BLOCK),
    "one that walks": (walking(6), walking(7)[6], {}, np.roll(BLOCK, -2, axis=1) & (COLUMNS > 27)),
    "one that has stood all the time": ([HERE] * NUM_LOOKS, HERE, {}, NOTHING),
    "one that has stood for longer": ([WALL] * 4 + [HERE] * 8, HERE, {}, NOTHING),
    "one that was told from the first on": (
        [WALL] * 4 + [HERE] * 8,
        HERE,
        {"masks": [NOTHING] * 4 + [BLOCK] * 8},
        BLOCK,
    ),
    "what hid the place before says nothing": ([with_block(1.0)] * 5 + [WALL] * 2, HERE, {}, BLOCK),
    "and was seen through twice only": ([WALL] * 2 + [HERE] * 8, HERE, {"masks": [NOTHING] * 2 + [BLOCK] * 8}, BLOCK),
    "and has stood for all looks": ([HERE] * NUM_LOOKS, HERE, {"masks": [BLOCK] * NUM_LOOKS}, NOTHING),
    "one that is gone": ([HERE] * 5, WALL, {}, NOTHING),
    "a wrong prediction: a line": ([WALL] * 5, with_block(where=COLUMNS == 30), {}, NOTHING),
    "a wrong prediction: pixels": ([WALL] * 5, with_block(where=(COLUMNS % 4 + ROWS % 4) == 0), {}, NOTHING),
    "nearer in each frame: a drift": (DRIFTED[:12], DRIFTED[12], {}, NOTHING),
    "a block before it": (DRIFTED[:12], with_block(1.2, wall=DRIFTED[12]), {}, BLOCK),
    "nearer by what depths err": ([WALL] * 5, with_block(2.9), {}, NOTHING),
    "a pose that is not known": ([WALL] * 5, HERE, {"std": 0.5}, NOTHING),
    "nearer by what a turn of two degrees errs": ([WALL] * 5, with_block(2.8), {"std": 0.03}, NOTHING),
    "a noise that is not known": ([WALL] * 5, HERE, {"noise": 0.0}, NOTHING),
    "one look only": ([WALL], HERE, {}, NOTHING),
    "no look": ([], HERE, {}, NOTHING),
    "what fills the view": ([WALL] * 5, np.full((48, 64), 1.0), {}, ~NOTHING),
    "what is beside all looks, whose corner is far": (
        [np.where(ROWS + COLUMNS < 9, 10.0, WALL)] * 5,
        WALL,
        {"T_previous_camera": pose([0.0, 1.5, 0.0])},
        NOTHING,
    ),
    "a place that no look shows": ([np.where(BLOCK, 0.0, WALL)] * 5, HERE, {}, NOTHING),
}


@pytest.mark.parametrize("case", CASES)
def test_free_space_decides_what_moves(case, settings):
    views, now, more, expected = CASES[case]
    looks = after(views, settings, more.get("masks", ()))
    if case == "a place that no look shows":
        looks = eqx.tree_at(lambda k: k.depth, looks, np.where(np.asarray(looks.depth) < 0.5, 0.0, looks.depth))
    said = found(looks, now, settings, **{key: value for key, value in more.items() if key != "masks"})
    assert_alike(said, expected)


def assert_alike(said, expected):
    kernel = np.lib.stride_tricks.sliding_window_view(np.pad(expected, 2, mode="edge"), (5, 5))
    is_sure = kernel.all((2, 3)) | ~kernel.any((2, 3))  # the outline may be either
    np.testing.assert_array_equal(said[is_sure], expected[is_sure])


def one_of(looks, row) -> Looks:
    return jax.tree.map(lambda leaf: leaf[row], looks)


LATER = {  # depth images, in the first of which pixels have moved as the others show
    "nothing": ([WALL] * 6, {}, NOTHING),
    "a block that leaves": ([HERE] * 3 + [WALL] * 8, {}, BLOCK),
    "one that walks on": (walking(10), {}, np.roll(BLOCK, -20, axis=1)),
    "one that stands to the end": ([HERE] * 6, {}, NOTHING),
    "one that comes": ([WALL] * 3 + [HERE] * 6, {}, NOTHING),
    "a wrong prediction: a block that one frame does not show": ([HERE] * 2 + [WALL] + [HERE] * 4, {}, NOTHING),
    "a block that is hidden": ([HERE] * 2 + [with_block(1.0)] * 8, {}, NOTHING),
    "one that had moved by the looks before it": ([HERE] * 6, {"masks": [BLOCK] + [NOTHING] * 5}, BLOCK),
    "one that others take for moving where it stands": (
        [HERE] * 4 + [WALL] * 2,
        {"masks": [NOTHING] + [BLOCK] * 3 + [NOTHING] * 2},
        BLOCK,
    ),
    "as little as one look": ([HERE, WALL], {}, NOTHING),
    "farther in each frame: a drift": ([WALL * 1.03**step for step in range(12)], {}, NOTHING),
    "a drift that wavers": ([WALL * 1.03**step for step in (0, 2, 0, 4, 2, 6, 4, 8, 6, 10, 8, 12)], {}, NOTHING),
    "a noise that is not known": ([HERE] * 3 + [WALL] * 8, {"noise": 0.0}, NOTHING),
    "a pose that is not known": ([HERE] * 3 + [WALL] * 8, {"std": 0.5}, NOTHING),
}


@pytest.mark.parametrize("case", LATER)
def test_later_frames_decide_what_has_moved(case, settings):
    views, more, expected = LATER[case]
    looks = after(
        views, settings, more.get("masks", ()), **({"noise": 0.02} | {k: v for k, v in more.items() if k != "masks"})
    )
    first = len(views) - 1
    assert_alike(np.asarray(looks.moving[first]).reshape(48, 64), expected)
    assert looks.time[first] == 0 and looks.time[0] == first
    told_before = np.asarray(looks.said[first]).reshape(48, 64)
    seen_by_then = as_seen(one_of(looks, first), pose(), device(0.02))
    assert_alike(np.asarray(seen_by_then.moves).reshape(48, 64), expected & ~told_before)


def test_a_look_is_told_where_it_was_seen_from_and_what_has_moved_in_it_supports_nothing_there(settings):
    """A wall is crossed by a camera that goes; what left in the first look does not say that a block stands there."""
    poses = [pose((0.0, 0.01 * step, 0.0), (0.02 * step, 0.0, 0.0)) for step in range(6)]
    looks = after([WALL] * 6, settings, (), poses, noise=0.02)
    for row in range(6):
        seen_then = as_seen(one_of(looks, row), poses[-1], device(0.02))
        expected = poses[5 - row].as_matrix()
        np.testing.assert_allclose(seen_then.T_world_camera.as_matrix(), expected, atol=1e-5)
        assert seen_then.time == 5 - row and seen_then.depth.shape == (2, 48 * 64)
    stood = [HERE] * 3 + [WALL] * 5
    alone = found(after(stood, settings), HERE, settings)
    informed = found(after(stood, settings, noise=0.02), HERE, settings)
    assert not alone[BLOCK].all() or informed[BLOCK].all()
    inner = BLOCK & np.roll(BLOCK, 3, 0) & np.roll(BLOCK, -3, 0) & np.roll(BLOCK, 3, 1) & np.roll(BLOCK, -3, 1)
    assert informed[inner].all()


def test_a_camera_that_turns_and_a_map_that_moves_change_nothing_and_an_untracked_frame_is_no_look(settings):
    """Looks are kept relative to the last camera: in another world the same poses give the same."""
    poses = [pose([0.0, 0.02 * step, 0.0], [0.05 * step, 0.0, 0.0]) for step in range(6)]
    world = pose([0.4, -1.0, 0.2], [3.0, -2.0, 1.0])

    def wall_from(T, block):  # the plane z = 3 of the world, and a block at z = 2
        rays = np.stack([(COLUMNS - 31.5) / 40, (ROWS - 23.5) / 44, np.ones((48, 64))], axis=-1)
        R, t = np.asarray(T.rotation().as_matrix(), float), np.asarray(T.translation(), float)
        direction = rays @ R.T
        depths = [(z - t[2]) / direction[..., 2] for z in (3.0, 2.0)]
        at = t + depths[1][..., None] * direction
        return np.where(block & (abs(at[..., :2] - [0.1, 0.0]) < 0.4).all(-1), *depths[::-1])

    views = [wall_from(T, block=False) for T in poses[:-1]]
    now = wall_from(poses[-1], block=True)
    said = found(
        after(views, settings, (), poses[:-1]), now, settings, T_previous_camera=poses[-2].inverse() @ poses[-1]
    )
    is_block = now < 2.5
    assert said[is_block].mean() > 0.8 and said[~is_block].mean() < 0.02
    elsewhere = after(views, settings, (), [world @ T for T in poses[:-1]])
    again = found(elsewhere, now, settings, T_previous_camera=poses[-2].inverse() @ poses[-1])
    assert (again != said).mean() < 0.01
    looks = after([WALL] * 3, settings)
    lost = replace(seen(HERE), valid=device(np.zeros(48 * 64, bool)))
    nothing = device(NOTHING.reshape(-1))
    skipped = told(looks, lost, nothing, poses[3], pose(), estimated(), CAMERA, settings)
    np.testing.assert_array_equal(skipped.log_odds, looks.log_odds)
    skipped = looked(skipped, lost, nothing, poses[3], device(np.int32(3)), CAMERA)
    np.testing.assert_array_equal(skipped.depth, looks.depth)
    right = replace(seen(HERE), valid=device((COLUMNS > 9).reshape(-1)))
    depth = looked(looks, right, nothing, pose(), device(np.int32(3)), CAMERA).depth
    assert np.isfinite(depth).all() and not depth[0][:, (COLUMNS <= 9).ravel()].any()
    np.testing.assert_allclose(skipped.T_previous_look.wxyz_xyz[0], poses[3].inverse().wxyz_xyz, atol=1e-6)


def test_as_printed_nothing_is_looked_for(config):
    assert no_looks(seen(WALL), config("slam/motion=paper").motion) is None
