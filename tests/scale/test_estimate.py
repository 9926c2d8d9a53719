"""Scales with their uncertainty, alone and combined."""

import numpy as np
import pytest

from emgs_jax.scale.estimate import Scale, combined, scale_from


def test_a_scale_is_the_metres_of_a_unit():
    scale = scale_from("tape", metres=3.0, units=2.0, std=0.01)
    assert scale.factor == pytest.approx(1.5)
    assert (scale.source, scale.std) == ("tape", 0.01)


def test_scales_are_weighed_by_their_variance():
    scale, warning = combined([Scale("a", 0.0, 0.1), Scale("b", 0.05, 0.05)])
    assert scale.log == pytest.approx(0.04)  # weights 100 and 400
    assert scale.std == pytest.approx(500**-0.5)
    assert warning is None


def test_scales_that_disagree_are_said_and_less_sure():
    scale, warning = combined([Scale("tape", 0.0, 0.01), Scale("height", 0.2, 0.01)])
    assert scale.log == pytest.approx(0.1)
    assert scale.std == pytest.approx(0.01 / 2**0.5 * 200**0.5)  # χ² = 2 · 10² for one degree of freedom
    assert "tape: -10 %" in warning and "height: +11 %" in warning


def test_one_scale_stays():
    scale, warning = combined([Scale("tape", 0.3, 0.02)])
    assert (scale.log, scale.std) == pytest.approx((0.3, 0.02)) and warning is None


def test_the_combination_is_calibrated():
    rng, stds = np.random.default_rng(0), np.array([0.01, 0.03, 0.02])
    off = []
    for _ in range(500):
        scale, _ = combined([Scale("", float(std * rng.normal()), float(std)) for std in stds])
        off.append(scale.log / scale.std)
    assert 0.85 < np.std(off) < 1.05  # below 1 where disagreement widens
