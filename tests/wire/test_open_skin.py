"""A skin on a real pseudo-terminal or socket, what goes wrong with one, and a recording in place of one."""

import errno
import os
import signal
import socket
import subprocess
import sys
from itertools import count, islice
from threading import Event
from time import monotonic, sleep

import numpy as np
import pytest
import serial

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.live.engine import Detection, Engine
from skin.live.loop import LiveLoop
from skin.runs.build import build_device
from skin.touch.labels import TOUCH
from skin.wire.channels import Reason
from skin.wire.decoder import Decoder
from skin.wire.emulator import PtyPort
from skin.wire.protocol import Header, encode_header, encode_line
from skin.wire.reader import PlaybackFeed, SkinDisconnected, SkinTimeout, WireFeed
from skin.wire.skin import Source, open_skin, play
from skin.wire.tare import Tare
from tests.wire.memory import PATIENCE, Sent, opened, until

LAYOUT = range(4)


def line(number, values=(500, 501, 502, 503), period=10_000):
    return encode_line(values, number, number * period)


def lines(*numbers, **how):
    return b"".join(line(number, **how) for number in numbers)


def numbers(frames):
    return [frame.seq for frame in frames]


def test_frames_of_a_serial_port_until_it_is_unplugged(plug):
    with open_skin(plug.port, LAYOUT) as skin:
        before = monotonic()
        plug.send(*(encode_line([1, 0, 3, number], number, 10_000 * number) for number in range(300)))
        frames = skin.read(300, timeout=PATIENCE)
        stats = skin.stats
        plug.unplug()
        for read in (lambda: skin.read(1, timeout=PATIENCE), lambda: next(iter(skin))):
            with pytest.raises(SkinDisconnected, match="unplugged"):
                read()
    assert numbers(frames) == list(range(300))
    assert frames[9].values.tolist() == [1, 0, 3, 9]
    assert frames[9].t == pytest.approx(0.09)
    assert before < frames[0].t_host <= frames[-1].t_host <= monotonic()
    assert (stats.frames, stats.bad_frames, stats.dropped, stats.format) == (300, 0, 0, "text")
    assert stats.rate_hz == pytest.approx(100)


