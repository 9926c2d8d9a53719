"""The structure of images as they come, against the truth and the images that have come."""

from functools import cache

import numpy as np
import pytest
from stereo_scene import similarity_error, structure_config

from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.structure.model import NONE
from emgs_jax.structure.sequence import follow_images

pytestmark = pytest.mark.slow
NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


class Coming(Synthetic):
    """The built-in room; some frames come twice, or show something else. A camera's can be dropped."""

    def __init__(self, count: int = 12, order=None, others=None, is_camera: bool = False) -> None:
        super().__init__(num_frames=40, stop=count, size=(160, 120))
        self.order, self.others = [*(order or range(count))], others or {}
        self.taken: list[int] = []
        self._is_camera = is_camera

    def __len__(self) -> int:
        return len(self.order)

    def has(self, index: int) -> bool:
        return index < len(self.order)

    @property
    def total(self) -> int | None:
        return None if self._is_camera else len(self.order)

    def drop_last(self) -> None:
        del self.order[self.taken[-1]]

    def __getitem__(self, index: int) -> Frame:
        self.taken.append(index)
        return Frame(index, float(index), "", self.others.get(index, rendered(self.order[index])))

    def truth(self) -> np.ndarray:
        return np.stack([rendered_pose(frame) for frame in self.order])


@cache
def drawn() -> Synthetic:
    return Synthetic(num_frames=40, size=(160, 120))


@cache
def rendered(index: int) -> np.ndarray:
    return drawn()[index].image


def rendered_pose(index: int) -> np.ndarray:
    return drawn().pose(index)


def followed(dataset: Coming, *words: str):
    return follow_images(dataset, structure_config("prior.structure.online=true", *words))


def error_of(found, truth: np.ndarray) -> float:
    placed = np.flatnonzero(found.is_placed)
    return similarity_error(found.T_world_camera[placed, :3, 3], truth[placed, :3, 3])


@cache
def whole():
    """A walk of fourteen images, and the structure after each of them."""
    dataset = Coming(14)
    up_to = followed(dataset)
    return dataset, [(up_to(frame), max(dataset.taken)) for frame in range(14)]


def test_every_image_is_placed_where_the_camera_was():
    dataset, found = whole()
    last = found[-1][0]
    assert last.is_placed.all()
    assert error_of(last, dataset.truth()) < 0.008  # m, of a path of 1 m, at 160 pixels
    depths = np.concatenate([last.depths(frame) for frame in range(14)])
    assert abs(np.log(np.median(depths) / 2.0)) < 0.1  # `median_depth` of those with which it began


def test_no_image_is_asked_for_that_is_not_needed_and_those_before_the_beginning_come_in():
    _, found = whole()
    begun = found[0][1]  # the first structure waits for parallax
    assert 2 <= begun < 13
    assert found[0][0].is_placed[: begun + 1].all()
    assert [taken for _, taken in found] == [min(max(begun + frame // 2, frame), 13) for frame in range(14)]


def test_the_unit_and_the_focal_length_stay():
    _, found = whole()
    first, last = found[0][0], found[-1][0]
    count = len(first.world)
    a, b = (one.T_world_camera[:count, :3, 3] - one.T_world_camera[0, :3, 3] for one in (first, last))
    assert abs((a * b).sum() / (a * a).sum() - 1) < 0.05
    assert float(last.worlds[0].camera.params[0]) == pytest.approx(131.2)


def test_motions_err_as_their_covariances_say():
    dataset, found = whole()
    last, truth = found[-1][0], dataset.truth()
    T = last.T_world_camera
    scale = np.linalg.norm(truth[13, :3, 3] - truth[0, :3, 3]) / np.linalg.norm(T[13, :3, 3] - T[0, :3, 3])
    ratios = []
    for frame in range(1, 14):
        own, true = (np.linalg.inv(poses[frame - 1]) @ poses[frame] for poses in (T, truth))
        error = np.linalg.inv(own) @ np.r_[np.c_[true[:3, :3], true[:3, 3] / scale], [[0, 0, 0, 1]]]
        turn = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]) / 2
        xi = np.r_[error[:3, 3], turn]
        ratios.append(xi @ np.linalg.solve(last.covariance[frame], xi) / 6)
    assert 0.05 < np.mean(ratios) < 3  # 1 for exact ones


def test_the_same_images_give_the_same_bits():
    """Without a number of threads, too."""
    _, found = whole()
    again = followed(Coming(14), "prior.structure.num_threads=-1")
    for frame in range(14):
        other = again(frame)
    for name in ("T_world_camera", "covariance"):
        np.testing.assert_array_equal(getattr(found[-1][0], name), getattr(other, name))


def test_a_camera_that_stands_still_has_no_keyframes_but_poses():
    order = [*range(11), 10, 10, 11]
    dataset = Coming(order=order)
    last = followed(dataset)(len(order) - 1)
    assert last.is_placed.all() and error_of(last, dataset.truth()) < 0.008
    still = last.T_world_camera[10:13, :3, 3]
    assert np.abs(still - still[0]).max() < 1e-3 * 2.0  # of the depth
    alone = followed(Coming(order=[0] * 5))(4)
    assert not alone.is_placed.any()  # without parallax there is nothing


def test_a_camera_that_stands_still_at_first_leaves_no_frames_to_catch_up_with(monkeypatch):
    """Symptom: twenty of them were mapped for 23 s, in which no image was taken, and the camera was lost after that."""
    monkeypatch.setattr("emgs_jax.structure.sequence.WAITING_S", 0.0)
    dataset = Coming(order=[0] * 6 + [*range(12)], is_camera=True)
    live = followed(dataset)
    for frame in range(12):
        found = live(min(frame, len(dataset) - 1))
    kept = dataset.order[: len(found.world)]
    assert kept[0] == 0 and kept.count(0) == 1 and found.is_placed.all()
    recorded = Coming(order=kept)  # what was kept gives the same structure
    again = followed(recorded)
    for frame in range(len(kept)):
        last = again(frame)
    np.testing.assert_array_equal(last.T_world_camera, found.T_world_camera)


def test_a_camera_that_is_lost_comes_back():
    order = [*range(12), 12, 12, 6, 7]
    dataset = Coming(order=order, others={12: NOISE, 13: np.zeros_like(NOISE)})
    last = followed(dataset)(len(order) - 1)
    assert [*np.flatnonzero(~last.is_placed)] == [12, 13]
    assert error_of(last, dataset.truth()) < 0.008
    for frame, other in ((14, 6), (15, 7)):
        np.testing.assert_allclose(last.T_world_camera[frame, :3, 3], last.T_world_camera[other, :3, 3], atol=0.02)


def test_an_image_that_cannot_be_read_is_left_out():
    class Torn(Coming):
        def __getitem__(self, index: int) -> Frame:
            if index == 5:
                raise BadFrameError("torn")
            return super().__getitem__(index)

    last = followed(Torn(13))(12)
    assert [*np.flatnonzero(last.world == NONE)] == [5]
