"""Keyframes: what is kept of an image; and candidates: which earlier ones look alike, and alike enough."""

import dataclasses

import numpy as np
import pytest
from loop_scene import INTRINSICS, SIZE, looks, place_recognition_config

from emgs_jax import load_config
from emgs_jax.keypoints.sift import detect
from emgs_jax.loop_closure.place_recognition import (
    Database,
    Keyframe,
    add_keyframe,
    make_keyframe,
    propose_candidates,
    propose_for_all,
    train_database,
    train_words,
    unit_descriptors,
    vlad,
    with_keyframes,
)


def picture(seed=0, size=SIZE):
    """An RGB image full of blobs of all sizes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size[1], size[0], 3))
    for cell in (4, 8, 16, 32):
        coarse = rng.uniform(0, 60, (size[1] // cell + 1, size[0] // cell + 1, 3))
        image += np.kron(coarse, np.ones((cell, cell, 1)))[: size[1], : size[0]]
    return np.uint8(image)


def ramp(size=SIZE):
    """Camera-frame points of the plane z = 2 + x / 4, and a mask that is on."""
    fx, fy, cx, cy = INTRINSICS
    x, y = np.meshgrid((np.arange(size[0]) - cx) / fx, (np.arange(size[1]) - cy) / fy)
    z = 2 / (1 - 0.25 * x)
    return np.float32(np.stack([x * z, y * z, z], axis=-1)), np.ones(x.shape, bool)


def described(seed=0, frame=0, config=None):
    return make_keyframe(frame, picture(seed), *ramp(), INTRINSICS, config or place_recognition_config())


def test_a_keyframe_is_small_and_its_points_lie_on_the_surface_below_the_keypoints():
    keyframe = described()
    size = sum(value.nbytes for value in vars(keyframe).values() if isinstance(value, np.ndarray))
    assert len(keyframe.pixels) == 500 and 70_000 < size < 100_000
    assert np.isfinite(keyframe.points).all()
    fx, fy, cx, cy = INTRINSICS
    shown = keyframe.points[:, :2] / keyframe.points[:, 2:] * (fx, fy) + (cx, cy)
    np.testing.assert_allclose(shown, keyframe.pixels, atol=2e-3)
    np.testing.assert_allclose(keyframe.points[:, 2], 2 + keyframe.points[:, 0] / 4, atol=1e-3)


def test_a_keypoint_without_depth_or_at_a_step_of_it_has_no_point_and_a_cell_without_depth_has_0():
    points, mask = ramp()
    mask[:, :100] = False
    points[:, 200:] *= 1.2
    keyframe = make_keyframe(0, picture(), points, mask, INTRINSICS, place_recognition_config("grid=[8,6]"))
    x = keyframe.pixels[:, 0]
    near_edge = (np.abs(x - 99.5) < 0.5) | (np.abs(x - 199.5) < 0.5)
    is_known = np.isfinite(keyframe.points).all(axis=1)
    np.testing.assert_array_equal(is_known, (x > 100) & ~near_edge)
    assert 0.4 < is_known.mean() < 0.8
    assert keyframe.depths.shape == (6, 8) and (keyframe.depths[:, :2] == 0).all()
    np.testing.assert_allclose(keyframe.depths[:, 3:], np.tile(points[0, 140::40, 2], (6, 1)), rtol=1e-3)


def test_descriptors_survive_as_bytes():
    import cv2

    config = place_recognition_config()
    gray = cv2.cvtColor(picture(), cv2.COLOR_RGB2GRAY)
    _, exact = detect(gray, config.num_features, config.min_contrast)
    kept = unit_descriptors(described())
    assert kept.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 1.0, rtol=1e-5)
    assert (kept * exact[: len(kept)]).sum(axis=1).min() > 0.9995


def test_what_does_not_fit_is_refused():
    points, mask = ramp()
    for image, depth_mask in ((picture()[:-1], mask), (picture(), mask[:-1])):
        with pytest.raises(ValueError, match="one height and width"):
            make_keyframe(0, image, points, depth_mask, INTRINSICS, place_recognition_config())
    database = add_keyframe(Database(), as_keyframe(5, range(100)), place_recognition_config())
    with pytest.raises(ValueError, match="must come after 5"):
        add_keyframe(database, as_keyframe(5, range(100)), place_recognition_config())


def test_vlad_is_the_normalised_root_of_normalised_residuals_and_each_word_counts_once():
    """Whether one keypoint or a hundred belong to it: a repeated texture does not outweigh the rest."""
    words = np.float32(np.eye(128)[:2])
    descriptors = np.float32([[0.6, 0, 0.8, *np.zeros(125)], [0.8, 0, 0, 0.6, *np.zeros(124)]])
    residual = (descriptors - words[0]).sum(axis=0)  # both belong to the first word
    residual /= np.linalg.norm(residual)
    expected = np.sign(residual) * np.sqrt(np.abs(residual))
    expected /= np.linalg.norm(expected)
    vector = vlad(descriptors, words)
    np.testing.assert_allclose(vector[:128], expected, atol=1e-6)
    assert (vector[128:] == 0).all()
    near = np.float32([[0.8, 0, 0.6, *np.zeros(125)], [0, 0.8, 0, 0.6, *np.zeros(124)]])
    np.testing.assert_allclose(vlad(near, words), vlad(near[[0, *[1] * 100]], words), atol=1e-6)


def as_keyframe(frame, rows, grid=(6, 8)):
    """A keyframe that shows these of 2000 looks."""
    rows = np.asarray(rows)
    return Keyframe(
        *(frame, np.zeros((len(rows), 2), np.float32), looks(2000)[rows], np.zeros((len(rows), 3), np.float32)),
        *(INTRINSICS, SIZE, np.zeros(grid, np.float32)),
    )


def walk(num_frames, lap, count=150):
    """A database of frames each of which shows what the last did but for 30 looks, and again after a lap."""
    config = place_recognition_config("num_words=16", "min_gap=20", "suppressed_gap=6")
    database = Database()
    for frame in range(num_frames):
        first = 30 * (frame % lap)
        database = add_keyframe(database, as_keyframe(frame, (first + np.arange(count)) % 1800), config)
    return database, config


def test_the_place_of_a_lap_before_is_the_first_candidate_and_one_that_was_never_seen_has_none():
    """Although something is always the most alike."""
    database, config = walk(55, lap=40)
    for row in (45, 50, 54):
        best = propose_candidates(database, row, config)[0]
        assert database.keyframes[best].frame == row - 40
    assert all(propose_candidates(database, row, config) == [] for row in range(40))


def alike(frames, cosines):
    """A database of keyframes with these cosines with the last, which is 1."""
    vectors = np.float32([[cosine, np.sqrt(1 - cosine**2)] for cosine in cosines])
    keyframes = tuple(as_keyframe(frame, [0]) for frame in frames)
    return Database(keyframes, np.zeros((1, 128), np.float32), vectors, len(frames))


def test_candidates_are_old_apart_in_time_few_and_the_most_alike_first():
    frames = [0, 4, 10, 40, 44, 52, 80, 90, 100]
    database = alike(frames, [0.6, 0.7, 0.5, 0.8, 0.9, 0.4, 0.95, 0.3, 1.0])
    words = ("min_gap=30", "num_neighbours=1", "quantile=0.0", "num_candidates=2")

    def proposed(suppressed_gap):
        found = propose_candidates(database, 8, place_recognition_config(*words, f"suppressed_gap={suppressed_gap}"))
        return [frames[row] for row in found]

    assert proposed(0) == [44, 40]  # not 80, which is too new
    assert proposed(4) == [44, 4]
    assert proposed(60) == [44]


def test_candidates_of_many_are_those_of_each():
    database, config = walk(100, lap=40)
    rows = [3, *range(30, 100)]
    each = [propose_candidates(database, row, config) for row in rows]
    assert [*propose_for_all(database, rows, config)] == each and any(map(len, each))
    assert [*propose_for_all(database, [], config)] == []


def test_the_threshold_is_that_quantile_of_the_similarity_to_the_last_neighbours():
    database = alike((0, 100, 197, 198, 200), (0.7, 0.6, 0.5, 0.9, 1.0))
    config = place_recognition_config("num_neighbours=2", "quantile=0.5", "min_gap=50")
    assert propose_candidates(database, 4, config) == [0], "(.5 + .9) / 2 lets .7 pass, not .6"
    assert propose_candidates(database, 4, dataclasses.replace(config, quantile=0.6)) == []
    assert len(propose_candidates(database, 4, dataclasses.replace(config, quantile=0.0))) == 2
    assert propose_candidates(database, 0, config) == []


def test_without_a_gap_an_image_is_no_candidate_for_itself():
    """It was the best one, and hid all that are near it."""
    config = place_recognition_config("num_neighbours=2", "quantile=0.0", "min_gap=0", "suppressed_gap=25")
    assert propose_candidates(alike((0, 100, 197, 198, 200), (0.7, 0.6, 0.5, 0.9, 1.0)), 4, config) == [3, 0, 1]


def test_words_are_trained_on_no_fewer_descriptors_than_words():
    """OpenCV refused to find more centres than it had descriptors, in the middle of a run."""
    sample = unit_descriptors(described())
    np.testing.assert_array_equal(train_words(sample, (16, 1, 5), 0), train_words(sample, (16, 16, 5), 0))
    assert train_words(sample, (16, 16, 5), 2**31 - 1).shape == (16, sample.shape[1])
    with pytest.raises(ValueError, match=r"seed"):
        load_config("graph=default", f"graph.place_recognition.seed={2**31}")


def test_a_blank_image_has_a_keyframe_and_is_no_candidate():
    points, mask = ramp()
    blank, config = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8), place_recognition_config("min_gap=1", "num_words=8")
    database = Database()
    for frame in range(6):
        if frame == 4:
            assert propose_candidates(database, 3, config) == [] and not len(database.words)
        shown = picture() if frame == 4 else blank
        database = add_keyframe(database, make_keyframe(frame, shown, points, mask, INTRINSICS, config), config)
    assert database.words.shape == (8, 128) and propose_candidates(database, 5, config) == []


def test_words_are_trained_anew_when_there_are_twice_as_many_keyframes():
    trained = []
    config = place_recognition_config("num_words=16")
    database = Database()
    for frame in range(9):
        database = add_keyframe(database, as_keyframe(frame, 30 * frame + np.arange(100)), config)
        trained.append(database.num_trained)
        assert database.vectors.shape == (frame + 1, 16 * 128)
        np.testing.assert_array_equal(
            database.vectors[0], vlad(unit_descriptors(database.keyframes[0]), database.words)
        )
    assert trained == [1, 2, 2, 4, 4, 4, 4, 8, 8]


def test_keyframes_of_another_run_are_in_order_and_words_stay_until_there_are_twice_as_many():
    config = place_recognition_config("num_words=16")
    every = [as_keyframe(frame, 30 * frame + np.arange(100)) for frame in range(12)]
    here = train_database(every[2:8], config)
    found = with_keyframes(here, [*every[:2], *every[8:11]], config)
    assert [one.frame for one in found.keyframes] == [*range(11)] and found.num_trained == 6
    np.testing.assert_array_equal(found.words, here.words)
    for one, vector in zip(found.keyframes, found.vectors, strict=True):
        np.testing.assert_array_equal(vector, vlad(unit_descriptors(one), here.words))
    twice, trained = with_keyframes(here, [*every[:2], *every[8:]], config), train_database(every, config)
    assert twice.num_trained == 12
    np.testing.assert_array_equal(twice.vectors, trained.vectors)


def test_words_are_trained_on_an_even_choice_of_all_descriptors():
    config = place_recognition_config("num_words=16", "max_training=137")
    keyframes = [as_keyframe(frame, 30 * frame + np.arange(30 + 20 * (frame % 3))) for frame in range(9)]
    descriptors = np.concatenate([unit_descriptors(one) for one in keyframes])
    expected = train_words(descriptors, (16, 137, config.num_iterations), config.seed)
    np.testing.assert_array_equal(train_database(keyframes, config).words, expected)


def test_it_is_the_same_each_time():
    first, second = walk(9, lap=40)[0], walk(9, lap=40)[0]
    np.testing.assert_array_equal(first.words, second.words)
    np.testing.assert_array_equal(first.vectors, second.vectors)
    one, other = described(), described()
    np.testing.assert_array_equal(one.descriptors, other.descriptors)
    np.testing.assert_array_equal(one.points, other.points)
    sample = unit_descriptors(one)
    assert not np.array_equal(train_words(sample, (16, 1000, 5), 0), train_words(sample, (16, 1000, 5), 1))
