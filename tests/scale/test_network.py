"""The scale of a network in metres: its ratio to a structure, frame by frame."""

import numpy as np
import pytest

from emgs_jax.scale.network import cells_of, log_ratio, scale_of_network


def cells(*numbers):
    return {(number, 0, 0) for number in numbers}


def test_the_ratio_of_a_frame_is_the_weighted_median_of_its_landmarks():
    metres = np.array([2.0, 2.0, 9.0, 9.0, 9.0, np.nan, 0.0])
    depth, crowd = np.array([1.0] * 7), np.array([1.0, 1.0, 0.2, 0.2, 0.2, 1.0, 1.0])
    assert log_ratio(metres, depth, crowd, 3) == pytest.approx(np.log(2.0)), "three in one cell count as less than two"
    assert log_ratio(metres, depth, np.ones(7), 3) == pytest.approx(np.log(9.0))
    assert np.isnan(log_ratio(metres, depth, crowd, 6)) and np.isnan(log_ratio(metres[:0], depth[:0], crowd[:0], 0))


def test_landmarks_lie_in_cells():
    assert cells_of(np.array([[0.1, 0.1, 0.1], [0.4, 0.2, 0.3], [-0.1, 0.6, 0.0]]), 0.5) == {(0, 0, 0), (-1, 1, 0)}


def test_frames_of_other_places_average_out_and_the_bias_does_not():
    rng = np.random.default_rng(0)
    ratios, apart = 0.3 * rng.normal(size=400), [cells(row) for row in range(400)]
    scale = scale_of_network(ratios, apart, 0.1)
    assert scale.log == pytest.approx(ratios.mean())
    assert scale.std == pytest.approx((0.1**2 + 0.3**2 / 400) ** 0.5, rel=0.01)


def test_a_frame_that_comes_twice_is_no_surer():
    """Four places, each seen a hundred times: four frames."""
    rng = np.random.default_rng(1)
    own = rng.normal(size=4)
    often = scale_of_network(np.repeat(own, 100), [cells(row // 100) for row in range(400)], 1.0)
    once = scale_of_network(own, [cells(row) for row in range(4)], 1.0)
    assert often.log == pytest.approx(once.log)
    # Four places tell as much about the spread in both; the assumed one counts as one of 4 or of 400 ratios.
    assert once.std == pytest.approx(((np.sum((own - own.mean()) ** 2) + 1) / 4 / 4 + 1) ** 0.5)
    assert often.std == pytest.approx(((100 * np.sum((own - own.mean()) ** 2) + 1) / (400 - 99) / 4 + 1) ** 0.5)


def test_one_frame_errs_as_much_as_scenes_do():
    scale = scale_of_network(np.array([np.nan, 0.7]), [cells(1), cells(2, 3)], 0.2)
    assert (scale.log, scale.std) == pytest.approx((0.7, 2**0.5 * 0.2))
    assert scale_of_network(np.array([np.nan]), [cells(1)], 0.2) is None


def test_the_scale_of_a_network_is_calibrated():
    """A walk past 40 places: a network errs in each by 30 %, a frame shows five of them, the scene's bias is 10 %."""
    rng, off = np.random.default_rng(2), []
    shown = [cells(*range(row, row + 5)) for row in range(36)]
    for _ in range(400):
        errors = 0.3 * rng.normal(size=40)
        ratios = np.array([errors[row : row + 5].mean() for row in range(36)]) + 0.1 * rng.normal()
        scale = scale_of_network(ratios, shown, 0.1)
        off.append(scale.log / scale.std)
    assert 0.85 < np.std(off) < 1.1
