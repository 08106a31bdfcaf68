"""A device made of a real pseudo-terminal: what is written to one end comes out of a serial port."""

import os
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from threading import Event, Thread
from time import monotonic

import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")
import tty

from skin.wire.protocol import encode_line


class Plug:
    """One end of a cable, whose other end is the serial port ``port``."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self._open = True

    def send(self, *pieces: bytes) -> None:
        for piece in pieces:
            while piece:
                piece = piece[os.write(self.master, piece) :]

    def unplug(self) -> None:
        if self._open:
            self._open = False
            os.close(self.master)
            os.close(self.slave)

    @contextmanager
    def sending(self, values: Callable[[int], Sequence[float]], rate: float = 200.0, restart: int = 2**32):
        """Send frames in the background; the device starts anew after each ``restart`` frames."""
        stop = Event()

        def run() -> None:
            number, start = 0, monotonic()
            with suppress(OSError):
                while not stop.wait(1 / rate):
                    if number == restart:
                        number, start = 0, monotonic()
                    self.send(encode_line(values(number), number, round((monotonic() - start) * 1e6)))
                    number += 1

        thread = Thread(target=run, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(5)


@pytest.fixture
def plug():
    """Return a cable that is plugged in."""
    cable = Plug()
    yield cable
    cable.unplug()


@pytest.fixture
def new_plug():
    """Return what makes cables, unplugged at the end."""
    cables: list[Plug] = []

    def make() -> Plug:
        cables.append(Plug())
        return cables[-1]

    yield make
    for cable in cables:
        cable.unplug()
