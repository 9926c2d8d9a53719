"""Where views are, from points whose projections are known."""

import numpy as np
import pytest
from stereo_scene import (
    arc,
    calibration,
    cloud,
    matrix,
    placed_structure,
    projected,
    structure_config,
    structure_of,
    views_of,
    whose,
)

from emgs_jax.prior.multiview.landmarks import NONE, forget, link
from emgs_jax.prior.multiview.memory import Memory
from emgs_jax.prior.multiview.placement import place, refind, relative_pose, turn

NUM_POINTS = 60
CONFIG = structure_config().matching


def test_a_view_is_placed_where_it_is_despite_wrong_landmarks_and_with_too_few_it_is_not():
    poses, points, seen_by = arc(4), cloud(NUM_POINTS), np.ones((4, NUM_POINTS), bool)
    for count in (NUM_POINTS, CONFIG.min_matches - 1):
        seen_by[3, count:] = False
        structure = placed_structure(poses, points, seen_by)
        structure.points, view = points.copy(), structure.views[3]
        view.T_ref_view = None
        view.pixels[:15] += (15.0, -9.0) if count == NUM_POINTS else 0.0
        assert place(structure, view, CONFIG) == (count == NUM_POINTS)
        if count == NUM_POINTS:
            np.testing.assert_allclose(view.T_ref_view, poses[3], atol=1e-5)
    assert view.T_ref_view is None


def test_the_relative_pose_is_the_true_one_up_to_the_length_of_the_baseline():
    poses = arc(3)
    structure = placed_structure(poses, cloud(NUM_POINTS), np.ones((3, NUM_POINTS), bool))
    near, far = (relative_pose(structure.views[0], structure.views[b], calibration(), CONFIG) for b in (1, 2))
    expected = np.linalg.inv(poses[0]) @ poses[2]
    expected[:3, 3] /= np.linalg.norm(expected[:3, 3])
    np.testing.assert_allclose(far[0], expected, atol=1e-4)
    assert far[1] == near[1] == NUM_POINTS
    assert far[2] > 1.5 * near[2]  # twice the parallax
    with pytest.raises(Exception, match="at least 6"):  # fewer matches than a pose needs
        structure_config("prior.structure.matching.min_matches=5")


def after_a_loss(num_known=NUM_POINTS):
    """A structure whose placed views were forgotten with `num_known` landmarks, and the true poses."""
    poses, points = arc(4), cloud(NUM_POINTS)
    structure = structure_of(views_of(points, poses))
    for frame in (0, 1):
        view = structure.views[frame]
        order = whose(view, structure.views[0])
        view.landmark, view.T_ref_view = np.where(order < num_known, order, NONE), poses[frame]
    # Landmark i is keypoint i of view 0.
    seen = projected(poses[0], points)
    structure.points = points[np.linalg.norm(seen - structure.views[0].pixels[:, None], axis=2).argmin(axis=1)]
    forget(structure, [0, 1], CONFIG)
    return structure, poses


def test_a_view_after_a_loss_is_placed_by_what_was_left_behind_and_shows_it_again():
    """Symptom: on a walk of 187 frames the first 68 were mapped, the last 119 lost."""
    structure, poses = after_a_loss()
    view = structure.views[2]
    assert not structure.placed() and len(structure.memory.points) == NUM_POINTS
    assert not place(structure, view, CONFIG) and refind(structure, view, CONFIG)
    np.testing.assert_allclose(view.T_ref_view, poses[2], atol=1e-4)
    known = structure.known(view)
    assert known.sum() + len(structure.memory.points) == NUM_POINTS and known.mean() > 0.9
    shown = projected(poses[2], structure.points[view.landmark[known]])
    np.testing.assert_allclose(shown, view.pixels[known], atol=1e-3)


def test_tracks_of_other_lost_views_get_the_points_that_one_finds_again():
    structure, poses = after_a_loss()
    link(structure, 3, CONFIG)  # views 2 and 3 see each other, without a position
    assert not place(structure, structure.views[3], CONFIG)
    assert refind(structure, structure.views[2], CONFIG) and place(structure, structure.views[3], CONFIG)
    np.testing.assert_allclose(structure.views[3].T_ref_view, poses[3], atol=1e-3)


