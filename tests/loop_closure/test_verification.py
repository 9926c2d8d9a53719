"""Loops between keyframes whose poses are known: what is measured, what every gate refuses, and what no gate can."""

import dataclasses
import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from loop_scene import (
    INTRINSICS,
    SIZE,
    keyframe,
    looks,
    loops_config,
    matrix,
    neighbours_of,
    place_recognition_config,
    room,
    verification_config,
)
from scipy.spatial.transform import Rotation

from emgs_jax.data.apartment import Apartment
from emgs_jax.data.backprojection import backproject
from emgs_jax.data.plan import APART
from emgs_jax.geometry import pose_difference, scale_pose
from emgs_jax.loop_closure import verification
from emgs_jax.loop_closure.consistency import pairs_within, spatially_consistent
from emgs_jax.loop_closure.place_recognition import Keyframe, make_keyframe
from emgs_jax.loop_closure.two_view_alignment import Gate, align
from emgs_jax.loop_closure.two_view_refinement import Similarity
from emgs_jax.loop_closure.verification import LoopMeasurement, Neighbour, free_space_violation, verify

CANDIDATE = matrix((0, 10, 0), (0.1, 0.0, 0.2))
QUERY = matrix((3, -4, 2), (0.4, 0.1, -0.1))
TRUTH = np.linalg.inv(CANDIDATE) @ QUERY


def measured(points=None, query=QUERY, scale_a=1.0, scale_b=1.0, noise=0.0, overrides=()):
    """`verify` of a query at frame 500 against a candidate at frame 3, both seeing the same points."""
    points = room() if points is None else points
    a = keyframe(points, CANDIDATE, 3, scale_a, noise)
    b = keyframe(points, query, 500, scale_b, noise)
    return verify(b, a, neighbours_of(points, CANDIDATE, scale_a), verification_config(*overrides))


def assert_refused(result, gate):
    loop, info = result
    assert loop is None and info.refused_by == gate, info


def test_the_pose_of_the_query_in_the_candidates_frame_is_exact_and_three_edges_around_a_triangle_close():
    """An edge the wrong way round would not."""
    loop, info = measured()
    assert info.refused_by is None and np.isnan(info.measured)
    assert (loop.a, loop.b) == (3, 500) and loop.num_inliers > 100
    np.testing.assert_allclose(loop.Z_a_b, TRUTH, atol=1e-5)  # float32 points and pixels
    assert abs(loop.log_ratio) < 1e-5
    poses = [CANDIDATE, QUERY, matrix((-2, 5, 0), (-0.1, 0.1, 0.1))]
    views = [keyframe(room(), T, frame) for frame, T in enumerate(poses)]
    config = verification_config("min_neighbours=0")
    Z = [verify(views[b], views[a], [], config)[0].Z_a_b for a, b in ((0, 1), (1, 2), (2, 0))]
    np.testing.assert_allclose(Z[0] @ Z[1] @ Z[2], np.eye(4), atol=2e-5)


@pytest.mark.parametrize(("scale_a", "scale_b", "std"), [(1.05, 0.98, 0.05), (0.5, 2.0, ".inf")])
def test_lengths_are_in_the_candidates_unit_and_the_ratio_is_it_over_the_querys(scale_a, scale_b, std):
    """A prior without a metric may have any ratio."""
    loop, _ = measured(scale_a=scale_a, scale_b=scale_b, overrides=(f"alignment.scale_std={std}",))
    np.testing.assert_allclose(loop.Z_a_b, scale_pose(TRUTH, scale_a), atol=2e-5)
    np.testing.assert_allclose(loop.log_ratio, np.log(scale_a / scale_b), atol=1e-5)


def with_wrong(view, share, seed=0):
    """The same keyframe, the first of its keypoints elsewhere in the image."""
    count = int(share * len(view.pixels))
    pixels = view.pixels.copy()
    pixels[:count] = np.random.default_rng(seed).uniform((0, 0), SIZE, (count, 2))
    return dataclasses.replace(view, pixels=pixels)


