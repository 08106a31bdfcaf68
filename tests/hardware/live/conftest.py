"""A headless browser for those who look at the page."""

import pytest

from skin.paths import ROOT


@pytest.fixture(scope="module")
def browser():
    """Return a headless Chromium; skip where there is none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "experiments")
        from experiments.benchmarks.browser import Browser, installed
    found = installed()
    if found is None:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    one = Browser(*found)
    yield one
    one.close()
