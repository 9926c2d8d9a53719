"""The product of two piecewise linear factors, and what they must be."""

import hydra
import numpy as np
import pytest
from scene import compose

from emgs_jax.prior.multiview.confidence import ConfidenceConfig, probability


def test_the_probability_is_the_product_of_both_factors_between_their_numbers_and_beyond_the_last():
    config = ConfidenceConfig(spreads=(0.0, 2.0, 4.0), photo=(1.0, 0.8, 0.4), geo=(0.1, 0.5, 0.9))
    spread, agreement = np.array([[0.0, 1.0, 3.0, 99.0]]), np.array([[0.0, 1.0, 1.5, 7.0]])
    np.testing.assert_allclose(probability(spread, agreement, config), [[0.1, 0.9 * 0.5, 0.6 * 0.7, 0.4 * 0.9]])


def test_the_probability_of_conf_falls_with_the_spread_and_rises_with_every_view_that_confirms():
    config = hydra.utils.instantiate(compose("prior=multiview_stereo").prior.dense).confidence
    spread, agreement = np.meshgrid(np.linspace(0, 20, 41), np.linspace(0, 4, 33), indexing="ij")
    found = probability(spread, agreement, config)
    assert found.min() >= 0 and found.max() <= 1
    assert (np.diff(found, axis=0) <= 0).all() and (np.diff(found, axis=1) >= 0).all()


@pytest.mark.parametrize(
    "wrong", [{"photo": (1.0, 0.5)}, {"photo": (0.5, 0.6, 0.7)}, {"geo": (0.5, 0.4)}, {"spreads": (0.0, 2.0, 1.0)}]
)
def test_factors_that_are_not_monotonic_are_refused(wrong):
    given = {"spreads": (0.0, 2.0, 4.0), "photo": (1.0, 0.8, 0.4), "geo": (0.1, 0.9)} | wrong
    with pytest.raises(ValueError, match="spreads and geo must rise and photo fall"):
        ConfidenceConfig(**given)