def test_wrong_matches_and_wrong_depths_do_not_move_the_pose():
    a, b = keyframe(room(), CANDIDATE, 3), with_wrong(keyframe(room(), QUERY, 500), 0.3)
    points = a.points.copy()
    points[::5] *= 1.4
    points[1::7] = np.nan
    a = dataclasses.replace(a, points=points)
    loop, _ = verify(b, a, neighbours_of(room(), CANDIDATE), verification_config())
    distance, turn = pose_difference(loop.Z_a_b, TRUTH)
    assert distance < 2e-3 and turn < 0.05 and abs(loop.log_ratio) < 2e-3


def test_the_stated_uncertainty_holds_the_error():
    """Independent errors of 2 % of depth: the error must be within 3 of the standard deviations, which are not vast."""
    points = room()
    for frame in range(5):
        a, b = (keyframe(points, T, 10 * frame + i, noise=0.02) for i, T in enumerate((CANDIDATE, QUERY)))
        loop, _ = verify(b, a, [], verification_config("min_neighbours=0"))
        error = np.linalg.inv(loop.Z_a_b) @ TRUTH
        xi = np.concatenate([error[:3, 3], Rotation.from_matrix(error[:3, :3]).as_rotvec(), [-loop.log_ratio]])
        assert np.linalg.norm(loop.sqrt_info @ xi) < np.sqrt(18.5)  # χ²₇(.99)
        covariance = np.linalg.inv(loop.sqrt_info.T @ loop.sqrt_info)
        std = np.sqrt(np.diag(covariance))
        assert (std[:3] >= 0.01).all() and (std[3:6] >= np.radians(0.3)).all() and std[6] >= 0.005
        assert (std[:3] < 0.05).all() and (std[3:6] < np.radians(1.5)).all() and std[6] < 0.03


def test_another_place_blank_images_and_matches_that_no_motion_explains_are_refused():
    nothing = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32)
    blank = Keyframe(3, *nothing, INTRINSICS, SIZE, np.zeros((6, 8), np.float32))
    a, b = keyframe(room(), CANDIDATE, 3), keyframe(room(), QUERY, 500)
    other = dataclasses.replace(b, descriptors=looks(300, 8)[: len(b.pixels)])
    for query, candidate in ((other, a), (b, blank), (blank, b)):
        assert_refused(verify(query, candidate, [], verification_config()), Gate.MATCHES)
    a, b = keyframe(room(600), CANDIDATE, 3), with_wrong(keyframe(room(600), QUERY, 500), 0.8)
    result = verify(b, a, [], verification_config("alignment.min_matches=20"))
    assert_refused(result, Gate.MATCH_SHARE)


def with_few_points(view):
    """The same keyframe, without depth at all but 15 keypoints."""
    return dataclasses.replace(view, points=np.where(np.arange(len(view.points))[:, None] < 15, view.points, np.nan))


def test_points_are_needed_in_both_directions_and_must_say_the_same_pose():
    """The query's points are right for a camera 60 cm aside, the candidate's for the camera that there is."""
    a, b = keyframe(room(), CANDIDATE, 3), keyframe(room(), QUERY, 500)
    assert_refused(verify(b, with_few_points(a), [], verification_config()), Gate.POSE)
    assert_refused(verify(with_few_points(b), a, [], verification_config()), Gate.POSE)
    even = [view.descriptors.astype(int).sum(1, keepdims=True) % 2 == 0 for view in (a, b)]  # no point has both depths
    halves = [np.where(known, view.points, np.nan) for known, view in ((even[0], a), (~even[1], b))]
    halved = [dataclasses.replace(view, points=points) for view, points in zip((a, b), halves, strict=True)]
    loop, info = verify(halved[1], halved[0], [], verification_config())
    assert loop is None and (info.refused_by, info.measured) == (Gate.POSE, 0)
    aside = dataclasses.replace(b, points=b.points + np.float32([0.6, 0, 0]))
    assert_refused(verify(aside, a, [], verification_config()), Gate.POSES_DISAGREE)


