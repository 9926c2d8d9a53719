"""The classical prior on the synthetic room: true geometry up to a scale, the protocol, and images without any."""

from dataclasses import replace

import cv2
import hydra
import numpy as np
import pytest
from listed_frames import Listed
from scene import compose
from stereo_scene import similarity_error
from tiny_run import SMALL_STEREO

from emgs_jax.data.synthetic import Synthetic
from emgs_jax.device.arrays import to_se3
from emgs_jax.device.clock import Clock
from emgs_jax.io.files import jsonable
from emgs_jax.mapping.convert import to_first_window
from emgs_jax.mapping.window_input import predictions
from emgs_jax.prior.base import Prior, windows
from emgs_jax.prior.multiview.lens import Lens, grid, rectify, straight
from emgs_jax.prior.multiview.prior import tried_depths
from emgs_jax.prior.recorded import Recorded, record

WINDOW_SIZE, NUM_NEWER, NUM_FRAMES = 5, 2, 8


def edited(frames, images):
    """The data set with some images replaced."""
    shown = [replace(frame, image=images.get(index, frame.image)) for index, frame in enumerate(frames)]
    return Listed(frames, shown)


def make_prior(*overrides):
    return hydra.utils.instantiate(compose(*SMALL_STEREO, *overrides).prior)


@pytest.fixture(scope="module")
def room():
    drawn = Synthetic(num_frames=40, stop=NUM_FRAMES, size=(128, 96))
    return Listed(drawn, drawn)  # so that a frame is drawn once


def answers(prior, dataset, distortions=None):
    found = []
    for prediction, _ in predictions(dataset, prior, WINDOW_SIZE, Clock()):
        found.append(prediction)
        if distortions is not None:  # of the lens, as it was known then
            distortions.append(prior.report()["prior/distortion"])
    return found


@pytest.fixture(scope="module")
def answered_by():
    return make_prior()


@pytest.fixture(scope="module")
def distortions():
    return []


@pytest.fixture(scope="module")
def answered(room, answered_by, distortions):
    return answers(answered_by, room, distortions)


def blank(room):
    return np.full_like(room[0].image, 128)


def same_bits(a, b):
    arrays = ("T_anchor_view", "points", "confidence", "mask", "features")
    return a.window == b.window and all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in arrays)


def known_poses(found):
    """The newest pose of each view that has one."""
    pairs = [pair for answer in found for pair in zip(answer.window.views, answer.T_anchor_view, strict=True)]
    return {index: pose for index, pose in pairs if np.isfinite(pose).all()}


def assert_true_up_to_one_scale(dataset, poses, first=0):
    """Oracle: the true motion; returns the scale, a metre in units of the estimate."""
    assert sorted(poses) == list(range(first, first + len(poses)))
    estimate = np.stack([poses[index][:3, 3] for index in sorted(poses)])
    truth = np.stack([dataset[index].T_world_camera[:3, 3] for index in sorted(poses)])
    assert similarity_error(estimate, truth) < 0.01  # m, of a path of .45 m
    return np.linalg.norm(truth[-1] - truth[0]) / np.linalg.norm(estimate[-1] - estimate[0])


def assert_true_depths(dataset, answer, rows, scale):
    for row in rows:
        mask, truth = answer.mask[row], dataset[answer.window.dense[row]].depth
        relative = np.abs(scale * answer.points[row, ..., 2][mask] / truth[mask] - 1)
        assert mask.mean() > 0.4 and np.median(relative) < 0.06, (answer.window, row)


@pytest.mark.slow
def test_poses_and_depths_are_the_true_ones_up_to_one_scale(room, answered):
    scale = assert_true_up_to_one_scale(room, known_poses(answered))
    for answer in answered:
        assert_true_depths(room, answer, range(len(answer.window.dense)), scale)


def test_all_depths_of_landmarks_are_tried_but_for_the_few_that_are_wrong():
    """The room's own are too much alike for that: its farthest wall is within the margin of the median."""
    right, margin = np.geomspace(1.0, 10.0, 400), 1.2
    near, far = tried_depths(np.append(right, [0.01, 900.0]), margin)
    # Ten landmarks are a fortieth of all, and .06 of their depth.
    assert right[0] <= near * margin <= right[10] and right[-11] <= far / margin <= right[-1]


