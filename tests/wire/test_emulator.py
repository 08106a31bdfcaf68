"""The emulator: its gestures, its converter and how it ends; its ports: who listens, and what they hear."""

import os
import socket
from functools import partial
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest

from skin import Grid, InputError
from skin.device.resampling import resample
from skin.wire.decoder import Decoder
from skin.wire.emulator import Converter, Emulator, EmulatorSettings, PtyPort, TcpPort, upsample
from skin.wire.reader import PortStream, check_port
from tests.made_up import naive_skin
from tests.wire.memory import until

RATE = 10.0


def drawn():
    """Return readings of 30 frames in which touches last 1, 2 and 5 frames, of either sign."""
    force = np.zeros((30, 3))
    force[4] = [3.0, 1.0, -0.2]
    force[10:12] = [[2.0, 0.5, -0.1], [1.0, 2.5, -0.4]]
    force[20:25] = np.arange(1.0, 6.0)[:, None] * [1.0, 0.3, -0.05]
    return force


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 100.0, 1000.0])
def test_the_maximum_over_each_interval_is_the_frame(rate):
    force = drawn()
    felt = upsample(force, RATE, rate)
    time = np.arange(len(felt)) / rate
    known = np.ones_like(felt, dtype=bool)
    back = resample(time, felt, known, ~known, 3.0 - 0.5 / rate, 1 / RATE, 30)
    assert back.valid.all()
    assert back.values == pytest.approx(force, abs=1e-12)


def test_force_rises_and_falls_without_a_jump():
    felt = upsample(drawn(), RATE, 1000.0)
    # A quarter of a frame has 25 samples: no step is larger than a 25th of the largest change between frames.
    assert np.abs(np.diff(felt, axis=0)).max() <= 5.0 / 25 + 1e-9


def test_counts_are_those_of_a_converter():
    converter = Converter(10, clip=10.0)
    assert converter.scale == pytest.approx(20 / 512)
    said = converter(np.array([0.0, converter.scale, -100.0, 100.0]))
    assert said.tolist() == [512, 513, 0, 1023]
    assert Converter(None, 10.0)(np.array([0.25])).tolist() == [0.25]


@pytest.mark.parametrize("waits_for", ["a reader", "the next frame", "its power"])
def test_it_stops_wherever_it_waits(waits_for):
    device = naive_skin(layout=Grid(2, 2))
    port = TcpPort(0)
    rate = 0.005 if waits_for == "the next frame" else 100.0
    unplug = [0.01] if waits_for == "its power" else []
    emulator = Emulator(device, port, EmulatorSettings(rate=rate, idle=600.0, unplug=unplug, away=600.0))
    thread = Thread(target=emulator.run)
    thread.start()
    try:
        if waits_for != "a reader":
            with socket.create_connection(("127.0.0.1", int(port.address.rpartition(":")[2]))) as reader:
                assert reader.recv(1)
                if waits_for == "its power":
                    until(lambda: not port.connected())
    finally:
        emulator.stop()
        thread.join(20)
        port.unplug()
    assert not thread.is_alive()


def test_it_says_that_it_is_emulated_and_fails_when_it_should():
    """Nobody must check its scale. Channel 1 sticks and 2 dies from 0.5 s on; nothing is sent for 0.3 s."""
    written = []
    port = SimpleNamespace(write=lambda data: written.append(data) or len(data), connected=lambda: True)
    device = naive_skin(layout=Grid(2, 2), noise=0.3)
    faults = {"stuck": [1], "dead": [2], "since": 0.5, "silence": [1.2], "away": 0.3}
    Emulator(device, port, EmulatorSettings(speed=50.0, idle=2.0, **faults)).run(2.0)
    decoder = Decoder(4)
    frames = decoder.feed(b"".join(written))
    assert decoder.header.id == "emulated"
    assert {frame.seq for frame in frames} == {*range(120), *range(150, 200)}
    before, after = (np.stack([f.values for f in frames if (f.seq > 50) == late]) for late in (False, True))
    assert (np.ptp(before, axis=0) > 0).all()
    assert (np.ptp(after, axis=0) > 0).tolist() == [True, False, False, True]
    assert after[0, 1:3].tolist() == [before[-1, 1], 0]
    with pytest.raises(InputError, match=r"emulate.dead=\[4\] must be below 4"):
        Emulator(device, SimpleNamespace(), EmulatorSettings(dead=[4]))


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_it_knows_who_listens_and_is_heard_and_is_plugged_in_at_the_same_address(kind, tmp_path):
    link = str(tmp_path / "skin")
    make = partial(PtyPort, link) if kind == "pty" else partial(TcpPort, 0)
    port = make()
    assert not port.connected()
    stream, address, data = PortStream(port.address, 115200), port.address, bytes(range(256)) * 8
    try:
        until(port.connected)
        assert port.write(data) == len(data)
        heard = bytearray()
        until(lambda: heard.extend(stream.read()) or len(heard) == len(data))
        assert heard == data
        port.unplug()
        with pytest.raises(OSError, match=r"disconnected|Input/output"):
            list(iter(stream.read, None))
        with pytest.raises(InputError, match=r"cannot reach|no port"):
            PortStream(address, 115200)
        port.plug()
        assert port.address == address == (link if kind == "pty" else address)
        match = r"cannot make link=.* another name|cannot listen .* give port=0"
        with pytest.raises(InputError, match=match):
            make() if kind == "pty" else TcpPort(int(address.rpartition(":")[2]))
        PortStream(address, 115200).close()
    finally:
        stream.close()
        port.unplug()
    assert not os.path.lexists(link)


def test_a_port_that_does_not_exist_is_refused_before_a_run_is_loaded():
    for port in ("/dev/none", "./skin-port"):
        with pytest.raises(InputError, match=f"no port {port}"):
            check_port(port)
    for port in ("COM3", "rfc2217://host:1", "socket://192.0.2.1:7", "null"):
        check_port(port)  # these cannot be checked


def test_a_file_is_left_alone_and_a_link_that_leads_nowhere_is_taken_over(tmp_path):
    link = tmp_path / "skin"
    link.write_text("keep")
    with pytest.raises(InputError, match="cannot make link"):
        PtyPort(str(link))
    assert link.read_text() == "keep"
    link.unlink()
    link.symlink_to("/dev/pts/nothing")
    PtyPort(str(link)).unplug()
    assert not link.is_symlink()
