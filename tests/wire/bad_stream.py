"""A stream of valid, damaged and invalid frames and noise, and what a decoder recovers of it.

Frames are encoded independently of the package. The check uses only which frames were sent intact.
"""

from collections import deque
from dataclasses import dataclass
from itertools import islice
from random import Random

from skin.device.resampling import Frame
from skin.wire.decoder import Decoder
from tests.wire.independent_frames import (
    FORMATS,
    WireFormat,
    binary_frame,
    damage,
    invalid_frame,
    text_line,
)

_HEAD = 10  # good frames at the beginning, so that the format shows
_LENGTHS = (0, 1, 3, 20, 130, 500, 3000)  # bytes, at most, of a chunk; drawn alike
_PERIOD = 2000  # microseconds
_SOUP = b"0123456789,.;-+eE* #\t\r\nnaif_x"
_NO_NUMBERS = (b"nan", b"-inf", b"1e400", b"1_0", b"0x1F", b"--1", b"1.2.3", b"\xd9\xa3", b"1 2", b"")
_AHEAD = 50  # frames that are looked for after one that did not come
_LONG = 70_000  # bytes: longer than any line may be


def fuzz(count: int, spoken: WireFormat, sensors: int, seed: int) -> dict[str, int]:
    """Feed a decoder with ``count`` chunks of a stream of valid, damaged and invalid frames, and noise.

    Args:
        count: of chunks, of 0 to 3000 bytes each.
        spoken: the checksum of the lines, or ``binary``.
        sensors: S.
        seed: of the random generator.

    Returns:
        ``chunks`` and ``bytes``; ``pieces``: frames and fragments in them; ``good``: those sent intact behind
        a delimiter, ``recovered`` or ``missed``; ``wrong``: frames decoded with wrong values.

    Raises:
        Exception: any error of the decoder, which should raise none.
    """
    rng, decoder = (
        Random(f"{spoken} {sensors} {seed}"),
        Decoder(sensors),
    )
    stream = _Stream(rng, spoken, sensors)
    oracle = _Oracle(stream)
    for _ in range(count):
        chunk = stream.chunk(rng.randint(0, rng.choice(_LENGTHS)))
        for frame in decoder.feed(chunk, stream.time):
            oracle.take(frame)
    for frame in decoder.feed(stream.rest(), stream.time):
        oracle.take(frame)
    missed = oracle.missed + len(stream.expected)
    return {
        "chunks": count,
        "bytes": stream.sent,
        "pieces": stream.pieces,
        "good": oracle.recovered + missed,
        "recovered": oracle.recovered,
        "missed": missed,
        "wrong": oracle.wrong,
    }


