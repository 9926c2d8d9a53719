"""The focal length from images: made matches of a known camera, motions that tell nothing, and real sequences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.data.focal_length import (
    Pair,
    choose_pairs,
    estimate_focal_length,
    fit_focal_length,
    match,
    sampson,
    two_views,
)
from emgs_jax.data.replica import Replica
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.tum import Tum

SIZE, FOCAL = (640, 480), 470.0
ASIDE = (0.4, 0.15, 0.2)


def matches(rng, move=ASIDE, turn=0.15, relief=3.0, noise=0.3, focal=FOCAL):
    """Pixels (2, m, 2) of points 2 m and farther away in two views; a fifth of them are wrong."""
    pixels = rng.uniform((0, 0), SIZE, (300, 2))
    center = (np.array(SIZE) - 1) / 2
    depth = 2 + relief * rng.uniform(size=(300, 1))
    points = np.hstack([(pixels - center) / focal, np.ones((300, 1))]) * depth
    R = Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()
    moved = (points - np.array(move) * rng.choice([-1, 1], 3)) @ R.T
    other = focal * moved[:, :2] / moved[:, 2:] + center
    other[:60] = rng.uniform((0, 0), SIZE, (60, 2))
    return np.stack([pixels, other]) + noise * rng.normal(size=(2, 300, 2))


def pairs_of(count=30, seed=0, **scene):
    rng = np.random.default_rng(seed)
    found = [two_views(matches(rng, **scene), SIZE, stretch) for stretch in range(count)]
    return [pair for pair in found if pair is not None]


@pytest.mark.parametrize("focal", [300.0, 470.0, 900.0])
def test_made_matches_give_their_focal_length_within_what_it_says_itself(focal):
    found = fit_focal_length(pairs_of(focal=focal), SIZE)
    assert abs(found.value / focal - 1) < 0.01
    assert abs(found.value - focal) < 4 * found.spread < 0.05 * focal
    np.testing.assert_allclose(found.quartiles, focal, rtol=0.1)  # of single pairs


def test_exact_matches_give_it_exactly_and_the_same_bits_each_time():
    first, again = (fit_focal_length(pairs_of(noise=0.0), SIZE) for _ in range(2))
    np.testing.assert_allclose(first.value, FOCAL, rtol=1e-3)  # some wrong matches fit by chance
    assert first == again


def test_a_rotation_a_plane_and_motion_below_the_noise_give_no_pair():
    for scene in ({"move": (0, 0, 0)}, {"relief": 0.0}, {"move": (0.01, 0, 0), "turn": 0.001}):
        assert not pairs_of(**scene), scene


def test_what_tells_too_little_is_refused_with_what_to_give_instead():
    with pytest.raises(ValueError, match="fit many of them .*moves aside"):  # straight ahead
        fit_focal_length(pairs_of(move=(0, 0, 0.5), turn=0.0, noise=0.5), SIZE)
    with pytest.raises(ValueError, match=r"19 pairs .* 20 are needed.*dataset.intrinsics=\[fx,fy,cx,cy\].*exif"):
        fit_focal_length(pairs_of(19), SIZE)
    for image in (np.full((60, 80, 3), 128, np.uint8), None):  # nothing to see; none that can be read
        with pytest.raises(ValueError, match="0 pairs"):
            estimate_focal_length(30, lambda index, image=image: image)


def test_the_epipolar_distance_is_the_length_of_the_least_correction():
    """Matches moved off the epipolar surface along its normal come back, to first order, as how far they were moved."""
    rng, center = np.random.default_rng(0), (np.array(SIZE) - 1) / 2
    R, t = Rotation.from_rotvec([0.1, -0.05, 0.08]).as_matrix(), np.array([0.8, 0.36, 0.48])
    points = rng.uniform((-1, -1, 3), (1, 1, 6), (50, 3))
    views = np.stack([points, points @ R.T + t])
    pixels = FOCAL * views[..., :2] / views[..., 2:] + center
    K = np.array([[FOCAL, 0, center[0]], [0, FOCAL, center[1]], [0, 0, 1]])
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(K).T @ cross @ R @ np.linalg.inv(K)
    pair = Pair(pixels, F, 0, np.column_stack([R, t]))
    assert np.abs(sampson(pair, FOCAL, center)).max() < 1e-9
    a, b = (np.column_stack([x, np.ones(len(x))]) for x in pixels)
    normals = np.hstack([(b @ F)[:, :2], (a @ F.T)[:, :2]])  # in the four numbers of a match
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved = replace(pair, pixels=pixels + 0.1 * np.stack([normals[:, :2], normals[:, 2:]]))
    np.testing.assert_allclose(np.abs(sampson(moved, FOCAL, center)), 0.1, atol=1e-4)


def test_keypoints_match_where_each_is_the_others_nearest_and_no_second_is_nearly_as_near():
    """Of 20 the other image shows all in another order, but the fourth twice and the last two as something else."""
    rng = np.random.default_rng(0)
    unit = lambda rows: rows / np.linalg.norm(rows, axis=1, keepdims=True)  # noqa: E731
    told, pixels = unit(rng.uniform(size=(20, 128))), rng.uniform(0, 640, (2, 21, 2))
    order = np.append(rng.permutation(20), 3)
    again = np.where(order[:, None] < 18, told[order], unit(rng.uniform(size=(21, 128))))
    again = unit(again + 0.01 * rng.uniform(size=again.shape))
    found = match((pixels[0, :20], told), (pixels[1], again))
    rows = np.setdiff1d(np.arange(18), [3])
    expected = pixels[0, rows], pixels[1, [list(order).index(row) for row in rows]]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("count", [1, 2, 5, 17, 40, 1000])
def test_pairs_lie_in_the_sequence_and_reach_over_all_of_it(count):
    pairs = choose_pairs(count)
    assert all(0 <= a < b < count and b - a <= 16 for a, b in pairs)
    assert len({index for pair in pairs for index in pair}) <= 72
    if count > 1:
        assert min(a for a, _ in pairs) == 0 and max(b for _, b in pairs) == count - 1


@pytest.mark.slow
def test_exact_images_of_a_real_room_give_their_focal_length(shared_data):
    dataset = Replica(shared_data("replica"), "office0_from_mesh", stride=2, stop=120, intrinsics="estimate")
    assert abs(dataset.calibration["focal_px"] / 300 - 1) < 0.01
    told = dataset.calibration
    assert told["num_pairs"] >= 20 and told["focal_deviation_px"] < 10 and f"{told['focal_px']:.1f} px" in told["note"]
    assert told["focal_quartiles_px"][0] < told["focal_px"] < told["focal_quartiles_px"][1]
    np.testing.assert_allclose(dataset.intrinsics[2:], (np.array(dataset.size) - 1) / 2)


@pytest.mark.long
def test_a_real_camera_is_found_but_for_what_its_lens_adds(shared_data):
    """Nominal 525. Without a term for the lens 548 was found, and pycolmap's mapping says 545; the aim is 3 %."""
    dataset = SevenScenes(shared_data("7scenes"), "redkitchen/seq-01", stride=3, intrinsics="estimate")
    assert abs(dataset.calibration["focal_px"] / 525 - 1) < 0.06


@pytest.mark.long
def test_a_real_sequence_without_texture_is_refused(shared_data):
    with pytest.raises(ValueError, match="cannot be estimated"):
        Tum(shared_data("tum"), "rgbd_dataset_freiburg3_cabinet", stride=1, intrinsics="estimate")
