"""Arrays in a temporary file; oracle: themselves."""

import ast

import numpy as np

from emgs_jax.data.spool import Spool


def test_arrays_come_back_in_any_order_as_they_were_and_more_can_follow():
    columns = np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))
    spool, arrays = Spool(), [columns, np.zeros((0, 2)), np.array([(True, 3)], [("a", "?"), ("b", "<i4")])]
    for array in arrays[:2]:
        spool.append(array)
    np.testing.assert_array_equal(spool[0], arrays[0])
    spool.append(arrays[2])
    assert len(spool) == 3
    for row in (2, 0, 1):
        found = spool[row]
        np.testing.assert_array_equal(found, arrays[row])
        assert found.dtype == arrays[row].dtype and found.shape == arrays[row].shape


def test_no_header_is_parsed_which_two_threads_cannot_do_at_once(monkeypatch):
    def refuse(text):
        raise AssertionError(f"{text!r} is parsed")

    monkeypatch.setattr(ast, "literal_eval", refuse)
    spool = Spool()
    spool.append(np.array(2.5))
    assert spool[0] == 2.5