class _Stream:
    """An endless stream of bytes, and the frames in it that a decoder must find.

    Attributes:
        expected: numbers of the frames that are intact, stand behind a delimiter and have not been seen.
        pieces, sent: frames and fragments, and bytes, that were made so far.
    """

    def __init__(self, rng: Random, spoken: WireFormat, sensors: int) -> None:
        self._rng, self._spoken, self._sensors = rng, spoken, sensors
        self._end = b"\0" if spoken == "binary" else b"\n"
        self.expected: deque[int] = deque()
        self.pieces = self.sent = self._count = 0
        self._bytes, self._behind = bytearray(), True
        for _ in range(_HEAD):
            self._good()
        if spoken in ("xor", "none"):
            self.expected.popleft()  # without a CRC the first line may be half a line, and is left out

    @property
    def time(self) -> float:
        """Of the latest frame by the device's clock, s."""
        return self._count * _PERIOD * 1e-6

    def chunk(self, length: int) -> bytes:
        """Return the next bytes."""
        kinds = self._good, self._damaged, self._senseless, self._noise, self._again
        while len(self._bytes) < length:
            self._rng.choices(kinds, (60, 20, 10, 9, 1))[0]()
        taken = bytes(self._bytes[:length])
        del self._bytes[:length]
        return taken

    def rest(self) -> bytes:
        """Return the remaining bytes."""
        return self.chunk(len(self._bytes))

    def values(self, number: int) -> list[float]:
        """Return the values of a frame by its number: unsigned or signed integers, or fractions."""
        kind = number % 3
        return [
            ((number * (7 + channel) + 31 * channel) % 1024) / (8 if kind == 2 else 1) - 100 * (kind == 1)
            for channel in range(self._sensors)
        ]

    def _put(self, piece: bytes) -> None:
        self._bytes += piece
        self.sent += len(piece)
        self.pieces += 1
        self._behind = piece.endswith(self._end)

    def _next(self) -> int:
        self._count += 1
        return self._count % 2**16

    def _good(self) -> None:
        number = self._next()
        if self._behind:
            self.expected.append(number)
        self._put(self._frame(number))

    def _again(self) -> None:
        """An old frame once more, as from a device that starts anew; it may be taken or not."""
        self._put(self._frame(max(0, self._count - self._rng.randint(0, 3)) % 2**16))

    def _damaged(self) -> None:
        self._put(damage(self._frame(self._next()), self._rng))

    def _frame(self, number: int) -> bytes:
        clock, values = self._count * _PERIOD % 2**32, self.values(number)
        if self._spoken == "binary":
            return binary_frame(number, clock, values, number % 3 + 1)
        separator, end = self._rng.choice((b",", b";", b"\t", b" ")), self._rng.choice((b"\n", b"\r\n"))
        return text_line(_fields(number, clock, values), separator, self._spoken) + end

    def _senseless(self) -> None:
        """A frame whose checksum is right and whose content is not: no value of it may be taken as wrong."""
        number, rng = self._next(), self._rng
        clock, values = self._count * _PERIOD % 2**32, self.values(number)
        if self._spoken == "binary":
            self._put(invalid_frame(number, clock, values, number % 3 + 1, rng))
            return
        fields, trouble = _fields(number, clock, values), rng.randrange(5)
        check: WireFormat = self._spoken
        others: list[WireFormat] = [other for other in FORMATS if other not in (check, "binary")]
        if trouble == 0:
            fields[rng.randrange(len(fields) - 1)] = rng.choice(_NO_NUMBERS)
        elif trouble == 1:
            fields.append(b"5")
        elif trouble == 2:
            fields.pop()
        elif trouble == 3:
            fields[0] = rng.choice((b"-1", b"0.5"))
        else:
            check = rng.choice(others)
        self._put(text_line(fields, b",", check) + b"\n")

    def _noise(self) -> None:
        rng = self._rng
        kind, length = rng.random(), rng.choice((1, 10, 100, 400))
        if kind < 0.001:
            noise = b"7" * rng.randint(_LONG - 5000, _LONG)
        elif kind < 0.5:
            noise = rng.randbytes(length)
        elif kind < 0.6:
            noise = b"# skin proto=1 n=%d rate=50 unit=adc bits=99\n" % self._sensors
        else:
            noise = bytes(rng.choices(_SOUP, k=length))
        self._put(noise + (self._end if rng.random() < 0.7 else b""))


def _fields(number: int, clock: int, values: list[float]) -> list[bytes]:
    return [b"%d" % number, b"%d" % clock, *(b"%g" % value for value in values)]


@dataclass
class _Oracle:
    """Compares what comes with what was sent, in order."""

    stream: _Stream
    recovered: int = 0
    missed: int = 0
    wrong: int = 0

    def take(self, frame: Frame) -> None:
        """Take a frame; those that were to come before it are missed."""
        number, expected = frame.seq, self.stream.expected
        # A value that is sent as a word for none may only be invalid.
        if number is None or (frame.values != self.stream.values(number))[frame.valid].any():
            self.wrong += 1
            return
        position = next(
            (position for position, one in enumerate(islice(expected, _AHEAD)) if one == number), None
        )
        if position is not None:
            for _ in range(position + 1):
                expected.popleft()
            self.missed += position
            self.recovered += 1