def test_a_peer_at_a_socket_that_stops_sending_is_left_and_found_again_and_its_end(caplog):
    """A connection stays open after a power cut in the middle of a frame."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)
        address = f"socket://127.0.0.1:{server.getsockname()[1]}"
        settings = {"reconnect": True, "silence": 0.3, "backoff": (0.01, 0.04)}
        with open_skin(address, LAYOUT, **settings) as skin, server.accept()[0] as first:
            first.sendall(lines(*range(5)) + b"5,50000,500,5")
            with server.accept()[0] as second:
                second.sendall(lines(*range(3)))
                frames = skin.read(8, timeout=PATIENCE)
                assert (skin.stats.reconnects, skin.stats.bad_frames) == (1, 0)
            assert first.recv(1) == b""
    assert numbers(frames) == [0, 1, 2, 3, 4, 0, 1, 2]
    assert [frame.after for frame in frames] == [""] * 5 + ["reconnect", "", ""]
    assert [frame.segment for frame in frames] == [0] * 5 + [1] * 3
    assert "unplugged (nothing received for 0.3 s)" in caplog.text


def test_the_end_of_a_socket_is_an_error_after_what_came_before():
    with socket.create_server(("127.0.0.1", 0)) as server:
        skin = open_skin(f"socket://127.0.0.1:{server.getsockname()[1]}", LAYOUT)
        device, _ = server.accept()
    with skin:
        device.sendall(lines(50, 51, 52))
        device.close()
        with pytest.raises(SkinDisconnected, match="disconnected") as caught:
            skin.read(4, timeout=PATIENCE)
        assert numbers(caught.value.frames) == [50, 51, 52]


@pytest.mark.parametrize(
    ("pieces", "reason", "arrived"),
    [
        ([], "port open, nothing received", []),
        ([b"hello\n"], "no frame in 6 bytes", []),
        ([lines(0, 1, 2)], r"3 of 100 frames arrived within 0.3 s: .* stopped sending", [0, 1, 2]),
    ],
)
def test_silence_is_told_apart_from_nonsense_and_carries_what_came(pieces, reason, arrived):
    with opened(*pieces, timeout=0.3) as skin:
        with pytest.raises(SkinTimeout, match=reason) as caught:
            skin.read(100)
        assert numbers(caught.value.frames) == arrived
        with pytest.raises(SkinTimeout):
            next(iter(skin))


def test_a_pseudo_terminal_is_unplugged_and_plugged_in_again(tmp_path):
    port = PtyPort(str(tmp_path / "skin"))
    try:
        with open_skin(port.address, LAYOUT, reconnect=True, backoff=(0.01, 0.02)) as skin:
            for connection in range(3):
                until(port.connected)
                port.write(lines(*range(50)))
                frames = skin.read(50, timeout=PATIENCE)
                assert frames[0].after == ("reconnect" if connection else "")
                assert numbers(frames) == list(range(50))
                port.unplug()
                until(lambda: skin.away)
                port.plug()
    finally:
        port.unplug()


def test_while_it_is_away_it_is_tried_again_and_said():
    other = b"".join(line(number, [5, 6, 7]) for number in range(300))
    streams, back = [Sent(lines(0, 1, 2))], Event()

    def opener():
        if not streams and not back.is_set():
            raise InputError("no port")
        return streams.pop() if streams else Sent(other, end=False)

    with open_skin("x", LAYOUT, opener=opener, reconnect=True, backoff=(0.01, 0.02)) as skin:
        skin.read(3, timeout=PATIENCE)
        until(lambda: skin.away)
        with pytest.raises(SkinTimeout, match="unplugged; trying again"):
            skin.read(1, timeout=0.1)
        back.set()
        with pytest.raises(InputError, match="sends 3 values per frame, the layout has 4"):
            skin.read(1, timeout=PATIENCE)


def test_who_is_late_loses_the_oldest_frames_and_is_informed():
    with opened(lines(*range(100)), queue=10) as skin:
        # A frame counts when it is decoded, before it waits to be read.
        until(lambda: skin.stats.dropped == 90)
        frames = skin.read(10)
        assert (numbers(frames), skin.stats.dropped) == (list(range(90, 100)), 90)
    assert [(frame.lost, frame.after) for frame in frames[:2]] == [(90, "gap"), (0, "")]


@pytest.mark.parametrize(
    ("port", "reason"),
    [
        ("/dev/ttyACM77", r"no port /dev/ttyACM77: there (are /dev/|is no serial port)"),
        (os.devnull, "is not a serial port"),
        (__file__, "is not a serial port"),
        ("socket://127.0.0.1:1", "does anything listen there"),
        ("socket://nowhere", "cannot reach"),
    ],
)
def test_a_port_that_is_none_is_refused(port, reason):
    with pytest.raises(InputError, match=reason):
        open_skin(port, LAYOUT)


def test_a_port_in_use_and_a_forbidden_one_are_refused(plug, monkeypatch):
    with open_skin(plug.port), pytest.raises(InputError, match="in use: close the serial monitor"):
        open_skin(plug.port)

    def refuse(*_, **__):
        raise serial.SerialException(errno.EACCES, "Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(InputError, match="may not be opened: add your user to dialout"):
        open_skin("/dev/ttyACM0")


def status(skin):
    engine = Engine(lambda readings, valid: [0.0] * 4, TOUCH, 6, 30, 10.0, Detection(0.3))
    return LiveLoop(skin, Tare(None, 0.0, 10.0), engine, None).line


@pytest.mark.parametrize(("rate", "said"), [(10, " (short taps read low below 100 Hz)"), (100, "")])
def test_a_rate_that_misses_the_peaks_of_taps_stands_in_the_status_line(rate, said):
    with opened(lines(*range(60), period=1_000_000 // rate)) as skin:
        skin.read(60, timeout=PATIENCE)
        assert status(skin).startswith(f"{rate}.0 Hz{said}")


def test_channels_that_mean_nothing_are_masked_and_named():
    rng = np.random.default_rng(0)
    values = rng.integers(400, 600, (800, 6))
    values[:, 1] = 0  # never a change
    values[200:, 2] = 444  # none any more
    values[-1, 3] = 1023
    data = b"".join(line(number, row.tolist()) for number, row in enumerate(values))
    with opened(encode_header(Header(n=6, bits=10)), data, layout=6) as skin:
        frames = skin.read(800, timeout=PATIENCE)
        assert skin.channels == ("ok", "dead", "stuck", "saturated", "ok", "ok")
        assert "sensor 1 dead, sensor 2 stuck, sensor 3 saturated" in status(skin)
    assert frames[100].valid.all()
    assert frames[-1].valid.tolist() == [True, False, False, True, True, True]
    assert frames[-1].saturated.tolist() == [False, False, False, True, False, False]
    assert frames[-1].mask.tolist() == [0, Reason.DEAD, Reason.STUCK, Reason.SATURATED, 0, 0]


def test_tare_and_a_touch(plug):
    rng, pressed = np.random.default_rng(0), []

    def values(number):
        return rng.integers(499, 502, 4) + np.array([0, 0, 300 * bool(pressed), 0])

    with open_skin(plug.port, LAYOUT, timeout=PATIENCE) as skin, plug.sending(values):
        baseline = skin.tare(0.5)
        assert baseline == pytest.approx([500] * 4, abs=1.01)
        pressed.append(True)
        sleep(0.3)
        with pytest.raises(InputError, match=r"channel 2 differs from its old baseline by (299|30[01])"):
            skin.tare(0.5)
        assert skin.baseline is baseline
        assert skin.tare(0.5, force=True)[2] == pytest.approx(800, abs=1.01)


def test_tare_while_the_device_restarts_is_refused():
    with opened(*[lines(*range(20))] * 5000, timeout=PATIENCE) as skin:
        with pytest.raises(InputError, match="restarted"):
            skin.tare(0.1)
        assert skin.baseline is None


def test_ctrl_c_ends_a_read_that_waits(plug):
    code = (
        "import sys; from skin.wire.skin import open_skin\n"
        "with open_skin(sys.argv[1]) as skin:\n"
        "    print('open', flush=True)\n"
        "    skin.read(1, timeout=600)\n"
    )
    command = [sys.executable, "-c", code, plug.port]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"open\n"
        sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert b"KeyboardInterrupt" in process.communicate(timeout=PATIENCE)[1]


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


def test_a_peer_that_accepts_and_never_sends_is_tried_less_and_less_often():
    """Iterating does not give up although the timeout passes: the skin comes back again and again."""
    streams, times = [Sent(end=False) for _ in range(5)] + [Sent(lines(*range(4)), end=False)], []

    def opener():
        times.append(monotonic())
        return streams[len(times) - 1]

    settings = {"reconnect": True, "silence": 0.02, "backoff": (0.01, 10.0), "timeout": 0.1}
    with open_skin("socket://127.0.0.1:1", LAYOUT, opener=opener, **settings) as skin:
        assert [frame.seq for frame in islice(skin, 4)] == [0, 1, 2, 3]
        assert skin.stats.reconnects == 5
    assert all(stream.closed for stream in streams)
    # 0.02 s of silence, and 0.01, 0.02 ... 0.16 s between two attempts
    assert times[-1] - times[-2] >= 0.17


@pytest.mark.parametrize(
    ("address", "settings"),
    [("/dev/ttyACM0", {"silence": 0.02}), ("socket://127.0.0.1:1", {"silence": None})],
)
def test_a_silent_port_is_left_open(address, settings):
    """Opening a serial port again would restart many boards."""
    opener = lambda: Sent(end=False)  # noqa: E731
    with open_skin(address, LAYOUT, opener=opener, reconnect=True, timeout=0.3, **settings) as skin:
        with pytest.raises(SkinTimeout):
            skin.read(1)
        assert skin.stats.reconnects == 0


@pytest.fixture(scope="module")
def touches(configured):
    device = build_device(configured("simulator=naive", "device.dead=1"))
    return device.replace(gestures=12).recording().touches


def test_touches_are_played_in_their_time_to_their_end(touches):
    feed, times = PlaybackFeed([touches[:4]]), count(100.0, 0.5)
    frames = [frame for _ in range(120) for frame in feed.poll(lambda: next(times))]
    with pytest.raises(EOFError):
        feed.poll(lambda: next(times))
    assert frames[5].t_host - frames[0].t_host == pytest.approx(0.5)
    played = np.stack([frame.values for frame in frames]).reshape(4, 30, 25)
    assert played == pytest.approx(touches[:4].readings.numpy())
    assert np.stack([frame.valid for frame in frames]).sum() == 120 * 24
    assert [frame.after for frame in frames[28:32]] == ["", "", "cut", ""]
    assert frames[-1].segment == 3


def test_a_skin_that_is_played_ends(touches):
    with play([touches[:1]]) as skin:
        assert len(list(skin)) == skin.stats.frames == 30
        with pytest.raises(SkinDisconnected, match="recording has ended"):
            skin.read(1)


def test_values_in_newtons_stay_what_they_are():
    values, valid = np.array([0.5, -1.0, 7.0]), np.array([True, True, False])
    source = Source.in_newtons("recording", None, 3)
    source.tare.add(Frame(0, 0.0, 0.0, values, valid))
    said, known = source.tare.conversion(values, valid)
    assert said.tolist() == [0.5, -1.0, 0.0]
    assert known.tolist() == valid.tolist()
