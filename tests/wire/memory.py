"""Streams of bytes from memory in place of ports; waiting for other threads and processes."""

from time import monotonic, sleep

from skin.wire.skin import open_skin

PATIENCE = 300  # s, on a machine that is busy with other things


def until(found, process=None, wanted=None):
    """Wait until a function gives ``wanted``, or anything true, and return it; ``process`` must not end."""
    deadline = monotonic() + PATIENCE
    while not (result := found()) if wanted is None else (result := found()) != wanted:
        assert monotonic() < deadline, f"waited in vain: {result}"
        assert process is None or process.poll() is None, "ended while waited for"
        sleep(0.05)
    return result


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
