"""A real browser, driven over HTTP as the W3C's WebDriver has it: no package is needed for that."""

import json
import re
import shutil
import subprocess
import urllib.request
from base64 import b64decode

import pytest

OPTIONS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--window-size=1100,860",
]
_PATIENCE = 180  # s


class Browser:
    """A headless Chromium behind its driver."""

    def __init__(self, driver: str, binary: str) -> None:
        self._process = subprocess.Popen([driver, "--port=0"], stdout=subprocess.PIPE, text=True)
        found = next(
            found
            for line in self._process.stdout
            if (found := re.search(r"successfully on port (\d+)", line))
        )
        self._address = f"http://127.0.0.1:{found[1]}/session"
        chrome = {"goog:chromeOptions": {"binary": binary, "args": OPTIONS}}
        made = self._ask("", {"capabilities": {"alwaysMatch": chrome}})
        self._address += f"/{made['sessionId']}"

    def _ask(self, path: str, body: dict | None = None):
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            self._address + path, data, {"Content-Type": "application/json; charset=utf-8"}
        )
        with urllib.request.urlopen(request, timeout=_PATIENCE) as answer:
            return json.load(answer)["value"]

    def open(self, address: str) -> None:
        """Go to a page."""
        self._ask("/url", {"url": address})

    def run(self, script: str):
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
        self._process.stdout.close()


@pytest.fixture(scope="module")
def browser():
    """Return a headless Chromium; skip where there is none."""
    driver = shutil.which("chromedriver")
    binary = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
    if not driver or not binary:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    one = Browser(driver, binary)
    yield one
    one.close()
