"""Class files in their three layouts, ids as positions, and what is wrong with a file or an id."""

import numpy as np
import pytest

from emgs_jax.data.class_file import read_classes

OVO = """
class_names_reduced: ['wall', 'chair']
map_to_reduced: {93: 0, 20: 1, -1: 2, -2: 2, 256: 2}
class_names: ['0', 'backpack', 'base-cabinet']
"""


def written(tmp_path, text, name="classes.txt"):
    if text is not None:
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return tmp_path / name


def test_a_name_a_line_has_no_ids_and_an_id_and_a_name_a_line_has_and_0_is_undefined(tmp_path):
    found = read_classes(written(tmp_path, "# rooms\nwall\n tv screen  # flat\n2 seater sofa\n\n"))
    assert (found.names, found.positions) == (("wall", "tv screen", "2 seater sofa"), None)
    with pytest.raises(ValueError, match=r"classes.txt has names without ids, which x.txt needs: .*`id name`"):
        found.positions_of(np.array([1]), "x.txt")
    # As names, 3 was the fourth; the last one has a byte order mark.
    for text in ("7 tv screen\n3 wall\n", "7,tv screen\n3, wall\n", "\ufeff7 tv screen\n3 wall\n"):
        found = read_classes(written(tmp_path, text))
        assert found.names == ("tv screen", "wall")
        np.testing.assert_array_equal(found.positions_of(np.array([3, 7, 0, 3]), "x"), [1, 0, -1, 1])
    named = read_classes(written(tmp_path, "0 wall\n1 floor\n"))
    np.testing.assert_array_equal(named.positions_of(np.array([0, 1]), "x"), [0, 1])


def test_ovos_file_maps_ids_and_leaves_out_the_rest(tmp_path):
    """One past the last class is none; so is a class that has a name but no place among the reduced ones."""
    found = read_classes(written(tmp_path, OVO, "info.yaml"))
    assert found.names == ("wall", "chair")
    np.testing.assert_array_equal(found.positions_of(np.array([93, 20, -1, 256, 1, 20]), "x"), [0, 1, -1, -1, -1, 1])


def test_an_id_without_a_name_and_one_that_was_cut_to_8_bits_are_told_apart(tmp_path):
    found = read_classes(written(tmp_path, "300 wall\n301 chair\n5 lamp\n"))
    with pytest.raises(
        ValueError, match=r"office0.txt: no name in .*classes.txt for ids 9, 10: give the class file of"
    ):
        found.positions_of(np.array([5, 9, 10]), "office0.txt")
    with pytest.raises(
        ValueError, match=r"for ids 44, 45, but for ids 300, 301: ids of 16 bits were read or written as 8"
    ):
        found.positions_of(np.array([44, 45, 5]), "office0.txt")
    ovo = read_classes(written(tmp_path, OVO, "info.yaml"))
    with pytest.raises(ValueError, match=r"for id 255, but for id -1: ids of 16 bits"):
        ovo.positions_of(np.array([255, 93]), "x.txt")