def test_points_in_a_corner_of_the_image_near_a_line_or_of_one_small_object_are_refused():
    far, rng = room(), np.random.default_rng(0)
    far[:, :2] *= 0.15
    assert_refused(measured(far), Gate.HULL)
    along = np.linspace(-1.2, 1.2, 200)
    rail = np.column_stack([along, 0.6 * along, 2.6 + 0.9 * along]) + rng.uniform(-0.02, 0.02, (200, 3))
    assert_refused(measured(rail, overrides=("alignment.min_hull=0.0",)), Gate.COLLINEAR)
    box = np.array([0.1, 0.05, 0.9]) + np.random.default_rng(0).uniform(-0.1, 0.1, (300, 3))
    query = matrix((1, -2, 0), (0.15, 0.02, 0.25))
    assert_refused(measured(box, query, overrides=("alignment.min_hull=0.0",)), Gate.SMALL)


def test_depths_that_are_noise_and_a_scale_that_a_metric_prior_does_not_have_are_refused():
    # From one and the same place: no depth is wrong there by its reprojection.
    assert_refused(measured(query=CANDIDATE, noise=0.15), Gate.DEPTHS)
    loop, info = measured(scale_b=1.3)
    assert loop is None and info.refused_by == Gate.SCALE
    np.testing.assert_allclose(info.measured, -np.log(1.3), atol=1e-4)
    assert measured(scale_b=1.1)[0] is not None


def test_neighbours_that_are_not_verified_or_put_the_query_elsewhere_are_refused():
    a, b = keyframe(room(), CANDIDATE, 3), keyframe(room(), QUERY, 500)
    first, second = neighbours_of(room(), CANDIDATE)
    elsewhere = keyframe(room(), CANDIDATE @ matrix((0, 180, 0)), 901)
    result = verify(b, a, [first, Neighbour(elsewhere, matrix((0, 180, 0)))], verification_config())
    assert_refused(result, Gate.NEIGHBOURS)
    assert result[1].measured == 1
    for wrong in (matrix((0, 0, 0), (0.15, 0, 0)), matrix((0, 4, 0))):
        moved = dataclasses.replace(second, T_candidate_neighbour=wrong @ second.T_candidate_neighbour)
        assert_refused(verify(b, a, [first, moved], verification_config()), Gate.NEIGHBOURS_DISAGREE)


def test_neighbours_are_where_the_map_has_them_in_the_candidates_unit():
    poses, log_scales = [np.eye(4), matrix((0, 0, 0), (2.0, 0, 0))], [0.4, 0.1]
    candidate, other = (keyframe(room(), pose, frame) for frame, pose in enumerate(poses))
    (found,) = verification.neighbours_of(candidate, [other], poses, log_scales)
    np.testing.assert_allclose(found.T_candidate_neighbour[:3, 3], [2.0 * np.exp(-0.4), 0, 0], atol=1e-12)
    assert found.log_ratio == pytest.approx(-0.3)


def test_a_loop_is_weighted_by_the_inverse_of_its_covariance():
    a, b, config = keyframe(room(), CANDIDATE, 3), keyframe(room(), QUERY, 500), verification_config()
    loop, _ = verify(b, a, neighbours_of(room(), CANDIDATE), config)
    covariance = align(a, b, config.alignment).similarity.covariance
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / std / std[:, None]
    weights = std[:, None] * (loop.sqrt_info.T @ loop.sqrt_info) * std
    np.testing.assert_allclose(weights @ correlation, np.eye(7), atol=1e-6)


def drifted_path(log_scale=0.0):
    """Poses of a lap that ends 1 m and 20° off, and of 4 frames that come back; and the loops that say so.

    `log_scale` is of the first visit, whose unit theirs is.
    """
    drift = matrix((0, 20, 0), (1.0, 0, 0.2))
    truth = {frame: matrix((0, 0.5 * frame, 0), (0.1 * frame, 0, 0)) for frame in range(12)}
    truth |= {500 + frame: matrix((0, 0.5 * frame + 1, 0), (0.1 * frame, 0.05, 0)) for frame in range(12)}
    now = {frame: drift @ T if frame >= 500 else T for frame, T in truth.items()}
    scales = {frame: log_scale if frame < 500 else 0.7 for frame in truth}

    def loop(a, b, wrong=None):
        Z = scale_pose(np.linalg.inv(truth[a]) @ truth[b], np.exp(-log_scale))
        return LoopMeasurement(a, b, Z if wrong is None else wrong @ Z, 0.0, np.eye(7), 100)

    return now, scales, loop


