"""Announcements: comments of the text protocol in which an emulated skin describes its next gesture."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from skin.wire.text import crc16
from skin.wire.transport import ByteStream

_KNOWN = ("number", "seq", "frames")
_LONGEST = 4096  # bytes
_KEPT = 64  # announcements that are kept unread


@dataclass(frozen=True)
class Announcement:
    """The labels and the window of the gesture that follows.

    Attributes:
        number: of the gesture, from 0.
        seq: number of the frame in which its window begins.
        frames: of the device in its window.
        labels: name -> 0 or 1.
    """

    number: int
    seq: int
    frames: int
    labels: Mapping[str, int] = field(default_factory=dict)


def encode_announcement(announcement: Announcement) -> bytes:
    """Return ``# gesture number=0 seq=300 frames=300 big=1 ...*HHHH``, LF at its end."""
    pairs = {name: getattr(announcement, name) for name in _KNOWN} | dict(announcement.labels)
    body = ("# gesture " + " ".join(f"{name}={value}" for name, value in pairs.items())).encode()
    return body + b"*%04X\n" % crc16(body)


def parse_announcement(line: bytes) -> Announcement | None:
    """Return the announcement in a line without its end; None for other lines and wrong checksums."""
    body, _, tail = line.removesuffix(b"\r").rpartition(b"*")
    if not body.startswith(b"# gesture ") or tail != b"%04X" % crc16(body):
        return None
    try:
        pairs = dict(word.split("=", 1) for word in body.decode("ascii").split()[2:])
        numbers = {name: int(value) for name, value in pairs.items()}
        number, seq, frames = (numbers.pop(name) for name in _KNOWN)
        return Announcement(number, seq, frames, numbers)
    except (KeyError, ValueError):
        return None


class AnnouncementListener:
    """An opener for ``open_skin`` that passes bytes through and collects the announcements among them.

    Args:
        opener: opens the stream of bytes.

    Attributes:
        announcements: announcements that have not been read yet.
    """

    def __init__(self, opener: Callable[[], ByteStream]) -> None:
        self._opener = opener
        self.announcements: deque[Announcement] = deque(maxlen=_KEPT)

    def __call__(self) -> ByteStream:
        """Open the stream; called again after each disconnection."""
        self._stream, self._rest = self._opener(), b""
        self.announcements.clear()
        return self

    def read(self) -> bytes:
        """Return the received bytes."""
        data = self._stream.read()
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-_LONGEST:]
        self.announcements.extend(found for line in lines if (found := parse_announcement(line)))
        return data

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()
