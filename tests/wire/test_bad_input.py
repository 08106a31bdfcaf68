"""What a person meets at a real pseudo-terminal, beyond tests/port/test_open_skin.py."""

import os
from threading import Thread
from time import monotonic, sleep

import numpy as np
import pytest

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.live.engine import Detection, Engine
from skin.live.loop import LiveLoop
from skin.record.serial import Serial, record_session
from skin.record.session import read_session
from skin.touch.labels import TOUCH
from skin.wire.protocol import Header, encode_header, encode_line
from skin.wire.skin import open_skin
from skin.wire.tare import Tare

PATIENT = 300.0  # s: machines are busy at times
SHEET = Sheet((0.16, 0.16), (32, 32), [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize(
    ("rate", "said"),
    [*((rate, " (short taps read low below 100 Hz)") for rate in (10, 20, 50)), (100, "")],
)
def test_a_rate_that_misses_the_peaks_of_taps_stands_in_the_status_line(plug, rate, said):
    values = np.random.default_rng(0).integers(400, 600, (60, 6))
    with open_skin(plug.port, range(6)) as skin:
        plug.send(*(encode_line(row.tolist(), n, 1_000_000 // rate * n) for n, row in enumerate(values)))
        skin.read(60, timeout=PATIENT)
        assert LiveLoop(skin, Tare(None, 0.0, 10.0), engine(), None).line == f"{rate}.0 Hz{said}"


def engine():
    """Return an engine at 10 Hz that has nothing to say."""
    return Engine(lambda readings, valid: [0.0] * len(TOUCH.names), TOUCH, 6, 30, 10.0, Detection(0.3))


def sent(cable, stop, first=0):
    """Send frames at a hundredth of a second each, ten times as fast, from number ``first`` on."""
    rng, number = np.random.default_rng(first), 0
    try:
        while not stop():
            if number % 100 == 0:
                cable.send(encode_header(Header(n=4, rate=100.0, unit="N")))
            cable.send(encode_line(rng.normal(scale=0.02, size=4).round(4), number, 10_000 * number))
            number += 1
            sleep(0.001)
    except OSError:
        return


def test_an_unplugged_skin_is_recorded_on_with_a_gap_marker(new_plug, tmp_path):
    link, path, said = tmp_path / "skin", tmp_path / "s", []

    def whole():
        return len(list(path.glob("gesture_*"))) if path.exists() else 0

    def life():
        """Be plugged in until a gesture is whole; be unplugged in the middle of the next, and come back."""
        deadline = monotonic() + PATIENT
        for end in (lambda: whole() >= 1, lambda: over):
            cable = new_plug()
            link.unlink(missing_ok=True)
            os.symlink(cable.port, link)
            ready.append(True)
            sent(cable, lambda end=end: end() or monotonic() > deadline)
            cable.unplug()

    ready, over = [], []
    thread = Thread(target=life, daemon=True)
    thread.start()
    while not ready:
        sleep(0.001)
    settings = {"touch": {"window": 1.0}, "tare": 1.0, "timeout": PATIENT, "backoff": (0.01, 0.05)}
    device = Serial(body=SHEET, layout=Grid(2, 2), port=str(link), **settings)
    record_session(device, path, 8.0, True, said.append)
    over.append(True)
    thread.join(PATIENT)
    stored = read_session(path)
    rows = [row for table in stored.tables for row in table.to_pylist()]
    assert [row["after"] for row in rows if row["after"]] == ["reconnect"]
    assert len(stored.gestures) == whole() >= 3
    for number in stored.gestures:
        inside = [row for row in rows if row["gesture"] == number]
        assert len({row["segment"] for row in inside}) == 1
        assert np.diff([row["time"] for row in inside]).max() < 0.02