@pytest.mark.slow
def test_views_that_leave_the_window_stay_as_keys_and_all_are_straightened_by_the_newest_lens(answered, answered_by):
    structure = answered_by._structure
    assert set(answered[-1].window.views) < set(structure.views) == set(answered_by._images), "all views are far apart"
    assert answered_by._prepared
    for frame, gray in answered_by._prepared.items():
        shown = np.float32(cv2.cvtColor(answered_by._images[frame], cv2.COLOR_RGB2GRAY)) / 255.0
        expected = rectify(shown, structure.lens())
        np.testing.assert_array_equal(gray, expected, err_msg=f"view {frame}")


@pytest.mark.slow
def test_the_lens_is_known_once_a_key_view_has_gone(room, answered, distortions):
    measured = []
    answers(make_prior("prior.structure.keys.max_keys=0"), room, measured)
    assert measured[-1] == measured[-2] and distortions[-1] != distortions[-2]
    assert measured[0] == pytest.approx(distortions[0], rel=1e-3) and measured[0] != 0


@pytest.mark.slow
def test_a_depth_is_matched_with_views_on_both_sides_and_is_compared_with_those_that_come_next(answered, answered_by):
    """The last images have none after them; frame 5 was asked for with both of its neighbours in the window."""
    assert make_prior().num_newer(WINDOW_SIZE) == NUM_NEWER and make_prior().num_newer(10) == 5
    assert {4, 6} <= set(answered[2].window.views) and answered[2].window.current == 5
    sources = answered_by._sources(5)
    assert min(sources) < 5 < max(sources)
    assert set(answered[-1].window.dense) <= set(answered_by._depths)


@pytest.mark.slow
def test_an_answer_obeys_the_protocol(room, answered, distortions):
    assert isinstance(make_prior(), Prior)
    fx, fy, cx, cy = room.intrinsics
    calls = windows(NUM_FRAMES, WINDOW_SIZE, NUM_NEWER)
    for answer, distortion, window in zip(answered, distortions, calls, strict=True):
        assert abs(distortion) < 0.03  # the room is drawn without any
        lens = Lens(np.array([fx, fy]), np.array([cx, cy]), distortion)
        u, v = np.moveaxis(straight(grid(96, 128), lens), -1, 0)
        num_views, num_dense = len(window.views), len(window.dense)
        assert answer.window == window
        np.testing.assert_array_equal(answer.T_anchor_view[0], np.eye(4))
        expected = {
            "T_anchor_view": (np.float64, (num_views, 4, 4)),
            "points": (np.float32, (num_dense, 96, 128, 3)),
            "confidence": (np.float32, (num_dense, 96, 128)),
            "mask": (np.bool_, (num_dense, 96, 128)),
            "features": (np.float16, (num_dense, 96, 128, 0)),
        }
        got = {name: (getattr(answer, name).dtype, getattr(answer, name).shape) for name in expected}
        assert got == expected
        assert answer.confidence.min() >= 1 and not answer.points[~answer.mask].any()
        confirmed = 1 + compose(*SMALL_STEREO).prior.dense.min_probability
        assert answer.mask.any() and (answer.confidence[answer.mask] >= confirmed).all()
        x, y, z = np.moveaxis(answer.points, -1, 0)
        z_or_1 = np.where(answer.mask, z, 1)
        assert (z_or_1 > 0).all()
        for found, expected in ((fx * x / z_or_1 + cx, u), (fy * y / z_or_1 + cy, v)):
            np.testing.assert_allclose(found[answer.mask], np.broadcast_to(expected, z.shape)[answer.mask], atol=1e-3)


@pytest.mark.slow
def test_the_error_falls_with_the_confidence(room, answered):
    """Bins of the probability, from what is given on."""
    error, confidence = [], []
    for answer in answered:
        for row, index in enumerate(answer.window.dense):
            mask, truth = answer.mask[row], room[index].depth
            scale = np.median(truth[mask] / answer.points[row, ..., 2][mask])
            error.append(np.abs(scale * answer.points[row, ..., 2] / truth - 1)[mask])
            confidence.append(answer.confidence[row][mask])
    error, confidence = np.concatenate(error), np.concatenate(confidence)
    edges = [1.5, 1.8, 1.9, 1.95, 2.01]
    bins = [error[(confidence >= low) & (confidence < high)] for low, high in zip(edges, edges[1:], strict=False)]
    means = [np.minimum(values, 1).mean() for values in bins]
    assert all(len(values) > 500 for values in bins)
    assert all(more < less for less, more in zip(means, means[1:], strict=False)), means
    assert means[-1] < 0.5 * means[0]


