"""A camera among keyframes that know their place; the scene's truth is the oracle."""

import dataclasses

import numpy as np
import pytest
from loop_scene import keyframe, loops_config, matrix, place_recognition_config, room, verification_config

from emgs_jax.loop_closure.place_recognition import Database, add_keyframe
from emgs_jax.loop_closure.relocalization import AMBIGUOUS, NO_CANDIDATE, PosedKeyframes, relocalize
from emgs_jax.loop_closure.two_view_alignment import Gate

TRUE = matrix((0, 4, 0), (0.25, 0.05, 0.1))
HERE = [matrix((0, 2 * side, 0), (side, 0, 0)) for side in (-0.2, 0.0, 0.2)]
SIX_METRES = matrix(translation=(6, 0, 0))
SCALE = 1.05  # a length of the query's inference is so many of the others'
COUNT = 110  # numbers that a keyframe may have
APPEARANCE = place_recognition_config("num_words=8", "suppressed_gap=5")
QUERY = keyframe(room(), TRUE, 99, 1 / SCALE)


def places(*shifts: np.ndarray, cameras=HERE, is_placed=lambda frame: True) -> PosedKeyframes:
    """Keyframes of the room, once from 0 and once from 100 on, and how far from the truth they are said to be."""
    database, poses = Database(), [np.eye(4)] * COUNT
    for first, shift in zip((0, 100), shifts, strict=False):
        for frame, T in enumerate(cameras, start=first):
            database = add_keyframe(database, keyframe(room(), T, frame), APPEARANCE)
            poses[frame] = shift @ T
    return PosedKeyframes(database, poses, [0.0] * COUNT, [is_placed(frame) for frame in range(COUNT)])


def located(found: PosedKeyframes, one=QUERY, **changes):
    config = dataclasses.replace(loops_config()["relocalization"], **changes)
    return relocalize(one, found, APPEARANCE, verification_config(), config)


@pytest.fixture(scope="module")
def here():
    return places(np.eye(4))


def test_the_camera_is_where_it_is_in_the_unit_of_its_inference_and_of_the_map(here):
    location, refused_by = located(here)
    assert refused_by is None and location.keyframe in (0, 1, 2)
    np.testing.assert_allclose(location.T_world_camera, TRUE, atol=2e-3)  # points are float32, residuals 0
    assert location.log_scale == pytest.approx(np.log(SCALE), abs=2e-3)
    assert np.linalg.eigvalsh(location.covariance).min() > 0
    twice = np.array([[1, 1, 1, 2]] * 3 + [[1, 1, 1, 1]])
    large = dataclasses.replace(here, poses=[twice * pose for pose in here.poses], log_scales=[np.log(2)] * COUNT)
    other = located(large)[0]
    np.testing.assert_allclose(other.T_world_camera[:3, 3], 2 * location.T_world_camera[:3, 3], atol=1e-9)
    assert other.log_scale == pytest.approx(location.log_scale + np.log(2))
    factor = np.diag([2.0] * 3 + [1.0] * 4)
    np.testing.assert_allclose(other.covariance, factor @ location.covariance @ factor, rtol=1e-9)


def test_of_two_places_that_look_alike_it_is_in_neither_and_two_visits_of_one_are_one():
    assert located(places(np.eye(4), SIX_METRES)) == (None, AMBIGUOUS)
    assert located(places(np.eye(4), np.eye(4)))[1] is None
    # Where the run thought it was when it was lost.
    assert located(places(np.eye(4), SIX_METRES, is_placed=lambda frame: frame < 100))[0].keyframe < 100


def test_what_is_not_confirmed_is_refused_by_its_gate(here):
    assert located(places(np.eye(4), is_placed=lambda frame: False)) == (None, NO_CANDIDATE)
    assert located(places(np.eye(4), cameras=HERE[:1])) == (None, Gate.NEIGHBOURS)
    assert located(here, min_inliers=1000) == (None, Gate.MATCHES)
    # All descriptors are others, so what matches does by chance.
    others = np.random.default_rng(0).permuted(QUERY.descriptors, axis=1)
    assert located(here, dataclasses.replace(QUERY, descriptors=others)) == (None, Gate.MATCHES)
