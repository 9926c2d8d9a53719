"""A camera among keyframes that know their place; the scene's truth is the oracle."""

import dataclasses

import numpy as np
import pytest
from loop_scene import appearance_config, keyframe, loops_config, matrix, room, verification_config

from emgs_jax.loops.alignment import Gate
from emgs_jax.loops.appearance import Database, Keyframe, extend
from emgs_jax.loops.location import AMBIGUOUS, NO_CANDIDATE, Places, locate

TRUE = matrix((0, 4, 0), (0.25, 0.05, 0.1))
HERE = [matrix((0, 2 * side, 0), (side, 0, 0)) for side in (-0.2, 0.0, 0.2)]
SCALE = 1.05  # a length of the query's inference is so many of the others'
COUNT = 110  # numbers that a keyframe may have
APPEARANCE = appearance_config("num_words=8", "suppressed_gap=5")


def places(*groups: tuple[int, list, np.ndarray], is_placed=lambda frame: True) -> Places:
    """Keyframes of the room: for each group the first number, where its cameras are, and where they are said to be."""
    database, poses = Database(), [np.eye(4)] * COUNT
    for first, cameras, shift in groups:
        for frame, T in enumerate(cameras, start=first):
            database = extend(database, keyframe(room(), T, frame), APPEARANCE)
            poses[frame] = shift @ T
    return Places(database, poses, [0.0] * COUNT, [is_placed(frame) for frame in range(COUNT)])


def query(points: np.ndarray | None = None, scale: float = SCALE) -> Keyframe:
    return keyframe(room() if points is None else points, TRUE, 99, 1 / scale)


def located(found: Places, one: Keyframe | None = None, **changes):
    config = dataclasses.replace(loops_config()["location"], **changes)
    return locate(query() if one is None else one, found, APPEARANCE, verification_config(), config)


def test_the_camera_is_where_it_is_with_the_unit_of_its_inference():
    location, refused_by = located(places((0, HERE, np.eye(4))))
    assert refused_by is None and location.by in (0, 1, 2)
    np.testing.assert_allclose(location.T_world_camera, TRUE, atol=2e-3)  # points are float32, residuals 0
    assert location.log_scale == pytest.approx(np.log(SCALE), abs=2e-3)
    assert np.linalg.eigvalsh(location.covariance).min() > 0


def test_a_map_that_is_twice_as_large_has_the_camera_twice_as_far():
    small = places((0, HERE, np.eye(4)))
    twice = np.array([[1, 1, 1, 2]] * 3 + [[1, 1, 1, 1]])
    large = dataclasses.replace(small, poses=[twice * pose for pose in small.poses], log_scales=[np.log(2)] * COUNT)
    one, two = located(small)[0], located(large)[0]
    np.testing.assert_allclose(two.T_world_camera[:3, 3], 2 * one.T_world_camera[:3, 3], atol=1e-9)
    assert two.log_scale == pytest.approx(one.log_scale + np.log(2))
    factor = np.diag([2.0] * 3 + [1.0] * 4)
    np.testing.assert_allclose(two.covariance, factor @ one.covariance @ factor, rtol=1e-9)


def test_of_two_places_that_look_alike_it_is_in_neither():
    six_metres = matrix(translation=(6, 0, 0))
    assert located(places((0, HERE, np.eye(4)), (100, HERE, six_metres))) == (None, AMBIGUOUS)


def test_two_visits_of_one_place_are_one():
    assert located(places((0, HERE, np.eye(4)), (100, HERE, np.eye(4))))[1] is None


def test_a_place_that_no_keyframe_shows_is_refused():
    """All descriptors are others, so what matches does by chance."""
    elsewhere = query()
    rng = np.random.default_rng(0)
    elsewhere = dataclasses.replace(elsewhere, descriptors=rng.permuted(elsewhere.descriptors, axis=1))
    location, refused_by = located(places((0, HERE, np.eye(4))), elsewhere)
    assert location is None and refused_by == Gate.MATCHES


def test_a_keyframe_that_the_map_does_not_hold_is_not_asked():
    shown = places((0, HERE, np.eye(4)), is_placed=lambda frame: False)
    assert located(shown) == (None, NO_CANDIDATE)
    wrong = matrix(translation=(6, 0, 0))  # where the run thought it was when it was lost
    both = places((0, HERE, np.eye(4)), (100, HERE, wrong), is_placed=lambda frame: frame < 100)
    assert located(both)[0].by < 100


def test_what_the_neighbours_do_not_confirm_is_refused():
    assert located(places((0, HERE[:1], np.eye(4)))) == (None, Gate.NEIGHBOURS)


def test_few_points_are_not_enough():
    assert located(places((0, HERE, np.eye(4))), min_inliers=1000) == (None, Gate.MATCHES)