@pytest.mark.parametrize("log_scale", [0.0, 0.3])
def test_loops_that_imply_one_correction_agree_and_one_that_does_not_is_alone(log_scale):
    poses, scales, loop = drifted_path(log_scale)
    config = loops_config()["consistency"]
    loops = [loop(0, 501), loop(2, 503), loop(5, 506, matrix((0, 0, 0), (0.5, 0, 0))), loop(7, 508)]
    np.testing.assert_array_equal(spatially_consistent(loops, [], poses, scales, config), [True, True, False, True])
    turned = [loop(0, 501), loop(2, 503), loop(7, 508, matrix((0, 6, 0)))]
    assert not spatially_consistent(turned, [], poses, scales, config).any()
    crossed = [loop(0, 511), loop(6, 506), loop(11, 501)]  # a metre apart on the path, to and fro
    assert spatially_consistent(crossed, [], poses, scales, config).all()
    # What violates free space is no witness, and one alone is nothing against.
    assert not spatially_consistent(crossed[:2], crossed[2:], poses, scales, config).any()
    assert spatially_consistent([], [], poses, scales, config).shape == (0,)


def test_loops_of_one_query_are_one_witness_and_distant_ones_none():
    poses, scales, loop = drifted_path()
    config = loops_config("consistency.max_query_gap=4")["consistency"]
    assert not spatially_consistent(
        [loop(0, 501), loop(1, 501), loop(2, 501), loop(3, 503)], [], poses, scales, config
    ).any()
    far = [loop(0, 500), loop(1, 501), loop(2, 511)]
    assert not spatially_consistent(far, [], poses, scales, config).any()
    assert spatially_consistent([*far[:2], loop(2, 502)], [], poses, scales, config).all()


def test_each_of_two_loops_must_fit_the_query_of_the_other():
    """The second is turned by 3 degrees about the query of the first, and its own is 4 m from there: 21 cm."""
    poses = {frame: matrix((0, 0, 0), (4.0 * (frame % 2), 0, 0)) for frame in (0, 1, 500, 501)}
    scales, config = dict.fromkeys(poses, 0.0), loops_config("consistency.min_others=1")["consistency"]
    first = LoopMeasurement(0, 500, np.eye(4), 0.0, np.eye(7), 100)
    for turn, is_consistent in ((0.0, True), (3.0, False)):
        Z = np.linalg.inv(poses[1]) @ matrix((0, turn, 0)) @ poses[501]
        second = LoopMeasurement(1, 501, Z, 0.0, np.eye(7), 100)
        found = spatially_consistent([first, second], [], poses, scales, config)
        np.testing.assert_array_equal(found, [is_consistent] * 2)


def test_pairs_of_nearby_queries_are_all_that_is_compared():
    """Oracle: every pair."""
    frames = np.random.default_rng(0).integers(0, 40, 60)
    one, other = pairs_within(frames, 3)
    expected = np.nonzero(np.abs(frames[:, None] - frames) <= 3)
    assert sorted(zip(one, other, strict=True)) == sorted(zip(*expected, strict=True))


def test_many_loops_are_compared_in_memory_that_grows_as_they_do():
    """Symptom: matrices of all loops with all, 1.3 GB for 7,500."""
    poses, scales, loop = drifted_path()
    poses |= {600 + frame: poses[500] for frame in range(8_000)}
    scales |= dict.fromkeys(poses, 0.0)
    loops = [replace(loop(0, 500), b=600 + frame) for frame in range(8_000)]
    tracemalloc.start()
    try:
        assert spatially_consistent(
            loops, [], poses, scales, loops_config("consistency.max_query_gap=4")["consistency"]
        ).all()
        assert tracemalloc.get_traced_memory()[1] < 120e6
    finally:
        tracemalloc.stop()