@pytest.mark.slow
@pytest.mark.long
def test_a_recording_that_was_interrupted_is_completed_to_the_same_bits(tmp_path, room, answered):
    class Interrupted(type(make_prior())):
        stop_at = 2

        def predict(self, window, frames, intrinsics):
            if window.inference == self.stop_at:
                raise KeyboardInterrupt
            return super().predict(window, frames, intrinsics)

    config = compose(*SMALL_STEREO).prior
    prior = Interrupted(*(hydra.utils.instantiate(config[name]) for name in ("structure", "dense")))
    with pytest.raises(KeyboardInterrupt):
        record(prior, room, WINDOW_SIZE, tmp_path)
    prior.stop_at = None  # a new sequence begins with window 0
    record(prior, room, WINDOW_SIZE, tmp_path)
    assert all(same_bits(a, b) for a, b in zip(answers(Recorded(tmp_path), room), answered, strict=True))


@pytest.mark.slow
@pytest.mark.long
def test_a_blank_image_has_no_pose_and_the_next_is_placed_again(room, answered):
    found = answers(make_prior(), edited(room, {5: blank(room)}))
    for answer in found:
        row = dict(zip(answer.window.views, answer.T_anchor_view, strict=True))
        assert all(np.isfinite(row[index]).all() == (index != 5) for index in row)
        assert not any(answer.mask[k].any() for k, index in enumerate(answer.window.dense) if index == 5)
    np.testing.assert_allclose(found[-1].T_anchor_view[-1], answered[-1].T_anchor_view[-1], atol=0.02)
    answer = next(a for a in found if a.window.current == 5)
    lost = to_se3(answer.T_anchor_view[answer.window.views.index(5)])
    assert np.isnan(lost.wxyz_xyz).all()  # which the mapping marks as lost


def test_images_without_texture_give_no_geometry_and_nothing_that_a_map_could_start_from(room):
    images = edited(room, {index: blank(room) for index in range(NUM_FRAMES)})
    found = answers(make_prior(), images)
    for answer in found:
        np.testing.assert_array_equal(answer.T_anchor_view[0], np.eye(4))
        assert np.isnan(answer.T_anchor_view[1:]).all()
        assert not answer.mask.any() and not answer.points.any() and (answer.confidence == 1).all()
    frames = {index: images[index] for index in range(WINDOW_SIZE)}
    observation = hydra.utils.instantiate(compose("slam.observation.normal_radius=1").slam, _convert_="all").observation
    assert to_first_window(found[0], frames, np.eye(4), observation) == (None, ())


@pytest.mark.slow
def test_a_sequence_may_begin_with_images_that_show_nothing(room):
    found = answers(make_prior(), edited(room, {index: blank(room) for index in range(3)}))
    assert not found[0].mask.any()  # two images with texture are confirmed by nothing
    assert found[1].window.current == 4 and found[1].mask[1].any()
    poses = known_poses(found[1:])
    assert (poses.pop(0) == np.eye(4)).all() and (poses[3] == np.eye(4)).all(), "the oldest that could be placed"
    assert_true_up_to_one_scale(room, poses, first=3)


@pytest.mark.slow
def test_after_a_loss_a_known_place_is_found_again(room):
    """The window fills with blank images, then the camera is back where it was; symptom: it stayed lost for good."""
    gap, back = WINDOW_SIZE + 2, (6, 5, 4)
    nothing = replace(room[0], image=blank(room))  # the anchor, too: it would place the others
    frames = [nothing, *(room[index] for index in range(1, NUM_FRAMES)), *[nothing] * gap, *(room[i] for i in back)]
    images = Listed(room, frames)
    found = answers(make_prior("prior.structure.keys.max_keys=0"), images)  # a key view would show it, too
    before = dict(zip(found[2].window.views, found[2].T_anchor_view, strict=True))
    after = dict(zip(found[-1].window.views, found[-1].T_anchor_view, strict=True))
    for index, same in enumerate(back, start=NUM_FRAMES + gap):
        np.testing.assert_allclose(after[index], before[same], atol=0.02)
    assert found[-1].mask[-1].any()


