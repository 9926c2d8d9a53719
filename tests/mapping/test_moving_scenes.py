"""Runs before things that move: no pose is wrong, nothing of them stays in the map, and what hides it is said."""

from functools import cache

import numpy as np
import pytest
from tiny_run import compose, map_tiny

from emgs_jax.config.configure import build
from emgs_jax.data import furniture
from emgs_jax.data.base import MOVES
from emgs_jax.data.looks import draw_looks
from emgs_jax.data.movers import Mover
from emgs_jax.data.raycast import RayCast, Scene
from emgs_jax.data.synthetic import build_room, camera_path
from emgs_jax.gaussian_map import confirmed
from emgs_jax.mapping.records import HIDDEN
from emgs_jax.runs.moving import moving_mask

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]

NUM_FRAMES, HIDING = 20, range(8, 11)


class Stage(RayCast):
    """The room before a camera that stands, and a board (w, h) that stands at `places` in its view."""

    name, classes, version = "stage", furniture.CLASSES, 1

    def __init__(self, size, places) -> None:
        rng = np.random.default_rng(3)
        parts, room_size = build_room(rng)
        poses = np.repeat(camera_path(40, room_size, rng)[:1], NUM_FRAMES, axis=0)
        T_camera_board = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
        T_camera_board[:, :3, 3] = places
        (board,) = furniture.join("box", furniture.box((*size, 0.1), (0, 0, 0)))
        mover = Mover(board, poses @ T_camera_board, np.full(NUM_FRAMES, MOVES, np.uint8))
        scene = Scene(parts, draw_looks(parts, rng))
        super().__init__(size=(64, 48))
        self._show("stage", scene, poses, [mover])


AWAY = np.array([0.0, 0.0, -5.0])  # behind the camera
TIME = np.arange(NUM_FRAMES)[:, None]
CASES = {
    "walks by": ((0.5, 1.6), np.array([-2.0, 0, 1.3]) + TIME * [0.22, 0, 0]),
    "fills the view": ((4.0, 3.0), np.where((HIDING[0] <= TIME) & (HIDING[-1] >= TIME), [0, 0, 0.6], AWAY)),
    "is there at first": ((0.6, 1.6), np.where(TIME < 5, [0.3, 0, 1.2], AWAY)),
}


@cache
def stage(case):
    return Stage(*CASES[case])


@pytest.mark.parametrize("case", CASES)
def test_a_camera_that_stands_stays_where_it_is_and_maps_nothing_that_moves(case):
    frames = stage(case)
    prior = build(compose("prior.level=0.5"), "prior", classes=list(frames.classes))
    run, _ = map_tiny(frames, prior, "slam/motion=default", "slam.motion.num_looks=8")
    assert run.state.looks is None, "what the last frames saw is judged at the end"
    moves = np.array([(frame.moving == MOVES).mean() for frame in frames])
    said = np.array([record.moving or 0.0 for record in run.records])
    truth = frames.pose(0)
    apart = [np.linalg.norm(record.pose[:3, 3] - truth[:3, 3]) for record in run.records]
    assert max(apart) < 0.06, apart  # m; the prior's own pose errs by 1 to 2 cm
    rows = [record.index for record in run.records if record.status == "degraded"]
    if case == "fills the view":
        assert rows == [*HIDING] and all(run.records[row].reason == HIDDEN for row in rows)
        assert (said[HIDING] > 0.8).all() and said[HIDING[-1] + 1 :].max() < 0.1
    else:
        assert not rows
    if case == "walks by":
        late = slice(8, None)
        assert said[late][moves[late] > 0.1].mean() > 0.5 * moves[late][moves[late] > 0.1].mean()
        for shift, is_own in ((0, True), (1, False)):  # what is found later is written into its own frame's record
            right = [
                (frames[row + shift].moving == MOVES)[moving_mask(vars(run.records[row]), (64, 48))].mean()
                for row in range(NUM_FRAMES - 1)
                if said[row] > 0.05
            ]
            assert len(right) > 5 and (np.mean(right) > 0.8) == is_own, (shift, right)
    gaussians = confirmed(run.map)
    local = (np.asarray(gaussians.means) - truth[:3, 3]) @ truth[:3, :3]
    ahead = local[np.asarray(gaussians.valid)]
    nearest = frames[NUM_FRAMES - 1].static_depth
    pixels = np.rint(ahead[:, :2] / ahead[:, 2:] * frames.intrinsics[:2] + frames.intrinsics[2:]).astype(int)
    inside = (ahead[:, 2] > 0.1) & (pixels >= 0).all(1) & (pixels < frames.size).all(1)
    seen = nearest[pixels[inside, 1], pixels[inside, 0]]
    floats = (seen > 0) & (ahead[inside, 2] < 0.7 * seen)
    assert floats.mean() < 0.02