def test_a_statement_that_is_contradicted_falls_with_all_that_agree_one_after_the_other():
    """Also where the path has drifted so far in the meantime that the last correction is not the first."""
    poses, scales, loop = drifted_path()
    step = matrix((0, 0.5, 0), (0.04, 0, 0))
    poses = {frame: T @ np.linalg.matrix_power(step, max(frame - 500, 0)) for frame, T in poses.items()}
    config = loops_config("consistency.max_query_gap=2", "consistency.max_candidate_gap=2")["consistency"]
    loops = [loop(frame, 500 + frame) for frame in range(2, 12)]
    against = [loop(frame, 500 + frame) for frame in (0, 1)]
    assert spatially_consistent(loops, [], poses, scales, config).all()
    assert not spatially_consistent(loops, against, poses, scales, config).any()
    assert spatially_consistent(loops, against[:1], poses, scales, config).all()  # one may be something that was moved
    elsewhere = [loop(frame, 500 + frame, matrix((0, 0, 0), (0.5, 0, 0))) for frame in (0, 1)]
    assert spatially_consistent(loops, elsewhere, poses, scales, config).all()


@pytest.mark.parametrize(
    ("length", "num_against", "stays"), [(50, 1, True), (50, 2, False), (140, 3, True), (140, 4, False)]
)
def test_a_long_chain_may_have_more_violations_than_a_short_one(length, num_against, stays):
    """Symptom: two violations of 76 queries, by 3 % of a surface, refused all 156 loops of a second lap."""
    poses, scales, loop = drifted_path()
    poses = dict.fromkeys(range(500), poses[0]) | dict.fromkeys(range(500, 1000), poses[500])
    scales, config = dict.fromkeys(poses, 0.0), loops_config()["consistency"]
    every = [replace(loop(0, 500), a=row, b=500 + row) for row in range(length + num_against)]
    places = np.linspace(0, len(every) - 1, num_against).astype(int)
    loops = [one for row, one in enumerate(every) if row not in places]
    assert (spatially_consistent(loops, [every[row] for row in places], poses, scales, config) == stays).all()


def showing(depths, scale=1.0):
    """A keyframe of which only the depths matter."""
    return dataclasses.replace(keyframe(room(), np.eye(4)), depths=np.float32(scale * depths))


def at(T, log_ratio=0.0):
    return Similarity(T, log_ratio, np.eye(7))


def test_what_lies_behind_a_camera_and_where_it_knows_no_depth_says_nothing_of_free_space():
    hall, shorter = np.full((24, 32), 6.0), np.full((24, 32), 4.0)
    assert free_space_violation(showing(hall), showing(shorter), at(matrix((0, 180, 0))), 0.1) == 0
    hall[:, :16] = 0.0
    assert free_space_violation(showing(hall), showing(shorter), at(np.eye(4)), 0.1) == 1


def test_a_wall_where_the_other_looks_through_is_a_contradiction_in_both_orders_in_one_unit_from_one_place():
    hall, shorter = np.full((24, 32), 6.0), np.full((24, 32), 6.0)
    shorter[6:18, 8:24] = 4.0  # a quarter of the image
    a, b = showing(hall), showing(shorter)
    np.testing.assert_allclose(free_space_violation(a, b, at(np.eye(4)), 0.15), 0.25)
    np.testing.assert_allclose(free_space_violation(b, a, at(np.eye(4)), 0.15), 0.25)
    assert free_space_violation(a, b, at(np.eye(4)), 0.4) == 0.0  # within the margin
    assert free_space_violation(a, a, at(np.eye(4)), 0.15) == 0.0
    assert free_space_violation(a, showing(0 * hall), at(np.eye(4)), 0.15) == 0.0
    nearer, ahead = showing(hall - 2.0, 2.0), matrix((0, 0, 0), (0, 0, 2.0))  # 2 m, in half metres
    assert free_space_violation(a, nearer, at(ahead, -np.log(2)), 0.15) == 0.0
    assert free_space_violation(a, nearer, at(np.eye(4), -np.log(2)), 0.15) == 1.0
    assert free_space_violation(a, nearer, at(ahead), 0.15) > 0.9
    in_millimetres = [showing(depths, 2e4) for depths in (hall, shorter)]  # 120 m and 80 m
    np.testing.assert_allclose(free_space_violation(*in_millimetres, at(np.eye(4)), 0.15), 0.25)


