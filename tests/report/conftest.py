"""One Chromium for all pages: the files that use it are one xdist_group, so that they share it."""

import pytest
from browser import MISSING, browser


@pytest.fixture(scope="session")
def chromium():
    """A browser; `chromium.fresh()` is one that nobody has used."""
    if MISSING is not None:
        pytest.skip(MISSING)
    with browser() as one:
        yield one
