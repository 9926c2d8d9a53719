"""Keypoints, matches and tracks from points whose projections are known."""

import numpy as np
import pytest
from stereo_scene import (
    arc,
    calibration,
    cloud,
    matrix,
    placed_structure,
    structure_config,
    structure_of,
    views_of,
    whose,
)

from emgs_jax.keypoints.sift import mutual
from emgs_jax.prior.multiview.landmarks import (
    NONE,
    View,
    confirmed,
    detect,
    forget,
    link,
    match,
    triangulate,
)
from emgs_jax.prior.multiview.memory import Memory, remember

NUM_POINTS = 60


CONFIG = structure_config().matching


@pytest.fixture
def views():
    return views_of(cloud(NUM_POINTS), arc(4))


def linked(views):
    structure = structure_of(views[:1])
    for frame, view in enumerate(views[1:], start=1):
        structure.views[frame] = view
        link(structure, frame, CONFIG)
    return structure


def tracks(structure):
    """For each landmark the (view, point) pairs that have it; points are numbered as view 0 has them."""
    first, found = structure.views[0], {}
    for frame, view in structure.views.items():
        for number, point in zip(view.landmark, whose(view, first), strict=True):
            if number != NONE:
                found.setdefault(int(number), []).append((frame, int(point)))
    return found


@pytest.mark.parametrize("magnification", [1, 2, 3])
def test_blobs_are_detected_at_their_centres_with_unit_descriptors_and_a_blank_image_has_none(views, magnification):
    """Pixel centres are at integers, and the product of descriptors is a cosine."""
    config = structure_config(f"prior.structure.matching.magnification={magnification}").matching
    y, x = np.mgrid[:48, :64]
    gray = np.zeros((48, 64))
    for u, v in ((20.0, 15.0), (40.25, 30.5)):
        gray += 200 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.5**2))
    found = detect(np.uint8(gray), config).pixels
    for center in ((20.0, 15.0), (40.25, 30.5)):
        assert np.linalg.norm(found - center, axis=1).min() < 0.06
    found = detect(np.uint8(np.random.default_rng(0).uniform(0, 255, (96, 128))), config)
    assert len(found.descriptors) > 5 and found.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, rtol=1e-5)
    blank = detect(np.full((48, 64), 128, np.uint8), config)
    assert blank.pixels.shape == (0, 2) and blank.descriptors.shape == (0, 128) and blank.landmark.shape == (0,)
    few = views_of(cloud(CONFIG.min_matches - 1), arc(2))
    for pair in ((blank, views[0]), (views[0], blank), few):
        assert not len(match(*pair, calibration(), CONFIG)[0])


def test_the_distinct_and_mutual_neighbours_are_those_of_a_sort():
    rng = np.random.default_rng(0)
    a, b = (np.float32(rows / np.linalg.norm(rows, axis=1, keepdims=True)) for rows in rng.uniform(size=(2, 40, 8)))
    cosine, order = a @ b.T, np.argsort(-(a @ b.T), axis=1)
    best, second = (np.take_along_axis(cosine, order[:, rank : rank + 1], axis=1)[:, 0] for rank in (0, 1))
    is_match = (1 - best < 0.81 * (1 - second)) & (np.argsort(-cosine, axis=0)[0][order[:, 0]] == np.arange(40))
    rows, nearest = mutual(a, b, max_ratio=0.9)
    assert 3 < len(rows) < 40
    np.testing.assert_array_equal(rows, np.flatnonzero(is_match))
    np.testing.assert_array_equal(nearest, order[is_match, 0])


def test_matches_are_right_and_the_same_from_either_side(views):
    rows_a, rows_b = match(views[0], views[1], calibration(), CONFIG)
    assert len(rows_a) > 0.9 * NUM_POINTS
    np.testing.assert_array_equal(whose(views[1], views[0])[rows_b], rows_a)
    back_b, back_a = match(views[1], views[0], calibration(), CONFIG)
    assert set(zip(rows_a, rows_b, strict=True)) == set(zip(back_a, back_b, strict=True))


def test_matches_that_leave_the_epipolar_line_are_left_out(views):
    # At 55 px of focal length 1.5 px are wide: a second motion fits within them.
    config = structure_config("prior.structure.matching.max_epipolar_error=0.2").matching
    rng = np.random.default_rng(0)
    views[1].pixels[:10, 1] += rng.uniform(4, 12, 10) * rng.choice([-1, 1], 10)  # the camera moves sideways
    _, rows_b = match(views[0], views[1], calibration(), config)
    assert len(rows_b) > 0.65 * NUM_POINTS
    assert np.sum(rows_b < 10) <= 2  # a line may pass by chance


