"""Masks as run lengths: counts by hand, and back."""

import numpy as np
import pytest

from emgs_jax.io.run_lengths import from_run_lengths, to_run_lengths

CASES = {
    "nothing": (np.zeros((2, 3), bool), [6]),
    "all": (np.ones((2, 3), bool), [0, 6]),
    "from the first pixel": (np.array([[1, 1, 0], [0, 1, 0]], bool), [0, 2, 2, 1, 1]),
    "across a row's end": (np.array([[0, 0, 1], [1, 0, 0]], bool), [2, 2, 2]),
}


@pytest.mark.parametrize("case", CASES)
def test_counts_are_those_of_the_rows_and_give_the_mask_again(case):
    mask, counts = CASES[case]
    found = to_run_lengths(mask)
    assert found == {"size": [2, 3], "counts": counts}
    np.testing.assert_array_equal(from_run_lengths(found), mask)
