"""Announcements: comments of the text protocol in which an emulated skin tells the next gesture."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from skin.wire.checksum import crc16

__all__ = ["Announcement", "encode", "parse"]

_KNOWN = ("number", "seq", "frames")


@dataclass(frozen=True)
class Announcement:
    """The truth about a gesture that follows.

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


def encode(said: Announcement) -> bytes:
    """Return ``# gesture number=0 seq=300 frames=300 big=1 ...*HHHH``, LF at its end."""
    pairs = {name: getattr(said, name) for name in _KNOWN} | dict(said.labels)
    body = ("# gesture " + " ".join(f"{name}={value}" for name, value in pairs.items())).encode()
    return body + b"*%04X\n" % crc16(body)


def parse(line: bytes) -> Announcement | None:
    """Return what a line without its end announces; None if it is another or its checksum is wrong."""
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
