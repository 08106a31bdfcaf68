"""Contacts on the page and in JSON lines, beside what an emulated skin announces of its fingertips."""

import json
import re
import socket
from contextlib import ExitStack, suppress
from threading import Event, Lock, Thread
from time import monotonic, sleep
from urllib.request import urlopen

import numpy as np
import pytest

from skin.wire.protocol import parse_announcement

PATIENCE = 300  # s, on a machine that is busy with other things
ENOUGH = 40  # estimates of a touch that stands still
RATE = 100.0  # Hz

SKIN = (
    "layout=grid",
    "layout.rows=5",
    "layout.columns=5",
    "body.size=[0.12,0.12]",
    "body.cells=[24,24]",
    "body.layers=[{material: Dragon Skin 10 Medium, thickness: 0.01}, "
    "{material: EcoFlex 00-30, thickness: 0.02}]",
)
TOUCHES = (
    "touch=fingertips",
    "touch.contacts=[1,2]",
    "touch.force=3",
    "touch.apart=0.02",
    "touch.press=[1.5,2]",
    # As the run was trained with.
    "simulator=solid",
    "simulator.divisions=3",
)


class Tap:
    """Passes on what the emulated skin sends to ``skin live``, and reads the announcements.

    Attributes:
        truth: frame of the model -> contacts (K, 5); the first is that at 0 s of the device's clock.
    """

    def __init__(self, port):
        self.truth, self._starts, self._lock = {}, {}, Lock()
        self._over, self._emulator = Event(), port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._thread = Thread(target=self._run, name="tap")
        self._thread.start()

    def _run(self):
        with suppress(OSError):
            reader, _ = self._server.accept()
            with reader, socket.create_connection(("127.0.0.1", self._emulator)) as skin:
                skin.settimeout(0.5)
                rest = b""
                while not self._over.is_set():
                    with suppress(TimeoutError):
                        data = skin.recv(4096)
                        *lines, rest = (rest + data).split(b"\n")
                        # Known before it can be felt.
                        for line in lines:
                            self._note(line)
                        reader.sendall(data)

    def _note(self, line):
        if (gesture := parse_announcement(line)) is not None:
            begin, present = gesture.seq / RATE, np.isfinite(gesture.contacts).all(axis=2)
            with self._lock:
                for frame in np.flatnonzero(present.any(axis=1)):
                    contacts = gesture.contacts[frame, present[frame]]
                    self.truth[round(begin * gesture.rate) + frame] = contacts

    def held(self, time):
        """Return contacts (K, 5) that were the same over the readings of an estimate at ``time``, s, or None.

        The readings are those of 0.1 s, in which a frame of the model of as long may end.
        """
        with self._lock:
            frames = [self.truth.get(round(10 * time) - back) for back in (0, 1, 2)]
        if any(frame is None for frame in frames):
            return None
        same = all(frame.shape == frames[0].shape for frame in frames)
        return (
            frames[0] if same and all(np.allclose(frame, frames[0], rtol=0.02) for frame in frames) else None
        )

    def close(self):
        """End."""
        self._over.set()
        self._server.close()
        self._thread.join()


def until(found, process, what):
    """Wait until a function gives something true, and return it."""
    deadline = monotonic() + PATIENCE
    while monotonic() < deadline:
        assert process.poll() is None, f"ended while waiting for {what}"
        if result := found():
            return result
        sleep(0.2)
    raise AssertionError(f"waited in vain for {what}")


@pytest.fixture(scope="module")
def watched(begin, tmp_path_factory):
    """Return what the emulated skin announces, the address of the page, and the command."""
    folder = tmp_path_factory.mktemp("watched")
    with ExitStack() as opened:
        emulator = opened.enter_context(begin(folder, "emulate", "port=tcp:0", *SKIN, *TOUCHES))
        found = until(
            lambda: re.search(r"socket://127\.0\.0\.1:(\d+) device\.scale=(\S+)\n", emulator.out),
            emulator,
            "it",
        )
        tap = Tap(int(found[1]))
        opened.callback(tap.close)
        words = ["run=any_skin", *SKIN, "web=true", "live.web_port=0", "live.verdicts=stdout"]
        words += ["live.patience.above=0.97", "live.touch=0.3", "live.selftest=false"]
        words += ["device=serial", f"device.port=socket://127.0.0.1:{tap.port}", f"device.scale={found[2]}"]
        live = opened.enter_context(begin(folder, "live", *words))
        page = until(lambda: re.search(r"page: (http\S+)", live.err), live, "the page")[1]
        yield tap, page, live


