"""A device made of a real pseudo-terminal: what is written to one end comes out of a serial port."""

import os
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from itertools import count
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
    def streaming(self, encode: Callable[[int], bytes], pause: float):
        """Send ``encode(0)``, ``encode(1)``, ... in the background, with a pause in s behind each."""
        stop = Event()

        def run() -> None:
            with suppress(OSError):
                for number in count():
                    if stop.wait(pause):
                        return
                    self.send(encode(number))

        thread = Thread(target=run, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            self.unplug()
            thread.join(5)

    def sending(self, values: Callable[[int], Sequence[float]], rate: float = 200.0, restart: int = 2**32):
        """Send frames in the background; the device starts anew after each ``restart`` frames."""
        starts = [monotonic()]

        def encode(number: int) -> bytes:
            if number % restart == 0:
                starts[0] = monotonic()
            return encode_line(values(number), number % restart, round((monotonic() - starts[0]) * 1e6))

        return self.streaming(encode, 1 / rate)


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
