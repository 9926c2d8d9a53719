"""The classical prior on the synthetic room: true geometry up to a scale, the protocol, and images without any."""

from dataclasses import replace

import hydra
import numpy as np
import pytest
from scene import compose
from stereo_scene import similarity_error
from tiny_run import SMALL_STEREO

from emgs_jax.data.synthetic import Synthetic
from emgs_jax.io.files import jsonable
from emgs_jax.prior.base import Prior, windows
from emgs_jax.prior.multiview.lens import Lens, grid, rectify, straight
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.running.clock import Clock
from emgs_jax.running.convert import to_first_window, to_se3
from emgs_jax.running.inputs import predictions

WINDOW_SIZE, NUM_FRAMES = 5, 8


class Edited:
    """A data set with some images replaced, which are kept so that a frame is drawn once."""

    def __init__(self, frames, images=(), like=None):
        dataset = like or frames
        self.name, self.sequence, self.size = dataset.name, dataset.sequence, dataset.size
        self.intrinsics, self.classes, self.has_ground_truth = dataset.intrinsics, dataset.classes, True
        self._frames = [frames[index] for index in range(len(frames))]
        for index, image in dict(images).items():
            self._frames[index] = replace(self._frames[index], image=image)

    def __len__(self):
        return len(self._frames)

    def __getitem__(self, index):
        return self._frames[index]

    def fingerprint(self):
        return "edited"


def make_prior(*overrides):
    return hydra.utils.instantiate(compose(*SMALL_STEREO, *overrides).prior)


@pytest.fixture(scope="module")
def room():
    return Edited(Synthetic(num_frames=40, stop=NUM_FRAMES, size=(128, 96)))


def answers(prior, dataset):
    return [prediction for prediction, _ in predictions(dataset, prior, WINDOW_SIZE, Clock())]


@pytest.fixture(scope="module")
def answered_by():
    return make_prior()


@pytest.fixture(scope="module")
def answered_with(room, answered_by):
    """Every answer, and the distortion of the lens as it was known then."""
    found = predictions(room, answered_by, WINDOW_SIZE, Clock())
    return [(prediction, answered_by.report()["prior/distortion"]) for prediction, _ in found]


@pytest.fixture(scope="module")
def answered(answered_with):
    return [prediction for prediction, _ in answered_with]


def blank(room):
    return np.full_like(room[0].image, 128)


def same_bits(a, b):
    arrays = ("T_anchor_view", "points", "confidence", "mask", "features")
    return a.window == b.window and all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in arrays)


@pytest.mark.slow
def test_poses_and_depths_are_the_true_ones_up_to_one_scale(room, answered):
    poses = {}
    for answer in answered:
        poses |= dict(zip(answer.window.views, answer.T_anchor_view, strict=True))
    estimate = np.stack([poses[index][:3, 3] for index in range(NUM_FRAMES)])
    truth = np.stack([room[index].T_world_camera[:3, 3] for index in range(NUM_FRAMES)])
    assert similarity_error(estimate, truth) < 0.01  # m, of a path of .45 m
    scale = np.linalg.norm(truth[-1] - truth[0]) / np.linalg.norm(estimate[-1] - estimate[0])
    for answer in answered:
        for row, index in enumerate(answer.window.dense):
            mask = answer.mask[row]
            relative = np.abs(scale * answer.points[row, ..., 2][mask] / room[index].depth[mask] - 1)
            assert mask.mean() > 0.4 and np.median(relative) < 0.06, (answer.window, index)


@pytest.mark.slow
def test_views_that_leave_the_window_stay_as_keys(answered, answered_by):
    views, window = answered_by._structure.views, answered[-1].window.views
    assert set(window) < set(views) == set(answered_by._grays), "every view of this walk is far from the one before"


@pytest.mark.slow
def test_all_images_are_straightened_by_the_newest_lens(answered, answered_by):
    for frame, gray in answered_by._grays.items():
        expected = rectify(answered_by._shown[frame], answered_by._structure.lens())
        np.testing.assert_array_equal(gray, expected, err_msg=f"view {frame}")


