"""A device that lost its power never says that it is gone: a socket without data is opened anew."""

import logging
import select
import shutil
import socket
import subprocess
import sys
from itertools import islice
from time import monotonic, sleep

import pytest

from skin.errors import InputError
from skin.wire.protocol import encode_line
from skin.wire.reader import SkinTimeout
from skin.wire.skin import open_skin

LAYOUT = range(4)
PATIENT = 60.0  # s: machines are busy at times
HASTY = {"reconnect": True, "silence": 0.3, "backoff": (0.01, 0.04)}


def lines(*numbers, values=(500, 501, 502, 503)):
    return b"".join(encode_line(values, number, number * 10_000) for number in numbers)


@pytest.fixture
def server():
    """Return a listening socket that waits for PATIENT s at most."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(PATIENT)
        yield listening


def address(server):
    return f"socket://127.0.0.1:{server.getsockname()[1]}"


def test_a_peer_that_stops_sending_is_left_and_found_again(server, caplog):
    caplog.set_level(logging.WARNING, "skin.wire")
    with open_skin(address(server), LAYOUT, **HASTY) as skin:
        first, _ = server.accept()
        # In the middle of a frame; the connection stays open, as after a power cut.
        first.sendall(lines(*range(5)) + b"5,50000,500,5")
        second, _ = server.accept()
        second.sendall(lines(*range(3)))
        frames = skin.read(8, timeout=PATIENT)
        assert skin.stats.reconnects == 1
        assert skin.stats.bad_frames == 0
        assert first.recv(1) == b""
        first.close()
        second.close()
    assert [frame.seq for frame in frames] == [0, 1, 2, 3, 4, 0, 1, 2]
    assert [frame.after for frame in frames] == [""] * 5 + ["reconnect", "", ""]
    assert [frame.segment for frame in frames] == [0] * 5 + [1] * 3
    assert "unplugged (nothing received for 0.3 s)" in caplog.text


def test_a_peer_that_accepts_and_never_sends_is_tried_less_and_less_often(server):
    # Iterating does not give up although the timeout passes: the skin comes back again and again.
    settings = HASTY | {"silence": 0.1, "backoff": (0.02, 10.0), "timeout": 0.3}
    with open_skin(address(server), LAYOUT, **settings) as skin:
        peers, times = [], []
        for _ in range(6):
            peers.append(server.accept()[0])
            times.append(monotonic())
        peers[-1].sendall(lines(*range(4)))
        assert [frame.seq for frame in islice(skin, 4)] == [0, 1, 2, 3]
        for peer in peers:
            peer.close()
    # 0.1 s of silence, and 0.02, 0.04 ... 0.32 s between two attempts
    assert times[-1] - times[-2] >= 0.4
    assert skin.stats.reconnects == 5


@pytest.mark.parametrize("settings", [{"silence": 0}, {"silence": None}, {"reconnect": False}])
def test_silence_is_borne_where_that_is_asked_for(server, settings):
    with open_skin(address(server), LAYOUT, **HASTY | {"silence": 0.1} | settings) as skin:
        peer, _ = server.accept()
        with pytest.raises(SkinTimeout, match="nothing received"):
            skin.read(1, timeout=0.4)
        peer.sendall(lines(0, 1, 2))
        assert len(skin.read(3, timeout=PATIENT)) == 3
        assert skin.stats.reconnects == 0
        peer.close()


def test_a_silent_serial_port_is_left_open(plug):
    with open_skin(plug.port, LAYOUT, **HASTY | {"silence": 0.1}) as skin:
        plug.send(lines(0, 1, 2))
        skin.read(3, timeout=PATIENT)
        sleep(0.4)
        plug.send(lines(3))
        assert skin.read(1, timeout=PATIENT)[0].after == ""
        assert skin.stats.reconnects == 0


def test_who_sends_seldom_is_not_silent(server):
    with open_skin(address(server), LAYOUT, **HASTY | {"silence": 0.6}) as skin:
        peer, _ = server.accept()
        for number in range(12):
            peer.sendall(lines(number))
            sleep(0.07)
        assert [frame.after for frame in skin.read(12, timeout=PATIENT)] == [""] * 12
        peer.close()


def test_another_number_of_sensors_after_silence_is_refused(server):
    with open_skin(address(server), LAYOUT, **HASTY | {"timeout": PATIENT}) as skin:
        first, _ = server.accept()
        first.sendall(lines(*range(3)))
        second, _ = server.accept()
        second.sendall(lines(*range(300), values=(5, 6, 7)))
        with pytest.raises(InputError, match="sends 3 values per frame, the layout has 4"):
            list(skin)
        first.close()
        second.close()


def test_the_port_is_closed_while_a_peer_is_silent(server):
    with open_skin(address(server), LAYOUT, **HASTY) as skin:
        first, _ = server.accept()
        second, _ = server.accept()
    assert skin.stats.reconnects == 1
    for peer in (first, second):
        assert select.select([peer], [], [], PATIENT)[0]
        assert peer.recv(1) == b""
        peer.close()


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
