"""The simulated prior in a part of a walk: errors of images are those of the whole walk, and no inference is shared.

The tolerances of the empirical figures are four standard errors of the number of draws, with fixed seeds.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from draws import INTRINSICS, NO_DEPTH_NOISE, NO_PAIRS, SEEDS, along, ask, errors, prior_with

from emgs_jax.prior.base import Window, windows
from emgs_jax.prior.simulated.noise import Stream
from emgs_jax.prior.simulated.prior import Simulated

FIRST, SEED = 2, 3
OF_IMAGES = {"image_share": 1.0, "scale": 0.0, "scale_walk": 0.0, "pixel": 0.0, "flying_share": 0.0}
OF_IMAGES |= {"window_translation": 0.0, "window_rotation": 0.0}


def part(dataset, window: Window, first: int = FIRST) -> tuple[Window, list]:
    """The frames of a window of the whole walk in a run that begins at frame `first`, by their numbers there."""
    views, dense = (tuple(index - first for index in rows) for rows in (window.views, window.dense))
    frames = [replace(dataset[index], index=index - first) for index in window.views]
    return Window(window.inference, views, dense, window.current - first), frames


def keys_of(monkeypatch, ask) -> list[tuple[int, ...]]:
    """The keys of all random numbers that a prediction takes."""
    keys, rng = [], np.random.default_rng
    with monkeypatch.context() as patch:
        patch.setattr(np.random, "default_rng", lambda key: keys.append(key) or rng(key))
        ask()
    return keys


def test_a_run_that_is_no_part_of_a_walk_draws_by_the_same_keys_as_ever(room, monkeypatch):
    """So its bits are those of all earlier results: seed, stream, inference (or 0, and one more) and frames."""
    prior, window = Simulated(seed=SEED, version=2, classes=room.classes), Window(4, (0, 2, 3), (2, 3), 3)
    expected = [(SEED, Stream.DRIFT), (SEED, Stream.SCALE), *((SEED, Stream.PAIR, draw, 2, 3) for draw in (0, 5))]
    for index in (2, 3):
        expected += [(SEED, stream, 4, index) for stream in (3, 4, 5, 6)]
        expected += [(SEED, Stream.WARP + length, draw, index) for length in (0, 1) for draw in (0, 5)]
    assert sorted(keys_of(monkeypatch, lambda: ask(prior, room, window))) == sorted(expected)
    visit = keys_of(monkeypatch, lambda: prior.revisit(window, [room[i] for i in window.views], room.intrinsics))
    assert {key[2] for key in visit if len(key) > 2} == {0, 2**24 + 4, 2**24 + 5}


def test_each_image_of_a_part_has_the_errors_of_the_whole_walk(room):
    """Without what belongs to inferences: depths and the poses of neighbours are those of the whole, to the bit."""
    whole, own = (prior_with(OF_IMAGES, seed=SEED, version=2, first=first) for first in (0, FIRST))
    other = prior_with(OF_IMAGES, seed=SEED, version=2)  # as if the part was a walk of its own
    for window in windows(range(len(room)).__contains__, 3):
        views = [index for index in window.views if index >= FIRST]
        window = Window(window.inference, tuple(views), tuple(index for index in window.dense if index >= FIRST), 0)
        if not window.dense:
            continue
        given, frames = part(room, window)
        one, two = ask(whole, room, window), own.predict(given, frames, room.intrinsics)
        np.testing.assert_array_equal(two.points, one.points)
        np.testing.assert_array_equal(two.T_anchor_view, one.T_anchor_view)
        assert np.abs(other.predict(given, frames, room.intrinsics).points - one.points).max() > 0.01


def test_parts_share_no_inference(room, monkeypatch):
    """Nor has a part one of the whole walk: its windows have another anchor. Only keys of images are common."""
    found = []
    for first in (0, 1, FIRST):
        prior = Simulated(seed=SEED, version=2, first=first, classes=room.classes)
        given, frames = part(room, Window(1, (2, 3), (2, 3), 3), first)
        for predict in (prior.predict, prior.revisit):
            keys = keys_of(monkeypatch, lambda predict=predict: predict(given, frames, room.intrinsics))  # noqa: B023
            found.append(
                {key for key in keys if predict == prior.predict or key[1] not in (Stream.DRIFT, Stream.SCALE)}
            )
    of_images = {(SEED, Stream.WARP + length, 0, index) for length in (0, 1) for index in (2, 3)}
    for one, other in itertools.combinations(found, 2):
        assert one & other == of_images


def test_70_percent_of_the_variance_of_an_image_in_two_runs_is_common_and_none_of_two_places():
    """The error of a pair of frames: in the whole walk, in a part, and of the pair of these numbers in another part."""
    standard = NO_DEPTH_NOISE | {"window_translation": 0.0, "window_rotation": 0.0, "scale": 0.0}
    frames = along(8)

    def walk(first: int, *views: int) -> np.ndarray:
        given, there = Window(2, views, views[-1:], views[-1]), [frames[index] for index in views]
        of_seeds = (prior_with(standard, seed=seed, first=first) for seed in SEEDS)
        T = np.stack([prior.predict(given, there, INTRINSICS).T_anchor_view for prior in of_seeds])
        return errors(np.eye(4), np.linalg.inv(T[:, 1]) @ T[:, 2])

    whole, same, elsewhere = walk(0, 5, 6, 7), walk(4, 1, 2, 3), walk(5, 1, 2, 3)
    for half in (np.s_[:, :3], np.s_[:, 3:]):
        assert np.corrcoef(whole[half].ravel(), same[half].ravel())[0, 1] == pytest.approx(0.7, abs=0.07)
        assert np.corrcoef(elsewhere[half].ravel(), same[half].ravel())[0, 1] == pytest.approx(0.0, abs=0.13)


def test_scales_of_two_parts_are_independent():
    def log_scales(first: int) -> np.ndarray:
        still = NO_DEPTH_NOISE | NO_PAIRS
        prior = prior_with(still, seed=SEED, first=first)
        frames = along(2)
        depths = [prior.predict(Window(n, (0, 1), (1,), 1), frames, INTRINSICS).points[0, 3, 4, 2] for n in range(400)]
        return np.log(np.array(depths) / 2)

    one, other = log_scales(0), log_scales(86)
    assert one.std() == pytest.approx(0.03, rel=0.3) and other.std() == pytest.approx(0.03, rel=0.3)
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.5  # some 20 independent values of each


@pytest.mark.parametrize("first", [-1, 1.5])
def test_a_first_frame_that_is_none_is_refused(first):
    with pytest.raises(ValueError, match="prior.first is the number of a frame, 0 or more"):
        Simulated(first=first)


def test_a_part_is_named_in_its_provenance_and_the_whole_as_ever():
    assert "first" not in Simulated().provenance.settings and Simulated(first=4).provenance.settings["first"] == 4