@pytest.mark.slow
@pytest.mark.parametrize("max_keys, is_known", [(0, True), (8, False)])
def test_the_lens_is_known_once_a_key_view_has_gone(room, max_keys, is_known):
    prior, measured = make_prior(f"prior.structure.keys.max_keys={max_keys}"), []
    for _ in predictions(room, prior, WINDOW_SIZE, Clock()):
        measured.append(prior.report()["prior/distortion"])
    assert (measured[-1] == measured[-2]) == is_known and measured[0] != 0


@pytest.mark.slow
def test_an_answer_obeys_the_protocol(room, answered_with):
    assert isinstance(make_prior(), Prior)
    fx, fy, cx, cy = room.intrinsics
    for (answer, distortion), window in zip(answered_with, windows(NUM_FRAMES, WINDOW_SIZE), strict=True):
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
        confirmed = 1 + compose(*SMALL_STEREO).prior.dense.min_support
        assert answer.mask.any() and (answer.confidence[answer.mask] >= confirmed).all()
        x, y, z = np.moveaxis(answer.points, -1, 0)
        z_or_1 = np.where(answer.mask, z, 1)
        assert (z_or_1 > 0).all()
        for found, expected in ((fx * x / z_or_1 + cx, u), (fy * y / z_or_1 + cy, v)):
            np.testing.assert_allclose(found[answer.mask], np.broadcast_to(expected, z.shape)[answer.mask], atol=1e-3)


@pytest.mark.slow
def test_the_error_falls_with_the_confidence(room, answered):
    """The law is 1 + n exp(-spread / 4); bins of it, and what one weak match supports is left out."""
    error, confidence = [], []
    for answer in answered:
        for row, index in enumerate(answer.window.dense):
            mask, truth = answer.mask[row], room[index].depth
            scale = np.median(truth[mask] / answer.points[row, ..., 2][mask])
            error.append(np.abs(scale * answer.points[row, ..., 2] / truth - 1)[mask])
            confidence.append(answer.confidence[row][mask])
    error, confidence = np.concatenate(error), np.concatenate(confidence)
    edges = [1.75, 2.5, 3.5, 4.5, 5.01]
    bins = [error[(confidence >= low) & (confidence < high)] for low, high in zip(edges, edges[1:], strict=False)]
    means = [np.minimum(values, 1).mean() for values in bins]
    assert all(len(values) > 500 for values in bins)
    assert all(more < less for less, more in zip(means, means[1:], strict=False)), means
    assert means[-1] < 0.5 * means[0]


@pytest.mark.slow
def test_the_same_images_give_the_same_answers_bit_for_bit(room, answered):
    prior = make_prior()
    for _ in range(2):  # a new sequence begins with window 0
        assert all(same_bits(a, b) for a, b in zip(answers(prior, room), answered, strict=True))


@pytest.mark.slow
def test_a_recording_that_was_interrupted_is_completed_to_the_same_bits(tmp_path, room, answered):
    class Interrupted(type(make_prior())):
        def predict(self, window, frames, intrinsics):
            if window.inference == 2:
                raise KeyboardInterrupt
            return super().predict(window, frames, intrinsics)

    config = compose(*SMALL_STEREO).prior
    parts = [hydra.utils.instantiate(config[name]) for name in ("structure", "dense")]
    with pytest.raises(KeyboardInterrupt):
        record(Interrupted(*parts), room, WINDOW_SIZE, tmp_path)
    record(make_prior(), room, WINDOW_SIZE, tmp_path)
    assert all(same_bits(a, b) for a, b in zip(answers(Recorded(tmp_path), room), answered, strict=True))


@pytest.mark.slow
def test_a_blank_image_has_no_pose_and_the_next_is_placed_again(room, answered):
    found = answers(make_prior(), Edited(room, {5: blank(room)}))
    for answer in found:
        row = dict(zip(answer.window.views, answer.T_anchor_view, strict=True))
        assert all(np.isfinite(row[index]).all() == (index != 5) for index in row)
        assert not any(answer.mask[k].any() for k, index in enumerate(answer.window.dense) if index == 5)
    np.testing.assert_allclose(found[-1].T_anchor_view[-1], answered[-1].T_anchor_view[-1], atol=0.02)
    lost = to_se3(next(a for a in found if a.window.current == 5).T_anchor_view[-2:])
    assert np.isnan(lost.wxyz_xyz[0]).all()  # which the mapping marks as lost


