"""Some damaged inputs of every kind, and the harness itself: it has to see a fault where there is one."""

import os
from pathlib import Path

import pytest

from tools.fuzz.cases import ERROR, FAULT, SAME, Case, run_case, run_cases
from tools.fuzz.damage import BYTES, TEXT
from tools.fuzz.targets import TESTS, Target, targets

NUM_CASES = 60  # of each target about three


@pytest.mark.slow
def test_no_damaged_input_is_a_fault(tmp_path):
    kinds = list(targets())
    found = [run_case(number, 7, kinds, tmp_path) for number in range(NUM_CASES)]
    assert not [case for case in found if case.verdict == FAULT]
    assert {case.target for case in found} == {target.name for target in kinds}
    refused = sum(case.verdict == ERROR for case in found)
    assert NUM_CASES / 2 < refused < NUM_CASES, "most damages are seen; some are none"


def test_a_finished_run_is_written_without_pytest_too():
    """`python -m tools.fuzz` ended with "No module named 'hand_run'", which only pytest looked for where it is."""
    assert (TESTS / "hand_run.py").is_file() and (TESTS / "report" / "written_run.py").is_file()


def verdict(tmp_path, read, damages=TEXT, number=0) -> Case:
    target = Target("made up", lambda folder: (folder / "a.txt").write_text("1 2\n3 4\n"), read, {".txt": damages})
    return run_case(number, 0, [target], tmp_path)


def numbers(folder: Path) -> list[float]:
    return [float(word) for word in (folder / "a.txt").read_text(errors="replace").split()]


def test_what_is_read_is_read_and_an_error_must_name_the_file(tmp_path):
    verdicts = {verdict(tmp_path / "a", lambda folder: numbers(folder) and None, number=n).verdict for n in range(60)}
    assert {SAME, FAULT} <= verdicts, "float() names no file"

    def read(folder):
        try:
            numbers(folder)
        except (ValueError, OSError) as error:
            raise ValueError(f"{folder / 'a.txt'}: {error}") from error

    assert {verdict(tmp_path / "b", read, number=n).verdict for n in range(60)} == {SAME, ERROR}


@pytest.mark.parametrize(
    "error", [KeyError("a.txt"), AssertionError("a.txt"), MemoryError("a.txt"), TypeError("a.txt")]
)
def test_other_kinds_of_errors_are_faults(tmp_path, error):
    calls = []

    def read(folder):
        calls.append(1)
        if len(calls) > 1:  # the first reads the sound one
            raise error

    found = verdict(tmp_path, read, BYTES)
    assert found.verdict == FAULT and type(error).__name__ in found.message


def test_a_sound_input_that_is_refused_ends_the_harness(tmp_path):
    def read(folder):
        raise ValueError("a.txt")

    with pytest.raises(ValueError, match=r"a\.txt"):
        verdict(tmp_path, read)


@pytest.mark.weekly
def test_a_process_that_dies_is_one_fault_and_the_next_case_goes_on(monkeypatch, tmp_path):
    program = tmp_path / "python"
    program.write_text(
        "#!/bin/sh\nshift 2\nfor word; do last=$word; done\n"  # python -m tools.fuzz --inside … --cases N
        f'test -e {tmp_path}/once && exec {os.sys.executable} -m tools.fuzz "$@"\ntouch {tmp_path}/once\nkill -9 $$\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr("tools.fuzz.cases.sys.executable", str(program))
    found = list(run_cases(first=5, count=3, seed=0))
    assert [case.number for case in found] == [5, 6, 7]
    assert [case.verdict == FAULT for case in found] == [True, False, False]
    assert "ended with -9" in found[0].message
