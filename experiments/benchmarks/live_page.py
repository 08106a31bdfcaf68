"""Measure the frame rate of the live page in a headless Chromium, and take a screenshot of an alarm.

skin live web=true                                          # in one terminal
skin bench benchmark=live_page                              # in another
skin bench benchmark=live_page benchmark.seconds=60 benchmark.alarm=live.png
"""

import sys
from collections import deque
from pathlib import Path
from time import monotonic, sleep

from pydantic import PositiveFloat

from experiments.benchmarks.browser import Browser, installed

_SIZE = 1100, 800  # pixels
_LOOK = 0.1  # s between two looks at the page
_LOOKS = 3  # in which a press must be seen
_HARD = 3.0  # N, from which on a picture shows a press

_COUNT = "window.refreshes = 0; (function count() { refreshes++; requestAnimationFrame(count); })();"
_STATE = "return [performance.now() / 1000, pictures, refreshes]"
_ALARM = "return document.body.dataset.state === 'danger' ? Math.max(...latest.values) : 0"
_LINE = "return document.getElementById('line').textContent"


def measure_refresh(
    address: str, seconds: PositiveFloat, alarm: str | Path | None = None
) -> dict[str, float | str]:
    """Return the drawn frames and browser refreshes of a page per second, and its last status line.

    Args:
        address: URL of the live page.
        seconds: duration of the measurement.
        alarm: path for a screenshot of the strongest press that is classified as dangerous.
    """
    found = installed()
    if found is None:
        sys.exit("needs Chromium and its driver: apt-get install chromium chromium-driver")
    browser = Browser(*found, _SIZE)
    try:
        browser.open(address)
        browser.run(_COUNT)
        while not browser.run("return pictures"):
            sleep(_LOOK)
        before = browser.run(_STATE)
        if alarm is None:
            sleep(seconds)
        else:
            _picture(browser, seconds, Path(alarm))
        passed, pictures, refreshes = (
            now - then for now, then in zip(browser.run(_STATE), before, strict=True)
        )
        line = browser.run(_LINE)
    finally:
        browser.close()
    return {
        "pictures_per_second": pictures / passed,
        "refreshes_per_second": refreshes / passed,
        "line": line,
    }


def _picture(browser: Browser, seconds: float, path: Path) -> None:
    """Write a screenshot of the strongest lasting press that is classified as dangerous."""
    until, hardest = monotonic() + seconds, _HARD
    looks = deque([0.0] * _LOOKS, maxlen=_LOOKS)
    while monotonic() < until:
        looks.append(browser.run(_ALARM))
        if min(looks) > hardest:
            picture = browser.picture()
            # The press may have ended while the picture was taken.
            if browser.run(_ALARM) > hardest:
                hardest = min(looks)
                path.write_bytes(picture)
        sleep(_LOOK)
