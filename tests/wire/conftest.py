"""A device made of a real pseudo-terminal: what is written to one end comes out of a serial port."""

import os
import termios
import tty
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from threading import Event, Thread
from time import monotonic

import pytest

from skin.wire.decoder import Decoder
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
            if self._open:
                termios.tcflush(self.slave, termios.TCIFLUSH)  # lets a write end that nobody reads
            self.unplug()
            thread.join(5)

    def sending(self, values: Callable[[int], Sequence[float]], rate: float = 200.0):
        start = monotonic()
        line = lambda number: encode_line(values(number), number, round((monotonic() - start) * 1e6))  # noqa: E731
        return self.streaming(line, 1 / rate)


@pytest.fixture
def plug():
    cable = Plug()
    yield cable
    cable.unplug()


@pytest.fixture
def decoder():
    return Decoder(4)
