"""prior=stream: what lies beside each image, against what was written there."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import tiny_run

from emgs_jax.config.configure import build_dataset
from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Dataset
from emgs_jax.prior.base import Window, calls_of
from emgs_jax.prior.files.stream import Stream


class Beside(Dataset):
    """The tiny room, each frame with a file of its own in a folder, and its depth and pose beside it."""

    def __init__(self, folder, change=lambda row, depth, pose: (depth, pose), stays: int = 0, room=None) -> None:
        self._room, self._folder, self._stays = room or tiny_run.dataset(), folder, stays
        for name in ("name", "sequence", "size", "intrinsics", "classes"):
            setattr(self, name, getattr(self._room, name))
        for row in range(len(self)):
            frame = self._at(row)
            depth, pose = change(row, frame.depth, frame.T_world_camera)
            cv2.imwrite(str(folder / f"{row}.png"), frame.image)
            np.savez(folder / f"{row}.npz", depth=depth, T_world_camera=pose)

    def __len__(self) -> int:
        return self._stays + len(self._room)

    def _at(self, index: int):
        """Of a camera that stays where it is for a while."""
        return self._room[max(index - self._stays, 0)]

    def files(self, index: int):
        return [self._folder / f"{index}.png"]

    def __getitem__(self, index: int):
        return replace(self._at(index), index=index, name=str(self.files(index)[0]), depth=None, T_world_camera=None)


def walk():
    """The room from farther apart, so that the camera has moved from one frame to the next."""
    return build_dataset(tiny_run.compose("dataset.stop=36", "dataset.stride=6"))


def asked(data: Beside, **keys):
    prior = Stream(**keys)
    prior.check(data, tiny_run.WINDOW_SIZE)
    calls = [*calls_of(prior, data, tiny_run.WINDOW_SIZE)]
    return [prior.predict(call, [data[index] for index in call.views], data.intrinsics) for call in calls]


def test_each_frame_is_predicted_when_it_is_there_by_what_came_with_it(tmp_path):
    data, room = Beside(tmp_path), tiny_run.dataset()
    found = asked(data, pose_std=[0.01, 1.0])
    assert [(one.window.current, max(one.window.views)) for one in found] == [(row, row) for row in range(len(data))]
    assert found[0].window.dense == (0,) and found[3].window.dense == (2, 3)
    for one in found:
        for row, index in enumerate(one.window.views):
            expected = np.linalg.inv(room[0].T_world_camera) @ room[index].T_world_camera
            np.testing.assert_allclose(one.T_anchor_view[row], expected, atol=1e-9)
        depth = room[one.window.current].depth
        np.testing.assert_allclose(one.points[-1], backproject(depth, room.intrinsics), atol=1e-5)
        np.testing.assert_array_equal(one.mask[-1], depth > 0)
        np.testing.assert_allclose(np.sqrt(np.diag(one.pose_covariance[-1])), [0.01] * 3 + [np.radians(1.0)] * 3)


def test_a_frame_without_a_pose_has_no_points_and_odometry_says_nothing_of_a_loop(tmp_path):
    def change(row, depth, pose):
        return depth, np.full((4, 4), np.nan) if row == 2 else pose

    data = Beside(tmp_path, change)
    found = asked(data)[2]
    assert not found.mask[-1].any() and np.isnan(found.T_anchor_view[found.window.views.index(2)]).all()
    window = Window(3, (0, 4), (0, 4), 4)
    assert Stream().revisit(window, [data[0], data[4]], data.intrinsics) is None


@pytest.mark.parametrize("stays", [0, 10])
def test_depths_in_another_unit_end_the_run_however_long_the_camera_stands_still(tmp_path, stays):
    with pytest.raises(ValueError, match="T_world_camera of the stream: the depths of two views differ"):
        asked(Beside(tmp_path, lambda row, depth, pose: (3 * depth, pose), stays, walk()))


def test_poses_in_another_convention_are_named(tmp_path):
    with pytest.raises(ValueError, match="the poses are taken as world -> camera"):
        asked(Beside(tmp_path, lambda row, depth, pose: (depth, np.linalg.inv(pose)), room=walk()))


def scaled(*factors: float):
    """Depths of views with factors of their own, and poses as they are."""
    return lambda row, depth, pose: (np.float32(factors[row]) * depth, pose)


def test_a_stream_is_not_refused_for_the_chance_of_its_first_views(tmp_path, capsys):
    """Symptom: one of five runs of the same bag ended after two frames, by which two had come."""
    assert len(asked(Beside(tmp_path, scaled(1.0, 1.3, 1.0, 1.0, 1.0, 1.0), room=walk()))) == 6
    assert "two views differ by 2" in capsys.readouterr().out, "it is said"


def test_depths_that_do_not_fit_over_several_views_end_the_run(tmp_path):
    """As of a network that sees one image at a time."""
    change = scaled(1.0, 1.3, 0.9, 1.2, 0.8, 1.1)
    with pytest.raises(ValueError, match=r"differ by [23]\d\.\d %, by \d\.\d % where each view has a scale of its own"):
        asked(Beside(tmp_path, change, room=walk()))
    assert len(asked(Beside(tmp_path, change, room=walk()), max_misfit=1.0)) == 6
