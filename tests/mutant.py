"""A plausible bug, kept as data: one changed line that the file's own tests have to notice."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """One change of one file, and the tests that must fail with it."""

    file: str
    before: str
    after: str
    tests: tuple[str, ...]
    bug: str
