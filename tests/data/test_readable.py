"""Frames that cannot be read, left out or not."""

from types import SimpleNamespace

import numpy as np
import pytest

from emgs_jax.data import readable
from emgs_jax.data.base import BadFrameError, Dataset, Frame
from emgs_jax.data.readable import ReadableFrames


class Damaged(Dataset):
    """Five frames of which some cannot be read."""

    name, sequence, size, classes, has_ground_truth = "damaged", "one", (4, 3), (), False
    intrinsics = (4.0, 4.0, 1.5, 1.0)
    calibration = {"source": "numbers"}

    def __init__(self, *bad: int) -> None:
        self.bad, self.reads = bad, []

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> Frame:
        self.reads.append(index)
        if index in self.bad:
            raise BadFrameError(f"{index}.png is truncated")
        return Frame(index, 10.0 * index, f"{index}.png", np.zeros((3, 4, 3), np.uint8))

    def pose(self, index: int) -> None:
        return None

    def fingerprint(self) -> str:
        return "whole"


def test_skipping_leaves_out_exactly_the_unreadable_frames_and_renumbers_the_rest():
    frames = ReadableFrames(Damaged(1, 4), "skip")
    assert frames.skipped == {1: "1.png is truncated", 4: "4.png is truncated"}
    assert [(frame.index, frame.timestamp) for frame in frames] == [(0, 0.0), (1, 20.0), (2, 30.0)]
    assert frames.kept == [0, 2, 3] and len(frames) == 3 and frames.raw_size == (4, 3)
    whole, without_1, without_2 = (ReadableFrames(Damaged(*bad), "skip").fingerprint() for bad in ((), (1,), (2,)))
    assert whole == "whole" and len({whole, without_1, without_2}) == 3


def test_without_skipping_nothing_is_read_before_its_turn_and_the_error_names_the_file():
    damaged = Damaged(2)
    frames = ReadableFrames(damaged, "error")
    assert damaged.reads == [] and len(frames) == 5
    with pytest.raises(BadFrameError, match="2.png"):
        frames[2]
    with pytest.raises(ValueError, match="no frame that can be read: 0.png is truncated"):
        ReadableFrames(Damaged(*range(5)), "skip")
    with pytest.raises(ValueError, match="on_bad_frame must be error or skip, got 'maybe'"):
        ReadableFrames(SimpleNamespace(), "maybe")


class Noisy(Damaged):
    """Frames of noise: 36 bytes of colours and 48 of depth each."""

    def __getitem__(self, index: int) -> Frame:
        self.reads.append(index)
        rng = np.random.default_rng(index)
        image, depth = rng.integers(0, 255, (3, 4, 3), np.uint8), rng.random((3, 4), np.float32)
        return Frame(index, 0.5, f"{index}.png", image, depth, rng.random((4, 4)))


@pytest.mark.parametrize(("room", "reads"), [(84, 1), (83, 3)])
def test_a_frame_is_read_once_and_has_the_same_bits_again_and_anew_where_there_is_no_room(room, reads, monkeypatch):
    monkeypatch.setattr(readable, "MAX_KEPT_BYTES", room)
    dataset = Noisy()
    frames = ReadableFrames(dataset)
    frames[3].image[:] = 0  # whoever has a frame may change it
    for frame in (frames[3], frames[3]):
        np.testing.assert_equal(vars(frame), vars(Noisy()[3]))
        assert frame.image.dtype == np.uint8 and frame.depth.dtype == np.float32
    assert dataset.reads == [3] * reads


class WithTruth(Damaged):
    """Frames of which some have no true pose, and some a damaged one; all from number 3 on are far away."""

    has_ground_truth = True

    def __init__(self, lost=(), damaged=(), far=0.0):
        super().__init__()
        self.lost, self.damaged, self.far = lost, damaged, far

    def pose(self, index):
        if index in self.damaged:
            raise BadFrameError(f"poses.txt, line {index}")
        pose = np.eye(4)
        pose[0, 3] = self.far * (index > 2)
        return None if index in self.lost else pose

    def __getitem__(self, index):
        self.pose(index)
        return super().__getitem__(index)


def test_all_true_poses_are_read_before_the_first_frame():
    """A bad line of the trajectory ended a run at the frame that it belongs to, the 47th of 125."""
    with pytest.raises(BadFrameError, match=r"poses\.txt, line 4"):
        ReadableFrames(WithTruth(lost=(0, 2), damaged=(4,)))
    frames = ReadableFrames(WithTruth(lost=(0, 2), damaged=(4,)), "skip")
    assert [frames.pose(i) is None for i in range(len(frames))] == [True, False, True, False]
    with pytest.raises(ValueError, match="damaged one: 0 of 5 images have a true pose"):
        ReadableFrames(WithTruth(lost=range(5)))
    without_depth = WithTruth(damaged=(4,))
    without_depth.has_ground_truth = False
    with pytest.raises(BadFrameError, match=r"poses\.txt, line 4"):
        ReadableFrames(without_depth)


def test_a_step_of_the_truth_that_no_walk_has_is_named_before_the_first_frame():
    """A jump of 900 m between two frames was taken for a walk."""
    with pytest.raises(BadFrameError, match=r"damaged one: the true pose of frame 3 is 900 m from that of frame 2, "):
        ReadableFrames(WithTruth(far=900.0))
    with pytest.raises(BadFrameError, match=r"frame 3 is 900 m from that of frame 1, "):  # one between has none
        ReadableFrames(WithTruth(far=900.0, lost=(2,)))
    without = WithTruth(far=900.0)
    without.has_ground_truth = False  # poses of a unit of its own
    for frames in (without, WithTruth(far=120.0, lost=(2,)), WithTruth(far=99.0)):  # two steps; one
        assert len(ReadableFrames(frames)) == 5
