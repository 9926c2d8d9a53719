"""Movers of the built-in scenes: exact truth, and nothing else of the scene changes."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from emgs_jax.data.apartment import Apartment
from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import ELSEWHERE, MOVES, STAYS
from emgs_jax.data.movers import Doorway, Lane, build_movers
from emgs_jax.data.synthetic import Synthetic

pytestmark = pytest.mark.slow

SCENES = {"room": (Synthetic, {}), "flat": (Apartment, {"num_frames": 60}), "hall": (Apartment, {"walk": "corridor"})}


@cache
def scene(name: str, movers: int = 3, **more):
    make, options = SCENES[name]
    return make(seed=2, size=(80, 60), movers=movers, **options, **more)


@pytest.mark.parametrize("name", SCENES)
def test_a_pixel_is_the_static_scene_s_or_lies_on_the_thing_that_is_said_to_be_there(name):
    """Movers stand before the scene: the rest of each image stays to the bit. A thing's colours go with it."""
    moving, static, seen = scene(name), scene(name, 0), {}
    for index in np.linspace(0, len(moving) - 2, 4).astype(int).repeat(2) + np.tile([0, 1], 4):
        frame, empty = moving[int(index)], static[int(index)]
        assert empty.moving is None and empty.static_depth is empty.depth
        points = backproject(frame.depth, moving.intrinsics) @ frame.T_world_camera[:3, :3].T
        points += frame.T_world_camera[:3, 3]
        is_static = np.ones(frame.depth.shape, bool)
        for number, mover in enumerate(moving._movers):
            own = (points - mover.poses[index][:3, 3]) @ mover.poses[index][:3, :3]
            gaps = cKDTree(mover.part[1].sample(20000, seed=0)).query(own.reshape(-1, 3))[0]
            is_its = (frame.depth < empty.depth) & (gaps.reshape(is_static.shape) < 0.05)
            is_static &= ~is_its
            assert (frame.moving[is_its] == mover.states[index]).mean() > 0.9 if is_its.sum() > 9 else True
            seen.setdefault(number, []).append((own[is_its], frame.image[is_its].astype(float)))
        np.testing.assert_array_equal(frame.depth[is_static], empty.depth[is_static])
        np.testing.assert_array_equal(frame.image[is_static], empty.image[is_static])
        assert (frame.moving[is_static] == STAYS).all() and (frame.depth <= empty.depth).all()
        assert (frame.static_depth == np.where(frame.moving == STAYS, frame.depth, 0)).all()
    pairs = list(zip(seen[0][::2], seen[0][1::2], strict=True))
    (a, colors), (b, others) = max(pairs, key=lambda pair: len(pair[0][0]))
    gap, nearest = cKDTree(b).query(a)
    assert (gap < 0.03).sum() > 30
    assert np.corrcoef(colors[gap < 0.03].ravel(), others[nearest[gap < 0.03]].ravel())[0, 1] > 0.9


@pytest.mark.parametrize(("name", "movers", "low", "high"), [("room", 1, 0.05, 0.2), ("room", 5, 0.1, 0.3)])
def test_people_cover_a_share_of_the_image_and_each_frame_depends_on_its_place_only(name, movers, low, high):
    whole = scene(name, movers)
    assert low < np.mean([(frame.moving == MOVES).mean() for frame in whole]) < high
    part = scene(name, movers, start=4, stop=20, stride=5)
    np.testing.assert_array_equal(part[1].image, whole[9].image)
    assert len({scene(name, count).fingerprint() for count in range(4)}) == 4
    # of version 1, with which predictions were recorded
    np.testing.assert_allclose(whole._movers[0].poses[7, :2, 3], [-0.26804518, 0.88632802], atol=1e-8)


def test_a_person_walks_a_chair_is_moved_once_and_a_door_opens():
    lane = Lane(np.array([[0.0, 0], [9, 0]]), np.linspace(0, 9, 91), 2.0, 3.0, Doorway((6, -0.5), np.pi / 2, 1), 40)
    person, chair, door, other = build_movers(4, lane, np.random.default_rng(0))
    steps = np.linalg.norm(np.diff(person.poses[:, :2, 3], axis=0), axis=1)
    assert 0.1 < steps.mean() < 0.25 and (person.states == MOVES).all()
    ahead = person.poses[:, 0, 3] - lane.walked
    assert ahead.min() > 0.9 and ahead.max() < 3.1 and np.ptp(ahead) > 1.8
    np.testing.assert_allclose(other.poses[:, 1, 3], 0.45)
    assert chair.states.tolist() == [ELSEWHERE] * 46 + [STAYS] * 45
    assert len(np.unique(chair.poses[:, 0, 3])) == 2 and np.ptp(chair.poses[:, 0, 3]) == pytest.approx(0.8)
    changes = np.flatnonzero(np.diff(door.states.astype(int)))
    assert door.states[[0, 45, -1]].tolist() == [ELSEWHERE, MOVES, STAYS] and len(changes) == 2
    tip = door.poses @ [1.0, 0, 0, 1]
    np.testing.assert_allclose(tip[0, :2], [6, 0.5], atol=1e-12)
    assert np.linalg.norm(tip[0] - tip[-1]) == pytest.approx(2 * np.sin(np.radians(50)))