def agrees(tap, told):
    """Return how many estimates agree with the truth, and how many there are, each once."""
    errors = {}
    for contacts in told:
        truth = tap.held(contacts["device_time"]) if contacts["device_time"] is not None else None
        if truth is not None:
            errors[contacts["device_time"]] = agree(contacts, truth)
    return errors


def agree(contacts, truth):
    """Return the errors of the place, m, and of the force, relative; infinite for another number."""
    if contacts["number"] != len(truth):
        return np.inf, np.inf
    positions = np.array([[contact["x"], contact["y"]] for contact in contacts["contacts"]])
    forces = np.array([contact["force"] for contact in contacts["contacts"]])
    distance = np.linalg.norm(positions[:, None] - truth[:, :2], axis=2)
    nearest = distance.argmin(axis=1)
    if len(set(nearest.tolist())) < len(truth):
        return np.inf, np.inf
    return distance.min(axis=1).max(), np.abs(forces / truth[nearest, 3] - 1).max()


def check(errors):
    """Check that the number of contacts is usually right, and then place and force."""
    position, force = np.array(list(errors.values())).T
    right = np.isfinite(position)
    assert right.mean() > 0.8
    assert np.median(position[right]) < 0.004
    assert np.median(force[right]) < 0.15


@pytest.mark.slow("watches a live view for long")
def test_page_and_json_lines_agree_with_what_is_announced(watched):
    tap, page, live = watched
    pictures, deadline = [], monotonic() + PATIENCE
    with urlopen(f"{page}/pictures", timeout=PATIENCE) as events:
        for line in events:
            if line.startswith(b"data: "):
                pictures.append(json.loads(line.removeprefix(b"data: "))["contacts"])
            if len(pictures) % 100 == 99 and len(agrees(tap, pictures)) >= ENOUGH:
                break
            assert monotonic() < deadline, len(agrees(tap, pictures))
    lines = [json.loads(line)["contacts"] for line in live.out.splitlines(True) if line.endswith("\n")]
    for told in (pictures, lines):
        check(agrees(tap, told))
    # The same estimate is the same everywhere.
    by_time = {contacts["device_time"]: contacts for contacts in lines}
    shared = [contacts for contacts in pictures if contacts["device_time"] in by_time]
    assert len(shared) > ENOUGH
    assert all(by_time[contacts["device_time"]] == contacts for contacts in shared if contacts["device_time"])
    assert {contacts["number"] for contacts in lines} >= {0, 1, 2}


@pytest.mark.slow("watches a live view in a browser")
def test_the_browser_shows_them_in_newtons_and_kilopascals(watched, browser):
    tap, page, _ = watched
    browser.open(page)
    script = "return latest ? [latest.contacts, document.getElementById('contacts').innerText] : null"
    seen, deadline = {}, monotonic() + PATIENCE
    while len(agrees(tap, [contacts for contacts, _ in seen.values()])) < ENOUGH / 4:
        assert monotonic() < deadline, len(seen)
        if told := browser.run(script):
            seen[told[0]["device_time"]] = told
        sleep(0.03)
    check(agrees(tap, [contacts for contacts, _ in seen.values()]))
    texts = "\n".join(text for _, text in seen.values())
    assert re.search(r"2 contacts \(\d+ %\)\n\(\d+, \d+\) ± \d+ mm, [\d.]+ ± [\d.]+ N, \d+ to \d+ kPa", texts)
    # Pink is in no colour of the map: the region is drawn.
    pink = """
        const map = document.getElementById("map");
        const dots = map.getContext("2d").getImageData(0, 0, map.width, map.height).data;
        let count = 0;
        const drawn = n => dots[n] > 230 && dots[n + 1] < 130 && dots[n + 2] > 180;
        for (let n = 0; n < dots.length; n += 4) count += drawn(n);
        return [latest.contacts.contacts.length, count];
    """
    while not (drawn := browser.run(pink))[0]:
        assert monotonic() < deadline
        sleep(0.02)
    assert drawn[1] > 20