def test_images_without_texture_give_no_geometry_and_nothing_that_a_map_could_start_from(room):
    images = Edited(room, {index: blank(room) for index in range(NUM_FRAMES)})
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
    """Oracle: the true motion between the images after them, up to the one scale that images do not tell."""
    found = answers(make_prior(), Edited(room, {index: blank(room) for index in range(3)}))
    assert not found[0].mask.any()  # two images with texture are confirmed by nothing
    assert found[1].window.current == 5 and found[1].mask[1].any()
    poses = {}
    for answer in found[1:]:
        poses |= dict(zip(answer.window.views, answer.T_anchor_view, strict=True))
    np.testing.assert_array_equal(poses[3], np.eye(4))  # the oldest image that could be placed
    estimate = np.stack([poses[index][:3, 3] for index in range(3, NUM_FRAMES)])
    truth = np.stack([room[index].T_world_camera[:3, 3] for index in range(3, NUM_FRAMES)])
    assert similarity_error(estimate, truth) < 0.01  # m


@pytest.mark.slow
def test_after_a_loss_a_known_place_is_found_again(room):
    """The window fills with blank images, then the camera is back where it was; symptom: it stayed lost for good."""
    gap, back = WINDOW_SIZE + 2, (6, 5, 4)
    nothing = replace(room[0], image=blank(room))  # the anchor, too: it would place the others
    frames = [nothing, *(room[index] for index in range(1, NUM_FRAMES)), *[nothing] * gap, *(room[i] for i in back)]
    images = Edited([replace(frame, index=index) for index, frame in enumerate(frames)], like=room)
    found = answers(make_prior(), images)
    before = dict(zip(found[2].window.views, found[2].T_anchor_view, strict=True))
    after = dict(zip(found[-1].window.views, found[-1].T_anchor_view, strict=True))
    for index, same in enumerate(back, start=NUM_FRAMES + gap):
        np.testing.assert_allclose(after[index], before[same], atol=0.02)
    assert found[-1].mask[-1].any()
    nothing_kept = "prior.structure.matching.max_remembered=0", "prior.structure.keys.max_keys=0"
    without = answers(make_prior(*nothing_kept), images)
    assert np.isnan(without[-1].T_anchor_view[-1]).all()


@pytest.fixture(scope="module")
def two_rooms(room):
    """The room, and from frame `NUM_FRAMES` on another one, of which nothing is known."""
    other = Synthetic(num_frames=40, stop=NUM_FRAMES, size=(128, 96), seed=5)
    frames = [*(room[index] for index in range(NUM_FRAMES)), *(other[index] for index in range(NUM_FRAMES))]
    return Edited([replace(frame, index=index) for index, frame in enumerate(frames)], like=room)


@pytest.fixture(scope="module")
def answered_in_two(two_rooms):
    return answers(make_prior("prior.structure.max_lost=4"), two_rooms)


@pytest.mark.slow
def test_a_camera_in_another_room_begins_a_structure_of_its_own(room, two_rooms, answered, answered_in_two):
    """Oracle: the true motion in the second room, up to its own scale; the answers before are those without it."""
    assert all(same_bits(a, b) for a, b in zip(answered[:-1], answered_in_two, strict=False))
    poses, begun = {}, None
    for answer in answered_in_two:
        known = dict(zip(answer.window.views, answer.T_anchor_view, strict=True))
        known = {index: pose for index, pose in known.items() if np.isfinite(pose).all()}
        if 0 in known:
            assert begun is None and not any(index >= NUM_FRAMES for index in known), "related to nothing yet"
            continue
        if begun is None:  # with the fourth image that could not be placed, the newest of its window
            begun = answer.window.current
            assert begun == NUM_FRAMES + 2
            np.testing.assert_array_equal(known[NUM_FRAMES], np.eye(4))  # the frame is that of its first view
        assert min(known) >= NUM_FRAMES and answer.window.current in known and answer.mask[1].any()
        poses |= known
    assert sorted(poses) == list(range(NUM_FRAMES, 2 * NUM_FRAMES))
    estimate = np.stack([poses[index][:3, 3] for index in sorted(poses)])
    truth = np.stack([two_rooms[index].T_world_camera[:3, 3] for index in sorted(poses)])
    assert similarity_error(estimate, truth) < 0.01  # m
    scale = np.linalg.norm(truth[-1] - truth[0]) / np.linalg.norm(estimate[-1] - estimate[0])
    depth, truth = answered_in_two[-1].points[1, ..., 2], two_rooms[2 * NUM_FRAMES - 1].depth
    mask = answered_in_two[-1].mask[1]
    assert mask.mean() > 0.4 and np.median(np.abs(scale * depth / truth - 1)[mask]) < 0.06


