"""Emulated skins that tests record from."""

import os
from threading import Thread

import pytest

from skin.wire.emulator import Emulator, EmulatorSettings, PtyPort, TcpPort


@pytest.fixture
def emulate():
    """Return a function that plays a device at a port and returns the emulator; nothing is left behind."""
    playing = []

    def begin(device, count=7, **settings):
        chosen = EmulatorSettings(**{"speed": 40.0, "idle": 4.0, "rate": 40.0} | settings)
        port = PtyPort(None) if hasattr(os, "openpty") else TcpPort(0)
        emulator = Emulator(device, port, chosen)
        thread = Thread(target=emulator.run, kwargs={"count": count})
        thread.start()
        playing.append((emulator, thread))
        return emulator

    yield begin
    for emulator, thread in playing:
        emulator.stop()
        thread.join(20)
        assert not thread.is_alive()
        emulator.port.unplug()
