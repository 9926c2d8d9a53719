"""The prior whose structure grows with the images: what it asks for, predicts and corrects; refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hydra.errors import InstantiationException
from listening import compiled
from scene import compose

from emgs_jax.config.configure import build
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.prior.base import calls_of, with_frames

COUNT = 16
WORDS = (
    "prior=multiview_stereo",
    "prior.structure.online=true",
    "prior.structure.num_threads=1",
    "prior.dense.depth.sweep.num_planes=24",
)


@cache
def predicted(is_dark=False):
    """All windows of a walk, with the number of images that had been taken before each answer, and the walk.

    Args:
        is_dark: the first image shows nothing.
    """
    taken = []

    class Walk(Synthetic):
        def __getitem__(self, index):
            taken.append(index)
            frame = super().__getitem__(index)
            return replace(frame, image=frame.image // 50) if is_dark and index == 0 else frame

    dataset, prior = Walk(num_frames=40, stop=COUNT, size=(160, 120)), build(compose(*WORDS), "prior")
    prior.check(dataset, 4)
    found = []
    for window, frames in with_frames(calls_of(prior, dataset, 4), dataset):
        found.append((prior.predict(window, list(frames.values()), dataset.intrinsics), max(taken)))
    return found, dataset, prior


@pytest.mark.slow
def test_each_frame_is_predicted_when_it_comes_without_later_ones():
    found, _, prior = predicted()
    begun = found[0][1]
    assert [one.window.current for one, _ in found] == [*range(COUNT)] and 2 <= begun < COUNT - 1
    wanted = [max(begun + frame // 2, frame) for frame in range(COUNT)]  # those that waited do not lose the camera
    assert [taken for _, taken in found] == [min(frame, COUNT - 1) for frame in wanted]
    assert prior.adjusts_poses
    assert prior.report()["prior/placed_percent"] == 100 and prior.provenance.settings["structure"]["online"]


@pytest.mark.slow
def test_nothing_is_compiled_after_the_images_have_begun(tmp_path):
    """Symptom: the first map came seconds after the structure had begun, in which the camera moved on."""
    dataset, prior = Synthetic(num_frames=40, stop=COUNT, size=(136, 104)), build(compose(*WORDS), "prior")
    prior.check(dataset, 4)
    with compiled() as before:
        prior.keep(tmp_path)
    with compiled() as names:
        for window, frames in with_frames(calls_of(prior, dataset, 4), dataset):
            prior.predict(window, list(frames.values()), dataset.intrinsics)
    assert "estimate_depth" in before and not names


@pytest.mark.slow
def test_depths_and_poses_are_the_true_ones_up_to_one_scale():
    found, dataset, _ = predicted()
    scales, shares = [], []
    for one, _ in found:
        depth, z = dataset[one.window.current].depth, one.points[-1, ..., 2]
        is_known = one.mask[-1] & (depth > 0)
        shares.append(is_known.mean())
        scales.append(np.median(z[is_known] / depth[is_known]))
        assert np.median(np.abs(z[is_known] / depth[is_known] / scales[-1] - 1)) < 0.05
    assert np.std(np.log(scales)) < 0.05 and np.mean(shares) > 0.3
    last = found[-1][0]
    row = last.window.views.index(COUNT - 1)
    true = np.linalg.inv(dataset.pose(0)) @ dataset.pose(COUNT - 1)
    assert np.linalg.norm(last.T_anchor_view[row, :3, 3] / np.median(scales) - true[:3, 3]) < 0.03
    assert last.scale_std == 0 and np.isfinite(last.pose_covariance[row]).all()


@pytest.mark.slow
@pytest.mark.parametrize("is_dark", [False, True])
def test_adjusted_poses_are_told_once_for_all_earlier_frames(is_dark):
    """Symptom: where the first image showed nothing they were never told, and the map did not follow."""
    found, _, _ = predicted(is_dark)
    told, first = [one for one, _ in found if one.adjusted], int(is_dark)
    assert told and not found[first][0].adjusted
    for one in told:
        assert [*one.adjusted] == [*range(first, one.window.current)]
        for row, frame in enumerate(one.window.views[:-1]):
            expected = one.adjusted.get(frame, np.full((4, 4), np.nan))
            np.testing.assert_allclose(expected, one.T_anchor_view[row], atol=1e-9)


@pytest.mark.parametrize("words", [["prior.structure.model=somewhere"], ["prior/dense=files", "prior.dense.folder=."]])
def test_what_needs_all_images_is_refused_online(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "0.npy", np.ones((1, 4, 4), np.float32))
    with pytest.raises(InstantiationException, match=r"online=true makes poses as images come, and .* needs all"):
        build(compose(*WORDS[:2], *words), "prior")
