"""Emulated skins that tests record from."""

from threading import Thread

import pytest

from skin.wire.emulator import Emulator, EmulatorSettings, TcpPort


@pytest.fixture
def emulate():
    """Return a function that plays a device at a port and returns the emulator; nothing is left behind."""
    playing = []

    def begin(device, count=7, **settings):
        chosen = EmulatorSettings(**{"speed": 40.0, "idle": 4.0, "rate": 40.0} | settings)
        emulator = Emulator(device, TcpPort(0), chosen)
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
