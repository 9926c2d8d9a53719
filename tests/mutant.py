"""A plausible bug, kept as data: one changed line that the file's own tests have to notice."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """One change of one file, and the tests that must fail with it."""

    file: str
    before: str
    after: str
    tests: tuple[str, ...]
    bug: str


def own(file: str, *tests: str):
    """Mutants of one file: its own tests, then (text, what stands there instead, the bug) of each."""
    paths = tuple(f"tests/{test}.py" for test in tests)
    return lambda *changes: [Mutant(f"emgs_jax/{file}.py", before, after, paths, bug) for before, after, bug in changes]