def test_what_hides_behind_something_else_is_no_contradiction():
    """A pillar before a wall, seen from half a metre aside, where it hides another part of the wall."""

    def seen_from(x):
        across = (np.arange(64) * 5 + 2 - INTRINSICS[2]) / INTRINSICS[0]
        pillar = np.abs(3.0 * across + x) < 0.4
        return showing(np.tile(np.where(pillar, 3.0, 6.0), (48, 1)))

    aside = matrix((0, 0, 0), (0.5, 0, 0))
    assert free_space_violation(seen_from(0.0), seen_from(0.5), at(aside), 0.15) == 0.0
    assert free_space_violation(seen_from(0.0), seen_from(0.5), at(np.eye(4)), 0.15) > 0.05


@cache
def walked(walk):
    return Apartment(walk=walk, size=(160, 120))


@cache
def seen(walk, frame):
    """Keyframe with exact depth, and its true pose."""
    data = walked(walk)
    shown = data[frame]
    points = backproject(shown.depth, data.intrinsics)
    view = make_keyframe(frame, shown.image, points, shown.depth > 0, data.intrinsics, place_recognition_config())
    return view, shown.T_world_camera


def on_the_walk(walk, query, candidate):
    """`verify` of two frames, with the keyframes 4 frames before and after the candidate."""
    a, T_a = seen(walk, candidate)
    near = [seen(walk, candidate + step) for step in (-4, 4)]
    neighbours = [Neighbour(view, np.linalg.inv(T_a) @ T) for view, T in near]
    return verify(seen(walk, query)[0], a, neighbours, verification_config())


@pytest.mark.parametrize(("query", "candidate"), [(306, 24), (384, 96)])
def test_a_place_of_the_first_lap_is_known_again_on_the_second(query, candidate):
    loop, info = on_the_walk("two_laps", query, candidate)
    assert loop is not None, info
    truth = np.linalg.inv(seen("two_laps", candidate)[1]) @ seen("two_laps", query)[1]
    distance, turn = pose_difference(loop.Z_a_b, truth)
    assert distance < 0.03 and turn < 1.0 and abs(loop.log_ratio) < 0.01


@pytest.mark.parametrize(
    ("walk", "query", "candidate"), [("out_and_back", 366, 108), ("two_laps", 220, 24), ("two_laps", 160, 96)]
)
def test_a_place_seen_from_the_other_side_and_other_rooms_are_refused(walk, query, candidate):
    assert_refused(on_the_walk(walk, query, candidate), Gate.MATCHES)


def test_loops_from_one_twin_room_to_the_other_fall_with_what_is_seen_of_the_hall_before_them():
    """By what is seen inside they are right, all with the same correction of 6 m; the hall ends too early."""
    inside = [on_the_walk("twin_rooms", *pair)[0] for pair in ((324, 30), (330, 36), (336, 42))]
    hall = [on_the_walk("twin_rooms", *pair)[1] for pair in ((300, 12), (306, 18))]
    assert {info.refused_by for info in hall} == {Gate.FREE_SPACE}
    poses = {frame: seen("twin_rooms", frame)[1] for frame in (12, 18, 30, 36, 42, 300, 306, 324, 330, 336)}
    scales, config = dict.fromkeys(poses, 0.0), loops_config()["consistency"]
    for loop in inside:
        error = np.linalg.inv(loop.Z_a_b) @ np.linalg.inv(poses[loop.a]) @ poses[loop.b]
        np.testing.assert_allclose(np.linalg.norm(error[:3, 3]), APART, atol=0.03)
    assert spatially_consistent(inside, [], poses, scales, config).all()
    assert not spatially_consistent(inside, [info.violation for info in hall], poses, scales, config).any()
