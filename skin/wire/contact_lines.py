"""Lines in which an emulated skin announces the contacts of its next gesture, one per frame with contact.

They are comments of the text protocol, after the announcement of the gesture, in m, N and Pa, with CRC-16:
``# contacts v=1 rate=10 number=0 lines=12 frames=30 most=3 frame=4 c0=x,y,radius,force,peak c1=...*HHHH``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan

import numpy as np

from skin.touch.labels import CONTACT
from skin.wire.protocol import crc16

_VERSION = 1
_NUMBERS = ("number", "lines", "frames", "most", "frame")
MOST_CONTACTS = 100
"""Contacts at a time that a line or a session may have."""
_MOST_FRAMES = 100_000


@dataclass(frozen=True)
class ContactLine:
    """The contacts in one frame of the gesture that follows.

    Attributes:
        number: of the gesture, from 0.
        lines: number of such lines of the gesture.
        rate: of the model's frames, Hz.
        frames: of the model in the window.
        most: K, contacts at a time.
        frame: of the model, from 0.
        contacts: number of a contact, below K -> its x, y, radius (m), force (N) and peak pressure (Pa).
    """

    number: int
    lines: int
    rate: float
    frames: int
    most: int
    frame: int
    contacts: Mapping[int, tuple[float, ...]]


def contact_lines(number: int, contacts: np.ndarray, rate: float) -> list[ContactLine]:
    """Return the lines of a gesture.

    Args:
        number: of the gesture.
        contacts: (T, K, 5), as of :class:`skin.device.touches.Touches`.
        rate: of the model, Hz.
    """
    present = np.isfinite(contacts).all(axis=2)
    touched = np.flatnonzero(present.any(axis=1)).tolist()
    window, most = contacts.shape[:2]
    return [
        ContactLine(number, len(touched), rate, window, most, frame, _present(contacts[frame]))
        for frame in touched
    ]


def _present(contacts: np.ndarray) -> dict[int, tuple[float, ...]]:
    """Return the contacts (K, 5) that are there, by their numbers."""
    places = np.flatnonzero(np.isfinite(contacts).all(axis=1)).tolist()
    return {place: tuple(contacts[place].tolist()) for place in places}


def join_contact_lines(lines: Sequence[ContactLine], window: int, rate: float) -> np.ndarray | None:
    """Return the contacts (T, K, 5) of a gesture; None if a line is missing, or of another window or rate.

    Args:
        lines: of one gesture.
        window: T, frames of the model.
        rate: of the model, Hz.
    """
    frames = {line.frame: line for line in lines}
    if not lines or any(
        (line.frames, line.rate, line.lines) != (window, rate, len(frames)) or line.most != lines[0].most
        for line in lines
    ):
        return None
    contacts = np.full((window, lines[0].most, len(CONTACT)), nan)
    for line in frames.values():
        for place, values in line.contacts.items():
            contacts[line.frame, place] = values
    return contacts


def encode_contact_line(line: ContactLine) -> bytes:
    """Return ``# contacts v=1 rate=10 ...*HHHH``, LF at its end."""
    pairs = {name: getattr(line, name) for name in ("rate", *_NUMBERS)}
    words = [f"{name}={value:.9g}" for name, value in pairs.items()]
    words += [
        f"c{place}={','.join(f'{value:.9g}' for value in values)}" for place, values in line.contacts.items()
    ]
    body = f"# contacts v={_VERSION} {' '.join(words)}".encode("ascii")
    return body + b"*%04X\n" % crc16(body)


def parse_contact_line(line: bytes) -> ContactLine | None:
    """Return the contacts in a line without its end; None for other lines, versions and wrong checksums."""
    body, _, tail = line.removesuffix(b"\r").rpartition(b"*")
    start = b"# contacts v=%d " % _VERSION
    if not body.startswith(start) or tail != b"%04X" % crc16(body):
        return None
    try:
        pairs = dict(word.split("=", 1) for word in body[len(start) :].decode("ascii").split())
        number, lines, frames, most, frame = (int(pairs.pop(name)) for name in _NUMBERS)
        rate = float(pairs.pop("rate"))
        contacts = {int(name[1:]): tuple(map(float, values.split(","))) for name, values in pairs.items()}
    except (KeyError, ValueError):
        return None
    sound = (
        0 <= frame < frames <= _MOST_FRAMES
        and most <= MOST_CONTACTS
        and set(contacts) <= set(range(most))
        and all(len(values) == len(CONTACT) and all(map(isfinite, values)) for values in contacts.values())
    )
    return ContactLine(number, lines, rate, frames, most, frame, contacts) if sound else None