def turned(descriptor, cosine, seed):
    """A unit vector at an angle of a given cosine from another."""
    across = np.random.default_rng(seed).normal(size=descriptor.shape)
    across -= (across @ descriptor) * descriptor
    return np.float32(cosine * descriptor + np.sqrt(1 - cosine**2) * across / np.linalg.norm(across))


def with_keypoint(view, pixel, descriptor):
    """The view with one more keypoint."""
    return View(
        np.vstack([view.pixels, pixel]), np.vstack([view.descriptors, descriptor]), np.append(view.landmark, NONE)
    )


def test_of_keypoints_that_look_alike_one_that_stands_out_is_matched(views):
    """By the ratio of the distances, not of their squares: |d|² = 2 - 2 cos; and only the more alike of two."""
    config = structure_config("prior.structure.matching.max_ratio=0.8").matching
    a, b = views[:2]
    place_b = int(np.flatnonzero(whose(b, a) == 0)[0])
    near = with_keypoint(b, b.pixels[place_b] + 5.0, turned(a.descriptors[0], 1 - 0.1, 0))
    for times in (0.95, 1.05):
        near.descriptors[place_b] = turned(a.descriptors[0], 1 - 0.1 * (times * 0.8) ** 2, 1)
        assert (0 in match(a, near, calibration(), config)[0]) == (times < 1)
    twin = with_keypoint(a, a.pixels[3], turned(a.descriptors[3], 0.97, 2))
    rows_a, rows_b = match(twin, b, calibration(), CONFIG)
    assert 3 in rows_a and NUM_POINTS not in rows_a and len(set(rows_b)) == len(rows_b)


def test_a_view_never_shows_a_landmark_twice(views):
    """The landmark looks different in the two older views, and the new view has a keypoint like either."""
    structure = linked(views[:2])
    first, second, new = views[:3]
    number = first.landmark[0]
    assert number != NONE
    here = int(np.flatnonzero(whose(new, first) == 0)[0])
    other_look = turned(first.descriptors[0], 0.6, 3)
    second.descriptors[second.landmark == number] = other_look
    structure.views[2] = with_keypoint(new, new.pixels[here], other_look)
    link(structure, 2, CONFIG)
    landmarks = structure.views[2].landmark
    assert (landmarks == number).sum() == 1
    shown = landmarks[landmarks != NONE]
    assert len(set(shown)) == len(shown) > 0.9 * NUM_POINTS


def test_every_point_is_one_landmark_in_all_views_and_forgetting_views_keeps_those_of_the_others(views):
    structure = linked(views)
    found = tracks(structure)
    assert len(structure.points) == len(found) and np.isnan(structure.points).all()
    for members in found.values():
        assert len({point for _, point in members}) == 1
        assert len({frame for frame, _ in members}) == len(members) >= 2
    points = [members[0][1] for members in found.values()]
    assert len(set(points)) == len(points) > 0.9 * NUM_POINTS
    structure.points[:] = np.arange(len(structure.points))[:, None]
    structure.views[2].landmark[:5] = NONE
    structure.views[3].landmark[:] = NONE
    view = structure.views[2]
    before = np.where(view.landmark >= 0, view.landmark, -5)
    forget(structure, [0, 1], CONFIG)
    assert sorted(structure.views) == [2, 3]
    assert len(structure.points) == np.sum(before >= 0)  # those of views 0 and 1 only are gone
    assert (view.landmark[:5] == NONE).all() and (structure.views[3].landmark == NONE).all()
    has = view.landmark >= 0
    np.testing.assert_array_equal(has, before >= 0)
    np.testing.assert_array_equal(structure.points[view.landmark[has], 0], before[has])


def test_the_memory_is_bounded_and_keeps_the_newest():
    descriptors, memory = np.eye(128, dtype=np.float32), Memory()
    for step in range(3):
        memory = remember(memory, np.full((50, 3), step), descriptors[:50], 120)
    np.testing.assert_array_equal(memory.points[:, 0], np.repeat([0, 1, 2], [20, 50, 50]))
    assert len(memory.descriptors) == 120


