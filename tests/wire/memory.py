"""Streams of bytes from memory in place of ports."""

from time import sleep

from skin.wire.skin import open_skin

PATIENT = 60.0  # s: machines are busy at times


class Sent:
    """A stream whose bytes were sent before it was opened, one piece a read.

    Args:
        pieces: of bytes.
        end: whether the stream ends behind them; else it falls silent.
        pause: s that a read without bytes takes.

    Attributes:
        closed: whether it was closed.
        written: what was sent to it.
    """

    def __init__(self, *pieces, end=True, pause=0.001):
        self._pieces, self._end, self._pause = list(pieces), end, pause
        self.closed, self.written = False, b""

    def read(self):
        if self._pieces:
            return self._pieces.pop(0)
        if self._end:
            raise OSError("the stream has ended")
        sleep(self._pause)
        return b""

    def write(self, data):
        self.written += data

    def close(self):
        self.closed = True


def opened(*pieces, layout=4, end=False, **settings):
    return open_skin("memory", range(layout), opener=lambda: Sent(*pieces, end=end), **settings)
