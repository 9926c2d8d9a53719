"""Values by rank: those of a sort, to the bit."""

import jax
import numpy as np
import pytest

from emgs_jax.ops.ranks import kth_smallest

COUNT = 600
RNG = np.random.default_rng(0)
SETS = {
    "of both signs and all sizes": RNG.normal(size=COUNT) * 10.0 ** RNG.integers(-30, 30, COUNT),
    "with ties": RNG.integers(-3, 4, COUNT) / 3.0,
    "nearly equal": 1.0 + np.arange(COUNT) * 2.0**-23,
    "with zeros and infinities": RNG.choice([-np.inf, -1.0, -0.0, 0.0, 2.0, np.inf], COUNT),
}
found = jax.jit(kth_smallest)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("share", [0.6, 0.02])
def test_ranks_are_those_of_a_sort_of_the_valid_values(name, share):
    values, valid = SETS[name].astype(np.float32), RNG.random(COUNT) < share
    ordered = np.sort(values[valid])
    ranks = np.array([0, len(ordered) // 3, len(ordered) - 1, len(ordered)], np.int32)
    at = found(values, valid, ranks)
    np.testing.assert_array_equal(at[:3], ordered[ranks[:3]])
    assert np.isnan(at[3])


def test_what_is_not_valid_does_not_count_whatever_it_is():
    values, valid = SETS["with ties"].astype(np.float32), np.arange(COUNT) % 2 > 0
    ranks = np.array([0, 7, 150, 299], np.int32)
    for poison in (np.nan, -np.inf, np.inf):
        spoilt = np.where(valid, values, np.float32(poison))
        np.testing.assert_array_equal(found(spoilt, valid, ranks), found(values, valid, ranks))