def test_an_unknown_place_or_too_few_landmarks_place_nothing():
    for num_known in (CONFIG.min_refound - 1, NUM_POINTS):
        structure, _ = after_a_loss(num_known)
        view = structure.views[2]
        if num_known == NUM_POINTS:  # looks alike, lies elsewhere
            view.pixels[:] = np.random.default_rng(0).permutation(view.pixels)
        before = view.landmark.copy()
        assert not refind(structure, view, CONFIG) and view.T_ref_view is None
        np.testing.assert_array_equal(view.landmark, before)


@pytest.mark.parametrize("scale", [1.0, 1.2])
def test_beside_others_what_was_left_behind_tells_only_how_far_the_points_are(scale):
    """Symptom: after a walk through a flat a view was placed where it stood at first, 5 degrees from its neighbours."""
    structure, poses = after_a_loss()
    link(structure, 3, CONFIG)
    drift = matrix((0.05, 0.1, -0.03), (0.2, -0.1, 0.3))
    moved = scale * structure.memory.points @ drift[:3, :3].T + drift[:3, 3]
    structure.memory = Memory(moved, structure.memory.descriptors)
    view, other = structure.views[2], structure.views[3]
    other.T_ref_view = poses[3]
    assert refind(structure, view, CONFIG) and view.is_held
    expected = np.linalg.inv(poses[3]) @ poses[2]
    expected[:3, 3] *= scale
    np.testing.assert_allclose(np.linalg.inv(poses[3]) @ view.T_ref_view, expected, atol=2e-3)
    rows = structure.known(view)
    np.testing.assert_allclose(
        projected(view.T_ref_view, structure.points[view.landmark[rows]]), view.pixels[rows], atol=1e-2
    )


def test_a_view_whose_distance_from_its_neighbours_is_unknown_is_not_placed():
    """They show other points than those that it finds again."""
    structure, poses = after_a_loss()
    link(structure, 3, CONFIG)
    view, other = structure.views[2], structure.views[3]
    other.T_ref_view = poses[3]
    known = np.arange(len(view.landmark)) < CONFIG.min_refound + 2
    other.landmark[np.isin(other.landmark, view.landmark[known])] = NONE
    is_kept = np.isin(
        np.arange(NUM_POINTS), np.argmax(structure.memory.descriptors @ view.descriptors[known].T, axis=0)
    )
    structure.memory = Memory(structure.memory.points[is_kept], structure.memory.descriptors[is_kept])
    assert relative_pose(other, view, structure.K, CONFIG) is not None
    assert not refind(structure, view, CONFIG) and view.T_ref_view is None
    other.T_ref_view = None  # without them it is where the points are
    assert refind(structure, view, CONFIG) and not view.is_held


@pytest.mark.parametrize(("step", "is_turn"), [(0.0, True), (0.3, False)])
def test_a_camera_that_only_turned_stands_where_it_stood(step, is_turn):
    """Tracks without depth tell its rotation; of one that moved they do not."""
    start, end = np.eye(4), matrix((0.1, 0.4, 0.02), (step, 0.0, 0.0))
    points = cloud(NUM_POINTS)
    structure = placed_structure(np.stack([start, end]), points, np.ones((2, NUM_POINTS), bool))
    first, view = structure.views.values()
    structure.points[: CONFIG.min_matches] = points[: CONFIG.min_matches]
    view.landmark[: CONFIG.min_matches] = NONE  # what has depth is out of sight
    view.pixels[-8:] += 20.0  # wrong matches
    view.T_ref_view = None
    assert not place(structure, view, CONFIG) and turn(structure, view, CONFIG) == is_turn
    if is_turn:
        np.testing.assert_allclose(view.T_ref_view, end, atol=1e-6)
        view.T_ref_view = None
    structure.points[0] = np.nan  # too few landmarks hold the other view now
    assert view.is_held == is_turn and not turn(structure, view, CONFIG)
