"""A device that lost its power never says that it is gone: a socket without data is opened again."""

import logging
import shutil
import socket
import subprocess
import sys
from itertools import count, islice
from time import monotonic

import numpy as np
import pytest

from skin.errors import InputError
from skin.wire.decoder import Decoder
from skin.wire.protocol import encode_line
from skin.wire.reader import WireFeed
from skin.wire.skin import open_skin
from tests.wire.memory import Sent

LAYOUT = range(4)
PATIENT = 60.0  # s: machines are busy at times
HASTY = {"reconnect": True, "silence": 0.3, "backoff": (0.01, 0.04)}
LINK = "socket://127.0.0.1:1"


def lines(*numbers, values=(500, 501, 502, 503)):
    return b"".join(encode_line(values, number, number * 10_000) for number in numbers)


def test_a_peer_that_stops_sending_is_left_and_found_again(caplog):
    """By a socket, whose connection stays open, as after a power cut in the middle of a frame."""
    caplog.set_level(logging.WARNING, "skin.wire")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENT)
        address = f"socket://127.0.0.1:{server.getsockname()[1]}"
        with open_skin(address, LAYOUT, **HASTY) as skin:
            first, _ = server.accept()
            first.sendall(lines(*range(5)) + b"5,50000,500,5")
            second, _ = server.accept()
            second.sendall(lines(*range(3)))
            frames = skin.read(8, timeout=PATIENT)
            assert (skin.stats.reconnects, skin.stats.bad_frames) == (1, 0)
            assert first.recv(1) == b""
            first.close()
            second.close()
    assert [frame.seq for frame in frames] == [0, 1, 2, 3, 4, 0, 1, 2]
    assert [frame.after for frame in frames] == [""] * 5 + ["reconnect", "", ""]
    assert [frame.segment for frame in frames] == [0] * 5 + [1] * 3
    assert "unplugged (nothing received for 0.3 s)" in caplog.text


def polled(pieces, silence, step=0.1):
    """Poll a feed every ``step`` s; return its frames and when it was found silent."""
    feed, times = WireFeed(lambda: Sent(*pieces, end=False, pause=0), Decoder(4), None, silence), count()
    frames = []
    for _ in range(len(pieces) + 20):
        now = step * next(times)
        try:
            frames += feed.poll(lambda now=now: now)
        except TimeoutError:
            return frames, now
    return frames, np.inf


@pytest.mark.parametrize(
    ("pieces", "silence", "found"),
    [
        ([lines(*range(3))], 0.5, 0.5),  # from the last byte on
        ([], 0.5, 0.5),  # from the opening on
        ([lines(0, 1, 2), b"", b"", b"", lines(3), b"", b"", b""], 0.5, 0.9),
        ([piece for n in range(12) for piece in (lines(n), b"", b"", b"")], 0.5, np.inf),  # seldom
        ([lines(*range(3))], np.inf, np.inf),
    ],
)
def test_silence_counts_from_the_last_byte(pieces, silence, found):
    frames, when = polled(pieces, silence)
    last = max((n for n, piece in enumerate(pieces) if piece), default=0)
    assert when == pytest.approx(found if len(pieces) < 40 else 0.1 * last + silence)
    assert len(frames) == sum(piece.count(b"\n") for piece in pieces)


@pytest.mark.parametrize(
    ("address", "settings", "silence"),
    [
        (LINK, {}, 0.3),
        (LINK, {"silence": 0}, np.inf),
        (LINK, {"silence": None}, np.inf),
        (LINK, {"reconnect": False}, np.inf),
        ("/dev/ttyACM0", {}, np.inf),  # the system tells of a serial port that is gone
    ],
)
def test_silence_is_borne_where_that_is_asked_for(address, settings, silence):
    with open_skin(address, LAYOUT, opener=lambda: Sent(end=False), **HASTY | settings) as skin:
        assert skin._feed._silence == silence


def test_a_peer_that_accepts_and_never_sends_is_tried_less_and_less_often():
    """Iterating does not give up although the timeout passes: the skin comes back again and again."""
    streams, times = [Sent(end=False) for _ in range(5)] + [Sent(lines(*range(4)), end=False)], []

    def opener():
        times.append(monotonic())
        return streams[len(times) - 1]

    settings = HASTY | {"silence": 0.02, "backoff": (0.01, 10.0), "timeout": 0.1}
    with open_skin(LINK, LAYOUT, opener=opener, **settings) as skin:
        assert [frame.seq for frame in islice(skin, 4)] == [0, 1, 2, 3]
        assert skin.stats.reconnects == 5
    assert all(stream.closed for stream in streams)
    # 0.02 s of silence, and 0.01, 0.02 ... 0.16 s between two attempts
    assert times[-1] - times[-2] >= 0.17


def test_another_number_of_sensors_after_silence_is_refused():
    streams = iter((Sent(lines(*range(3)), end=False), Sent(lines(*range(300), values=(5, 6, 7)), end=False)))
    settings = HASTY | {"silence": 0.02, "timeout": PATIENT}
    with (
        open_skin(LINK, LAYOUT, opener=lambda: next(streams), **settings) as skin,
        pytest.raises(InputError, match="sends 3 values per frame, the layout has 4"),
    ):
        list(skin)


@pytest.mark.parametrize("silence", [-1, float("nan"), float("inf")])
def test_a_silence_that_is_no_time_is_refused(silence):
    with pytest.raises(InputError, match=r"device\.silence=.* must be .*: as in device.silence=5"):
        open_skin("socket://127.0.0.1:1", silence=silence)


NETWORK = """
import logging, socket, subprocess, sys, threading, time
from skin.wire import reader as transport
from skin.wire.skin import open_skin
from skin.wire.protocol import encode_line
ip = lambda *words: subprocess.run(["ip", "link", "set", "lo", *words], check=True)
ip("up")
server = socket.create_server(("127.0.0.1", 0))
port = f"socket://127.0.0.1:{server.getsockname()[1]}"
frames = b"".join(encode_line([1, 2, 3, 4], n, n) for n in range(4))
logging.basicConfig(format="%(message)s", stream=sys.stdout)
transport._KEEPALIVE.update(TCP_KEEPIDLE=1, TCP_KEEPINTVL=1, TCP_KEEPCNT=1)
with open_skin(port, range(4), reconnect=True, silence=float(sys.argv[1]), backoff=(0.05, 0.1)) as skin:
    first, _ = server.accept()
    first.sendall(frames)
    skin.read(4, 30)
    ip("down")
    while not skin.away:
        time.sleep(0.01)
    time.sleep(0.5)
    ip("up")
    second, _ = server.accept()
    second.sendall(frames)
    print([frame.after for frame in skin.read(4, 30)], skin.stats.reconnects)
"""


@pytest.mark.slow("waits for silence to be noticed")
@pytest.mark.parametrize(("silence", "reason"), [(0.5, "nothing received for 0.5 s"), (0, "timed out")])
def test_a_cable_that_is_cut_in_between(silence, reason):
    # A network of its own whose only link goes down: no segment tells of it, as where a router fails.
    if shutil.which("unshare") is None or subprocess.call(
        ["unshare", "-rn", "ip", "link"], stdout=-3, stderr=-3
    ):
        pytest.skip("this system gives no network namespaces")
    command = ["unshare", "-rn", sys.executable, "-c", NETWORK, str(silence)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENT, check=False)
    assert done.returncode == 0, done.stderr
    assert reason in done.stdout
    assert done.stdout.endswith("['reconnect', '', '', ''] 1\n")
