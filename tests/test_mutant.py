"""The bugs that `mutants.py` tries are bugs of the code as it is."""

import pytest
from mutants import ROOT, collect


@pytest.mark.parametrize("file", sorted({mutant.file for mutant in collect()}))
def test_the_text_that_a_mutant_changes_is_found_exactly_once(file):
    text = (ROOT / file).read_text()
    for mutant in collect():
        if mutant.file == file:
            assert text.count(mutant.before) == 1, mutant
            assert mutant.before != mutant.after and mutant.bug
            assert mutant.tests and all((ROOT / test).exists() for test in mutant.tests), mutant


def test_there_are_enough_mutants_and_each_once():
    changes = [(mutant.file, mutant.before, mutant.after) for mutant in collect()]
    assert len(set(changes)) == len(changes) >= 60
