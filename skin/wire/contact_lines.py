"""Lines in which an emulated skin announces the contacts of its next gesture, one per frame with contact.

They are notes of the text protocol (:func:`skin.wire.protocol.encode_note`), after the announcement of the
gesture, in m, N and Pa:
``# contacts {"number": 0, "lines": 12, ..., "contacts": {"0": [x, y, radius, force, peak]}}*HHHH``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite, nan

import numpy as np

from skin.touch.labels import CONTACT
from skin.wire.protocol import encode_note, parse_note

MOST_CONTACTS = 100
"""Contacts at a time that a line or a session may have."""
_MOST_FRAMES = 100_000  # of a window: a damaged or foreign line must not allocate more


@dataclass(frozen=True)
class ContactLine:
    """The contacts in one frame of the gesture that follows.

    Attributes:
        number: of the gesture, from 0.
        lines: number of such lines of the gesture.
        rate: of the model's frames, Hz.
        frames: of the model in the window.
        maximum: K, contacts at a time.
        frame: of the model, from 0.
        contacts: number of a contact, below K -> its x, y, radius (m), force (N) and peak pressure (Pa).
    """

    number: int
    lines: int
    rate: float
    frames: int
    maximum: int
    frame: int
    contacts: Mapping[int, Sequence[float]]


def contact_lines(number: int, contacts: np.ndarray, rate: float) -> list[ContactLine]:
    """Return the lines of a gesture.

    Args:
        number: of the gesture.
        contacts: (T, K, 5), as of :class:`skin.device.touches.Touches`.
        rate: of the model, Hz.
    """
    present = np.isfinite(contacts).all(axis=2)
    touched, (window, maximum) = np.flatnonzero(present.any(axis=1)).tolist(), contacts.shape[:2]
    return [
        ContactLine(
            number,
            len(touched),
            rate,
            window,
            maximum,
            frame,
            {
                position: contacts[frame, position].tolist()
                for position in np.flatnonzero(present[frame]).tolist()
            },
        )
        for frame in touched
    ]


def join_contact_lines(lines: Sequence[ContactLine], window: int, rate: float) -> np.ndarray | None:
    """Return the contacts (T, K, 5) of a gesture; None if a line is missing, or of another window or rate.

    Args:
        lines: of one gesture.
        window: T, frames of the model.
        rate: of the model, Hz.
    """
    frames = {line.frame: line for line in lines}
    if not lines or any(
        (line.frames, line.rate, line.lines) != (window, rate, len(frames))
        or line.maximum != lines[0].maximum
        for line in lines
    ):
        return None
    contacts = np.full((window, lines[0].maximum, len(CONTACT)), nan)
    for line in frames.values():
        for position, values in line.contacts.items():
            contacts[line.frame, position] = values
    return contacts


def encode_contact_line(line: ContactLine) -> bytes:
    """Return the note of a line, LF at its end."""
    return encode_note("contacts", asdict(line))


def parse_contact_line(line: bytes) -> ContactLine | None:
    """Return the contacts in a line without its end; None for other lines and wrong checksums."""
    content = parse_note("contacts", line)
    try:
        if content is None:
            return None
        contacts = {
            int(position): tuple(map(float, values)) for position, values in content.pop("contacts").items()
        }
        read = ContactLine(**content, contacts=contacts)
        sound = (
            0 <= read.frame < read.frames <= _MOST_FRAMES
            and read.maximum <= MOST_CONTACTS
            and set(contacts) <= set(range(read.maximum))
            and all(
                len(values) == len(CONTACT) and all(map(isfinite, values)) for values in contacts.values()
            )
        )
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    return read if sound else None
