"""A real browser, driven over HTTP as the W3C's WebDriver has it: no package is needed for that.

On an idle machine, this records the animation of the README:

    skin live demo=true 'touch.press=[0.8,1.5]'
    python -m tests.browser http://127.0.0.1:8765 docs/results/live.gif
"""

import json
import re
import shutil
import subprocess
import sys
import urllib.request
from base64 import b64decode
from collections import deque
from io import BytesIO
from time import monotonic, sleep
from typing import Any

from PIL import Image

_OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage")
_PATIENCE = 180  # s


def installed() -> tuple[str, str] | None:
    """Return where Chromium's driver and Chromium are; None where one of them is missing."""
    driver = shutil.which("chromedriver")
    binary = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
    return (driver, binary) if driver and binary else None


class Browser:
    """A headless Chromium behind its driver.

    Args:
        driver: its path.
        binary: Chromium's path.
        size: of the window, pixels.
    """

    def __init__(self, driver: str, binary: str, size: tuple[int, int] = (1100, 860)) -> None:
        self._process = subprocess.Popen([driver, "--port=0"], stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        search = (re.search(r"successfully on port (\d+)", line) for line in self._process.stdout)
        found = next(filter(None, search))
        self._address = f"http://127.0.0.1:{found[1]}/session"
        options = [*_OPTIONS, f"--window-size={size[0]},{size[1]}"]
        chrome = {"goog:chromeOptions": {"binary": binary, "args": options}}
        made = self._ask("", {"capabilities": {"alwaysMatch": chrome}})
        self._address += f"/{made['sessionId']}"

    def _ask(self, path: str, body: dict[str, Any] | None = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        head = {"Content-Type": "application/json; charset=utf-8"}
        request = urllib.request.Request(self._address + path, data, head)
        with urllib.request.urlopen(request, timeout=_PATIENCE) as answer:
            return json.load(answer)["value"]

    def open(self, address: str) -> None:
        """Go to a page."""
        self._ask("/url", {"url": address})

    def run(self, script: str) -> Any:
        """Return what a script returns."""
        return self._ask("/execute/sync", {"script": script, "args": []})

    def picture(self) -> bytes:
        """Return the page as a PNG."""
        return b64decode(self._ask("/screenshot"))

    def close(self) -> None:
        """End browser and driver."""
        urllib.request.urlopen(urllib.request.Request(self._address, method="DELETE"), timeout=30).close()
        self._process.terminate()
        self._process.wait(30)
        if self._process.stdout is not None:
            self._process.stdout.close()


def record(address: str, path: str, frames: int = 26, interval: float = 0.3, after: int = 6) -> None:
    """Write what a page shows up to an alarm, and ``after`` frames more, as GIF; octrees keep rare colours.

    Earlier frames show contacts in a quarter of them, else it waits for another alarm.
    """
    browser, shots, states = Browser(*(installed() or sys.exit("needs Chromium"))), deque(maxlen=frames), ""
    browser.open(address)
    begin, number = monotonic() + 5, 0
    while not re.search(f"[^d]{{{after}}}d{{{after}}}$", states) or states[-frames:].count("c") < frames // 4:
        sleep(max(0.0, begin + number * interval - monotonic()))
        shot = Image.open(BytesIO(browser.picture())).convert("RGB")
        shot = shot.resize((shot.width * 3 // 4, shot.height * 3 // 4))
        shots.append(shot.quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
        states += browser.run(
            "return document.body.dataset.state == 'danger' ? 'd'"
            " : document.getElementById('contacts').textContent.includes('±') ? 'c' : '-'"
        )
        number += 1
    browser.close()
    shots[0].save(path, save_all=True, append_images=list(shots)[1:], duration=round(1e3 * interval), loop=0)


if __name__ == "__main__":
    record(*sys.argv[1:3])