@pytest.fixture(scope="module")
def two_rooms(room):
    """The room, and from frame `NUM_FRAMES` on another one, of which nothing is known."""
    other = Synthetic(num_frames=40, stop=NUM_FRAMES, size=(128, 96), seed=5)
    frames = [*(room[index] for index in range(NUM_FRAMES)), *(other[index] for index in range(NUM_FRAMES))]
    return Listed(room, frames)


@pytest.mark.slow
def test_a_camera_in_another_room_begins_a_structure_of_its_own_with_the_lens_of_the_first(two_rooms, answered):
    """Oracle: the true motion in the second room, up to its own scale; the answers before are those without it."""
    distortions = []
    found = answers(make_prior("prior.structure.max_lost=4"), two_rooms, distortions)
    assert all(same_bits(a, b) for a, b in zip(answered[:-NUM_NEWER], found, strict=False))
    is_second = [not np.isfinite(answer.T_anchor_view[0]).all() for answer in found]
    for answer, is_other in zip(found, is_second, strict=True):
        num_lost = min(answer.window.current + NUM_NEWER + 1, 2 * NUM_FRAMES) - NUM_FRAMES
        assert is_other == (num_lost >= 4), "with the fourth image that could not be placed, the newest of its window"
        known = known_poses([answer])
        if is_other:
            assert min(known) >= NUM_FRAMES and answer.window.current in known and answer.mask[1].any()
        else:
            assert max(known) < NUM_FRAMES, "related to nothing yet"
    second = [answer for answer, is_other in zip(found, is_second, strict=True) if is_other]
    np.testing.assert_array_equal(known_poses(second[:1])[NUM_FRAMES], np.eye(4))  # the frame is its first view's
    scale = assert_true_up_to_one_scale(two_rooms, known_poses(second), first=NUM_FRAMES)
    assert_true_depths(two_rooms, second[-1], [1], scale)
    first_lens, second_lens = (
        {d for d, s in zip(distortions, is_second, strict=True) if s == of} for of in (False, True)
    )
    assert len(second_lens) == 1 and 0 not in first_lens | second_lens
    assert len(first_lens) > 2, "while no key view has gone, each window measures it"


@pytest.mark.slow
@pytest.mark.long
def test_few_lost_images_begin_nothing_and_a_structure_without_a_relation_is_recorded_to_the_bit(tmp_path, two_rooms):
    prior = make_prior("prior.structure.max_lost=7")
    record(prior, two_rooms, WINDOW_SIZE, tmp_path)
    patient = answers(prior, two_rooms)
    for found, again in zip(patient, answers(Recorded(tmp_path), two_rooms), strict=True):
        num_lost = min(found.window.current + NUM_NEWER + 1, 2 * NUM_FRAMES) - NUM_FRAMES
        assert np.isfinite(found.T_anchor_view[0]).all() == (num_lost < 7), found.window
        assert same_bits(found, again)


def test_windows_out_of_order_images_of_another_size_and_short_windows_are_refused(room):
    images = edited(room, {index: blank(room) for index in range(NUM_FRAMES)})
    prior, calls = make_prior("prior.dense.min_probability=0.8"), list(windows(NUM_FRAMES, WINDOW_SIZE, NUM_NEWER))

    def ask(number):
        return prior.predict(calls[number], [images[index] for index in calls[number].views], images.intrinsics)

    with pytest.raises(ValueError, match="expected window 0, got 1"):
        ask(1)
    ask(0)
    with pytest.raises(ValueError, match="expected window 1, got 3; ask for all windows in order"):
        ask(3)
    images = edited(room, {2: blank(room)[:90], 0: blank(room), 1: blank(room)})
    with pytest.raises(ValueError, match=r"frame 2 has size \(128, 90\).*\(128, 96\).*dataset.size"):
        ask(0)
    with pytest.raises(ValueError, match="at least 3 images, got slam.window_size=2"):
        prior.check(room, 2)
    prior.check(room, 3)


def test_the_provenance_holds_every_value_of_the_config_as_json_writes_it():
    config = compose(*SMALL_STEREO)
    settings = make_prior().provenance.settings

    def without_targets(node):
        return {k: without_targets(v) for k, v in node.items() if k != "_target_"} if hasattr(node, "items") else node

    assert settings == {"version": 9} | jsonable(without_targets(config.prior))
    assert settings != make_prior("prior.dense.depth.max_cost=0.11").provenance.settings
