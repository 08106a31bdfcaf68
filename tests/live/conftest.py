"""A headless browser for those who look at the page."""

import pytest

from tests.browser import Browser, installed


@pytest.fixture(scope="module")
def browser():
    """Return a headless Chromium; skip where there is none."""
    found = installed()
    if found is None:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    one = Browser(*found)
    yield one
    one.close()
