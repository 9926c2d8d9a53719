"""One Chromium for all pages: the files that use it are one group, so that they share a process."""

import pytest
from browser import MISSING, browser


@pytest.fixture(scope="session")
def chromium():
    """A browser; `chromium.fresh()` is one that nobody has used."""
    if MISSING is not None:
        pytest.skip(MISSING)
    with browser() as one:
        yield one
