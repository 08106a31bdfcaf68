"""An emulator that plays in a thread ends when it is told to, whatever it waits for."""

import socket
import time
from threading import Thread
from types import SimpleNamespace

import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.device.simulated import Simulated
from skin.mechanics.simulator.naive import Naive
from skin.wire.emulator import Emulator, EmulatorSettings, Faults, open_port

SHEET = Sheet((0.16, 0.16), (16, 16), [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize("waits_for", ["a reader", "the next frame", "its power"])
def test_it_stops_wherever_it_waits(waits_for):
    device = Simulated(body=SHEET, layout=Grid(2, 2), simulator=Naive, gestures=10)
    port = open_port("tcp:0", None)
    rate = 0.005 if waits_for == "the next frame" else 100.0
    faults = Faults(unplug=[0.0], away=600.0) if waits_for == "its power" else Faults()
    emulator = Emulator(device, port, EmulatorSettings(rate=rate, idle=600.0), faults)
    thread = Thread(target=emulator.run)
    thread.start()
    try:
        if waits_for != "a reader":
            with socket.create_connection(("127.0.0.1", int(port.address.rpartition(":")[2]))) as reader:
                assert reader.recv(1)
                deadline = time.monotonic() + 20
                while waits_for == "its power" and port.connected():
                    assert time.monotonic() < deadline
    finally:
        emulator.stop()
        thread.join(20)
        port.unplug()
    assert not thread.is_alive()


@pytest.mark.parametrize(("name", "sent"), [("emulated-2", "emulated-2"), ("arm-L", "emulated-arm-L")])
def test_its_header_says_that_it_is_emulated(name, sent):
    """Nobody must check its scale, and no id may hide that."""
    written = []
    port = SimpleNamespace(write=written.append)
    device = SimpleNamespace(sensors=[0], seed=0, constants=SimpleNamespace(clip=torch.ones(1)))
    Emulator(device, port, EmulatorSettings(id=name), Faults())._header()
    assert f"id={sent}" in written[0].decode().partition("*")[0].split()