@pytest.mark.slow
def test_a_second_structure_takes_the_lens_of_the_first(two_rooms):
    prior = make_prior("prior.structure.max_lost=4")
    first, second = set(), set()
    for prediction, _ in predictions(two_rooms, prior, WINDOW_SIZE, Clock()):
        is_second = not np.isfinite(prediction.T_anchor_view[0]).all()
        (second if is_second else first).add(prior.report()["prior/distortion"])
    assert len(second) == 1 and 0 not in first | second
    assert len(first) > 2, "while no key view has gone, each window measures it"
    assert prior._structure.distortion_weight > 0, "a third would take it as well"


@pytest.mark.slow
def test_few_lost_images_begin_nothing(two_rooms, answered_in_two):
    patient = answers(make_prior("prior.structure.max_lost=7"), two_rooms)
    for found, other in zip(patient, answered_in_two, strict=True):
        num_lost = min(found.window.current + 2, 2 * NUM_FRAMES) - NUM_FRAMES
        assert np.isfinite(found.T_anchor_view[0]).all() == (num_lost < 7), found.window
        assert np.isfinite(other.T_anchor_view[0]).all() == (num_lost < 4), other.window


@pytest.mark.slow
def test_a_recording_of_a_structure_without_a_relation_has_the_same_bits(tmp_path, two_rooms, answered_in_two):
    record(make_prior("prior.structure.max_lost=4"), two_rooms, WINDOW_SIZE, tmp_path)
    assert all(same_bits(a, b) for a, b in zip(answers(Recorded(tmp_path), two_rooms), answered_in_two, strict=True))


def test_windows_out_of_order_are_refused(room):
    images = Edited(room, {index: blank(room) for index in range(NUM_FRAMES)})
    prior, calls = make_prior(), list(windows(NUM_FRAMES, WINDOW_SIZE))
    with pytest.raises(ValueError, match="expected window 0, got 1"):
        prior.predict(calls[1], [images[index] for index in calls[1].views], images.intrinsics)
    prior.predict(calls[0], [images[index] for index in calls[0].views], images.intrinsics)
    with pytest.raises(ValueError, match="expected window 1, got 3; ask for all windows in order"):
        prior.predict(calls[3], [images[index] for index in calls[3].views], images.intrinsics)


def test_images_of_another_size_are_refused(room):
    images = Edited(room, {2: blank(room)[:90], 0: blank(room), 1: blank(room)})
    window = next(windows(NUM_FRAMES, WINDOW_SIZE))
    with pytest.raises(ValueError, match=r"frame 2 has size \(128, 90\).*\(128, 96\).*dataset.size"):
        make_prior().predict(window, [images[index] for index in window.views], images.intrinsics)


def test_a_window_too_short_to_confirm_a_depth_is_refused(room):
    with pytest.raises(ValueError, match="at least 3 images, got slam.window_size=2"):
        make_prior("prior.dense.min_support=1.5").check(room, 2)
    make_prior("prior.dense.min_support=1.5").check(room, 3)


def test_the_provenance_holds_every_value_of_the_config_as_json_writes_it():
    config = compose(*SMALL_STEREO)
    settings = make_prior().provenance.settings

    def without_targets(node):
        return {k: without_targets(v) for k, v in node.items() if k != "_target_"} if hasattr(node, "items") else node

    assert settings == {"version": 6} | jsonable(without_targets(config.prior))
    assert settings != make_prior("prior.dense.depth.max_cost=0.11").provenance.settings
