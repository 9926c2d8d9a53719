"""What a run takes where the prior goes on in a frame of its own; oracle: the true motion, and numbers by hand."""

from dataclasses import replace

import hydra
import numpy as np
import pytest
from loop_scene import matrix
from tiny_run import NUM_FRAMES, EditedPrior, compose, dataset

from emgs_jax.mapping.window_input import WindowInput, window_inputs
from emgs_jax.prior.base import PriorPrediction

MOTION = matrix((20, 60, 10), (4.0, 1.0, -3.0))
CUT = 4


def taken(edit) -> list[WindowInput]:
    slam = hydra.utils.instantiate(compose().slam, _convert_="all")
    return list(window_inputs(dataset(), EditedPrior(edit), slam))


def apart(prediction: PriorPrediction, silent: tuple[int, ...] = ()) -> PriorPrediction:
    """From frame `CUT` on in another frame; nothing is known in the answers of the `silent` frames."""
    window, poses = prediction.window, prediction.T_anchor_view.copy()
    is_later = np.array(window.views) >= CUT
    if window.current >= CUT:
        poses, is_later = MOTION @ poses, ~is_later
    poses[is_later] = np.nan
    poses[[window.current in silent] * len(poses)] = np.nan
    return replace(prediction, T_anchor_view=poses)


def test_a_frame_of_its_own_has_another_number_and_no_pose_in_the_world():
    found = taken(apart)
    assert [one.world for one in found] == [0] * CUT + [1] * (NUM_FRAMES - CUT)
    for one in found[CUT:]:
        assert (
            np.isnan(one.prediction.T_world_views.wxyz_xyz).all()
            and np.isnan(one.prediction.T_world_anchor.wxyz_xyz).all()
        )
        assert one.prediction.current.valid.any()


def test_the_raw_path_goes_on_from_the_last_known_pose_with_the_motion_that_is_known():
    truth, raw = taken(lambda prediction: prediction), [one.raw[0] for one in taken(apart)]
    for row in range(CUT):
        np.testing.assert_array_equal(raw[row].T_world_camera, truth[row].raw[0].T_world_camera)
    stand_in = truth[CUT - 1].raw[0].T_world_camera
    start = np.linalg.inv(truth[CUT].raw[0].T_world_camera)
    for row in range(CUT, NUM_FRAMES):
        expected = stand_in @ start @ truth[row].raw[0].T_world_camera
        np.testing.assert_allclose(raw[row].T_world_camera, expected, atol=1e-9)
        np.testing.assert_array_equal(raw[row].mask, truth[row].raw[0].mask)


@pytest.mark.parametrize(("silent", "expected"), [((3,), [0, 0, 0, 0, 1, 1]), ((4,), [0, 0, 0, 0, 0, 1])])
def test_an_answer_without_a_pose_says_nothing_of_the_frame(silent, expected):
    found = taken(lambda prediction: apart(prediction, silent))
    assert [one.world for one in found] == expected
    here = silent[0]
    np.testing.assert_array_equal(found[here].raw[0].T_world_camera, found[here - 1].raw[0].T_world_camera)
    assert not found[here].raw[0].mask.any()


def test_a_frame_that_is_lost_for_a_while_is_the_same():
    """The answer knows nothing of the frame, but of those before it."""

    def edit(prediction: PriorPrediction) -> PriorPrediction:
        poses = prediction.T_anchor_view.copy()
        poses[[view == 3 for view in prediction.window.views]] = np.nan
        return replace(prediction, T_anchor_view=poses)

    assert {one.world for one in taken(edit)} == {0}


def in_unit(prediction: PriorPrediction, metres: float) -> PriorPrediction:
    poses = prediction.T_anchor_view.copy()
    poses[:, :3, 3] /= metres
    return replace(prediction, T_anchor_view=poses, points=prediction.points / np.float32(metres))


@pytest.mark.parametrize("metres", [1e-3, 1e-2, 1e3])
def test_predictions_in_another_unit_are_named_before_the_first_step_with_a_factor_that_mends_them(metres):
    """Millimetres ended frame by frame in advice about walls; of centimetres it said to divide by 1000."""
    with pytest.raises(ValueError, match=r"median depth of .* in its inference 0, .* multiply points and") as caught:
        taken(lambda prediction: in_unit(prediction, metres))
    factor = float(str(caught.value).split("T_anchor_view by ")[1].split(" ")[0])
    assert 0.1 < factor / metres < 10, "a scene of some units"
    assert len(taken(lambda prediction: in_unit(in_unit(prediction, metres), 1 / factor))) > 1


def test_points_that_are_none_are_counted_where_they_come_and_are_in_no_raw_view():
    def sky(prediction: PriorPrediction) -> PriorPrediction:
        points = prediction.points.copy()
        points[:, 0, :3] = ((1e7, 0, 1e7), (0, 0, 0), (np.nan, 0, 1))
        return replace(prediction, points=points, mask=np.ones_like(prediction.mask))

    for one in taken(sky):
        for raw in one.raw:
            assert raw.num_left_out == 3 and not raw.mask[0, :3].any() and raw.mask[1:].all()