def test_exact_rays_meet_in_the_point_and_one_ray_or_none_gives_none():
    poses, points = arc(3, step=0.2), cloud(12)
    seen_by = np.ones((3, 12), bool)
    seen_by[1:, 0] = False
    structure = placed_structure(poses, points, seen_by)
    structure.points[1] = 7.0  # it has a position, and is not asked for
    triangulate(structure, structure.unknown(), CONFIG)
    assert np.isnan(structure.points[0]).all()
    np.testing.assert_array_equal(structure.points[1], 7.0)
    np.testing.assert_allclose(structure.points[2:], points[2:], atol=1e-9)


def test_two_skew_rays_give_the_middle_of_their_common_perpendicular():
    poses, points = arc(2, step=0.5), np.array([[0.2, 0.1, 2.0]])
    structure = placed_structure(poses, points, np.ones((2, 1), bool))
    structure.views[1].pixels += (0.0, 0.5)
    origins, rays = poses[:, :3, 3], []
    for view in structure.views.values():
        ray = view.T_ref_view[:3, :3] @ np.linalg.inv(calibration()) @ [*view.pixels[0], 1]
        rays.append(ray / np.linalg.norm(ray))
    s, t = np.linalg.lstsq(np.stack([rays[0], -rays[1]], axis=1), origins[1] - origins[0], rcond=None)[0]
    triangulate(structure, structure.unknown(), CONFIG)
    np.testing.assert_allclose(structure.points[0], 0.5 * (origins[0] + s * rays[0] + origins[1] + t * rays[1]))


def test_rays_without_parallax_or_that_do_not_meet_give_no_point():
    points = cloud(6)
    still = np.stack([arc(1)[0]] * 3)
    structure = placed_structure(still, points, np.ones((3, 6), bool))
    triangulate(structure, structure.unknown(), CONFIG)
    assert np.isnan(structure.points).all()
    structure = placed_structure(arc(3), points, np.ones((3, 6), bool))
    structure.views[2].pixels += (0.0, 4 * CONFIG.max_reprojection_error)
    triangulate(structure, structure.unknown(), CONFIG)
    assert np.isnan(structure.points).all()


def test_a_track_is_triangulated_anew_by_what_shows_it_today_and_keeps_its_point_where_that_tells_no_depth():
    points = cloud(5)
    structure = placed_structure(
        arc(3, step=0.2), points, np.array([[1, 1, 1, 1, 1], [1, 0, 1, 1, 0], [1, 0, 1, 1, 1]]) > 0
    )
    known = points.copy()
    known[0] *= 1.02  # of poses as they were then
    known[1] *= 1.02  # one view alone shows it, and it lies on its ray
    known[4] = points[4] + 1.0  # likewise, where its views do not show it
    structure.points = known.copy()
    structure.views[2].pixels[3] += 4 * CONFIG.max_reprojection_error  # a wrong match
    triangulate(structure, np.arange(5) != 2, CONFIG)
    np.testing.assert_allclose(structure.points[[0, 4]], points[[0, 4]], atol=1e-9)
    np.testing.assert_array_equal(structure.points[[1, 2]], known[[1, 2]])
    assert np.isnan(structure.points[3]).all()
    near = placed_structure(np.stack([arc(1)[0]] * 3), points, np.ones((3, 5), bool))
    near.points = 1.02 * points
    near.points[0] += (0.0, 1.0, 0.0)
    triangulate(near, np.ones(5, bool), CONFIG)
    np.testing.assert_array_equal(near.points[1:], 1.02 * points[1:])
    assert np.isnan(near.points[0]).all()


def test_a_wrong_match_of_a_camera_that_turns_on_the_spot_is_confirmed_by_no_view_from_elsewhere():
    """Its rays meet 2 cm from the camera; four such landmarks spent most planes of a sweep there."""
    turned, elsewhere = matrix((0.0, 0.1, 0.0), (0.003, 0.0, 0.0)), matrix(translation=(0.25, 0.0, 0.0))
    points = np.concatenate([cloud(12), [[0.001, 0.002, 0.02]]])
    seen_by = np.ones((3, 13), bool)
    seen_by[2, 0] = False
    structure = placed_structure(np.stack([np.eye(4), turned, elsewhere]), points, seen_by)
    structure.points, (view, beside, far) = points, structure.views.values()
    far.pixels[12] = view.pixels[12]
    assert confirmed(structure, view, [beside], CONFIG.max_reprojection_error).all()
    np.testing.assert_array_equal(
        confirmed(structure, view, [far], CONFIG.max_reprojection_error), [False] + [True] * 11 + [False]
    )
    far.T_ref_view = matrix((0.0, np.pi, 0.0))  # all are behind it
    assert not confirmed(structure, view, [far], np.inf).any()
