"""What survives a faulty wire: a pseudo-terminal, 1 % of its lines spoilt."""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import psutil

from skin.core.files import ROOT
from skin.device.resampling import Check, Frame
from skin.wire.decoder import Stats
from skin.wire.protocol import encode_line
from skin.wire.reader import SkinTimeout
from skin.wire.skin import Skin, open_skin

SENSORS = 25
_SPOILT = 0.01
_WHOLE = 10  # lines at the beginning that are whole, so that the format shows
_MINUTE = 60.0  # s after which memory is compared; a tenth of a short soak
_LATE = 0.05  # s: a piece that comes later than that was held up by the machine
_BURST = 16  # bytes


def soak(seconds: float, check: Check = "crc16", rate: float = 500.0) -> dict[str, float]:
    """Read from a pseudo-terminal that another process fills, one line of a hundred spoilt.

    A spoilt line has two bits flipped, has lost two bytes, has lost its end and glues to the next, has a run
    of up to 16 bytes overwritten at random, has lost such a run, or says it twice.

    Returns:
        frames ``sent`` and ``intact``, those ``delivered`` with the right values, ``wrong`` ones taken for
        right, ``missed`` ones (intact, but not delivered); the resident memory after a minute, or a tenth
        of a short soak, and at the end, bytes; the rate reached, Hz, and how many lines were sent more than
        50 ms late; the shares of a core that reader, with this comparison, and sender took.
    """
    import tty  # not on Windows, where the rest of this runs

    master, slave = os.openpty()
    tty.setraw(slave)
    tally = _Tally(round(seconds * rate), after=min(_MINUTE, seconds / 10))
    code = f"from tests.wire.faulty_wire import _send; _send({master}, {seconds}, {check!r}, {rate})"
    command = [sys.executable, "-c", code]
    sender = subprocess.Popen(
        command, pass_fds=[master], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT
    )
    assert sender.stdin is not None
    assert sender.stdout is not None
    try:
        with open_skin(os.ttyname(slave), range(SENSORS)) as skin:
            sender.stdout.readline()  # it is ready
            sender.stdin.write(b"go\n")
            sender.stdin.flush()
            tally.watch(skin, sender)
            stats = skin.stats
        on_event = json.loads(sender.stdout.read())
    finally:
        sender.kill()
        sender.communicate()
        os.close(master)
        os.close(slave)
    return tally.figures(stats, check) | on_event


@dataclass
class _Tally:
    """Compares what comes with what was sent.

    Attributes:
        count: frames that are sent.
        after: s when memory is looked at for the first time.
    """

    count: int
    after: float
    wrong: int = 0
    memory: list[int] = field(default_factory=list)
    core_fraction: float = 0.0

    def __post_init__(self) -> None:
        self.right = np.zeros(self.count, dtype=bool)
        self._resident = partial(psutil.Process().memory_info)

    def watch(self, skin: Skin, sender: "subprocess.Popen[bytes]") -> None:
        """Take frames until the sender has ended and nothing more comes."""
        began, start, ended = time.process_time(), time.monotonic(), False
        while True:
            frames = _frames(skin)
            if ended and not frames:
                break
            ended = sender.poll() is not None
            for frame in frames:
                self._take(frame)
            if not self.memory and time.monotonic() - start >= self.after:
                self.memory.append(self._resident().rss)
        self.core_fraction = (time.process_time() - began) / (time.monotonic() - start)
        self.memory.append(self._resident().rss)

    def _take(self, frame: Frame) -> None:
        seq = frame.seq or 0
        if seq < self.count and frame.values.tolist() == _values(seq):
            self.right[seq] = True
        else:
            self.wrong += 1

    def figures(self, stats: Stats, check: Check) -> dict[str, float]:
        """Return what became of the frames."""
        spoilt = _spoilt(self.count)
        glued = np.array([_kind(number)[0] == 2 for number in np.flatnonzero(spoilt).tolist()], dtype=bool)
        intact = ~spoilt
        # The line that another glues itself to is lost with it.
        intact[np.minimum(np.flatnonzero(spoilt)[glued] + 1, self.count - 1)] = False
        # Without a CRC the first line is left out: it may be half a line.
        intact[0] = check == "crc16"
        return {
            "sent": self.count,
            "intact": int(intact.sum()),
            "delivered": int(self.right.sum()),
            "missed": int((intact & ~self.right).sum()),
            "wrong": self.wrong,
            "bad_frames": stats.bad_frames,
            "dropped": stats.dropped,
            "gaps": stats.gaps,
            "resets": stats.resets,
            "memory_early_bytes": self.memory[0],
            "memory_end_bytes": self.memory[-1],
            "reader_core_share": self.core_fraction,
        }


def _frames(skin: Skin) -> list[Frame]:
    """Return what came: all that waits, after the first."""
    try:
        first = skin.read(1, 1.0)
    except SkinTimeout as few:
        return few.frames
    try:
        return first + skin.read(1024, 0.0)
    except SkinTimeout as few:
        return first + few.frames


def _values(number: int) -> list[int]:
    return [(number * (7 + channel) + 31 * channel) % 1024 for channel in range(SENSORS)]


def _line(number: int, period: float, check: Check) -> bytes:
    return encode_line(_values(number), number, round(number * period * 1e6) % 2**32, check)


def _spoilt(count: int) -> np.ndarray:
    """Return which lines are spoilt, (count,), bool: drawn at once, for a draw each would cost the sender."""
    chosen = np.random.default_rng(1).random(count) < _SPOILT
    chosen[:_WHOLE] = False
    return chosen


def _kind(number: int) -> tuple[int, np.random.Generator]:
    draw = np.random.default_rng((2, number))
    return int(draw.integers(6)), draw


def _spoil(number: int, line: bytes) -> bytes:
    kind, draw = _kind(number)
    data, first, run = bytearray(line[:-1]), int(draw.integers(len(line) - 1)), int(draw.integers(2, _BURST))
    if kind == 0:
        for position in draw.integers(len(data), size=2).tolist():
            data[position] ^= 1 << int(draw.integers(8))
    elif kind == 1:
        for _ in range(2):
            del data[int(draw.integers(len(data)))]
    elif kind == 2:
        return bytes(data)
    elif kind == 3:
        data[first : first + run] = draw.bytes(len(data[first : first + run]))
    elif kind == 4:
        del data[first : first + run]
    else:
        data[first:first] = data[first : first + run]
    return bytes(data) + b"\n"


def _send(master: int, seconds: float, check: Check, rate: float) -> None:
    """Send a line each period, by the clock: what is late is made up for; then print how that went."""
    count, late = round(seconds * rate), 0
    spoilt = _spoilt(count).tolist()
    print("ready", flush=True)
    sys.stdin.readline()
    began, worked = time.monotonic(), time.process_time()
    for number in range(count):
        line = _line(number, 1 / rate, check)
        piece = _spoil(number, line) if spoilt[number] else line
        wait = began + number / rate - time.monotonic()
        late += wait < -_LATE
        if wait > 0:
            time.sleep(wait)
        while piece:
            piece = piece[os.write(master, piece) :]
    passed = time.monotonic() - began
    fraction = (time.process_time() - worked) / passed
    print(json.dumps({"rate_hz": count / passed, "late": late, "sender_core_share": fraction}), flush=True)
