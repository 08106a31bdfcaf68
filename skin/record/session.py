"""A session: raw frames as they arrived, and events; and how it is read.

A session is a CSV file that skin calibrate reads too: ``time`` (s since the start), ``seq`` and a column of
raw values per sensor. Lines that start with # are JSON: unit conversion, beginning and end of gestures, gaps,
invalid channels. Unit, layout and start time are in ``x.csv.json``. Whole lines are appended, so the file is
valid up to its last complete frame if the program is interrupted.

The reader skips damaged lines. Events have checksums, and that which ends a gesture has those of its frames.
The line that begins a gesture repeats the invalid and saturated channels, and refers to the unit conversion
by the checksum of its line, so that a lost line never gives a gesture the baseline of another.
"""

import logging
import zlib
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from skin.body.base import MOST
from skin.core import files
from skin.core.files import json_line
from skin.core.safe_loading import parse_json, read_file, regular, sha256
from skin.device.curves import Curves
from skin.device.resampling import Frame, Window
from skin.errors import InputError
from skin.touch.labels import CONTACT
from skin.wire.channels import UnitConversion
from skin.wire.protocol import MOST_CONTACTS
from skin.wire.segmentation import RecordedGesture

_SUM = ', "sum": "'


_NAMED = 5  # lines or gestures, in a sentence


@dataclass
class StoredSession:
    """Content of a session.

    Attributes:
        about: metadata in the JSON file beside it.
        gestures: complete gestures by number, each with its unit conversion; the last one of a number counts.
        frames: number of frames.
        end: time of the last frame, s.
        damaged: numbers of the lines that cannot be read; the header is line 1.
        left_out: number of a gesture -> reason why it cannot be used.
    """

    about: dict[str, Any]
    gestures: dict[int, tuple[RecordedGesture, UnitConversion]] = field(default_factory=dict)
    frames: int = 0
    end: float = -1.0
    damaged: list[int] = field(default_factory=list)
    left_out: dict[int, str] = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        """Warnings about damaged lines and omitted gestures."""
        warnings = []
        if count := len(self.damaged):
            warnings.append(f"{count} damaged line{'s' * (count > 1)} skipped: {_some(self.damaged)}")
        for reason in dict.fromkeys(self.left_out.values()):
            numbers = [number for number, why in self.left_out.items() if why == reason]
            warnings.append(f"gesture {_some(numbers)} left out: {reason}")
        return warnings


def _some(numbers: list[int]) -> str:
    omitted = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return ", ".join(map(str, numbers[:_NAMED])) + omitted


_log = logging.getLogger(__name__)

_IN_FRAMES = b"0123456789+-.e,\r"
_IN_EVENTS = b' #"[]{}:\0'  # not in frames; after a power cut any line may consist of NUL
_SPOILT = 2  # damaged bytes in a line that still counts as a frame
_SLACK = 1e-6  # s: times are rounded
_BEFORE = 512  # frames
_DIGITS = 8  # of the checksum of a line
_LINE = 1 << 20  # bytes: a frame of the most sensors has a fifth of it
_LONGEST = 100_000  # frames of a window
_STARTS = ("cut", "reset", "reconnect")
_BAD = (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)


def read_session(path: Path) -> StoredSession:
    """Read a session; warn of damaged lines and gestures.

    An incomplete line at the end and incomplete gestures are left out. A damaged line is skipped and counted.
    Within a gesture, a damaged frame counts as lost, also one that only its checksum shows. If the line may
    have been an event, or if the line with the unit conversion is damaged, the gesture is left out.

    Raises:
        InputError: no such file, or not a session of skin record.
    """
    beside = path.with_name(path.name + ".json")
    if path.exists() and not beside.exists():
        raise InputError(f"{path} is not a session of skin record: no {beside.name} is beside it")
    try:
        reading = _Reading(_about(beside))
        regular(path)
        with path.open("rb") as file:
            for number, line in enumerate(iter(partial(file.readline, _LINE), b""), 1):
                if line.endswith(b"\n"):
                    reading.line(number, line[:-1])
    except FileNotFoundError as error:
        raise InputError(f"no session {path}: skin record out={path} makes one") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except _BAD as error:
        raise InputError(f"{beside.name} is damaged or no session's: {error}") from error
    stored = reading.stored
    if stored.damaged and not stored.frames:
        raise InputError(f"{path} is damaged or no session of skin record: {reading.first}")
    for warning in stored.warnings:
        _log.warning("%s: %s", path, warning)
    return stored


def _about(beside: Path) -> dict[str, Any]:
    """Return the metadata of a session; an error of _BAD if they are invalid."""
    about = parse_json(read_file(beside))
    if isinstance(about, dict) and about.pop("sum", None) not in (None, _about_sum(about)):
        raise ValueError("its checksum is not that of its content")
    if not isinstance(about, dict) or not {"positions", "started_unix"} <= set(about):
        raise ValueError("it has no positions or no started_unix")
    positions = np.array(about["positions"], dtype=float)
    numbers = [about["started_unix"], *(about[name] for name in ("window", "rate") if name in about)]
    if positions.ndim != 2 or not 1 <= len(positions) <= MOST or not np.isfinite(positions).all():
        raise ValueError(f"positions are not 1 to {MOST} rows of numbers")
    if not all(isinstance(value, int | float) and 0 < value < inf for value in numbers):
        raise ValueError("started_unix, window and rate must be numbers above 0")
    if "window" in about and not (isinstance(about["window"], int) and about["window"] <= _LONGEST):
        raise ValueError(f"window must be a whole number of at most {_LONGEST} frames")
    return about


def write_about(about: dict[str, Any], path: Path) -> None:
    """Write the metadata of a session beside it, with their checksum.

    Args:
        about: JSON data.
        path: of the session.

    Raises:
        InputError: the file cannot be written.
    """
    files.write(
        files.json_line(about | {"sum": _about_sum(about)}) + "\n", path.with_name(path.name + ".json")
    )


def _about_sum(about: dict[str, Any]) -> str:
    return sha256(files.json_line(about, sort_keys=True).encode())


class _Reading:
    """Goes through the lines of a session.

    Attributes:
        stored: what they held.
        first: what was wrong with the first damaged one.
    """

    def __init__(self, about: dict[str, Any]) -> None:
        self.stored, self.first = StoredSession(about), ""
        self._sensors = len(about["positions"])
        self._length = about["window"] / about["rate"] if {"window", "rate"} <= set(about) else inf
        # Older sessions called a channel at its limit invalid.
        old = about.get("format") == 1 and about.get("bits")
        self._limit = 2 ** min(int(about["bits"]), 64) - 1 if old else None
        self._gesture: RecordedGesture | None = None
        self._conversion: tuple[str, UnitConversion] | None = None
        self._marked: dict[str, list[int]] = {"invalid": [], "saturated": []}
        # Frames before the gesture determine the device's rate, as in the live view.
        self._before: deque[Frame] = deque(maxlen=_BEFORE)
        self._missing = 0
        self._spoilt, self._doubtful = 0, False
        self._sums: dict[int, str] = {}  # id of a frame of the gesture -> checksum of its line
        # The last two frames, each with the number of its line, to check that time increases.
        self._last: list[tuple[int, Frame]] = []

    def line(self, number: int, data: bytes) -> None:
        """Process a line without its end."""
        try:
            text = data.decode("ascii")
            if number == 1:
                if text.split(",")[:2] != ["time", "seq"]:
                    raise ValueError("no header")
            elif text.startswith("#"):
                self._event(*decode_event(text))
            else:
                self._frame(number, text)
        except _BAD as error:
            self.first = self.first or f"line {number}: {error}"
            self.stored.damaged.append(number)
            self._damaged(data)

    def _damaged(self, data: bytes) -> None:
        strange = data.translate(None, _IN_FRAMES)
        if data and len(strange) <= _SPOILT and not set(strange) & set(_IN_EVENTS):
            count = max(1, round(data.count(b",") / (self._sensors + 1)))
            self._spoilt, self._missing = self._spoilt + count, self._missing + count
            return
        self._doubtful = True
        self._leave_out("a damaged line in it may have changed what its frames mean")

    def _leave_out(self, reason: str) -> None:
        if self._gesture is not None:
            self.stored.left_out[self._gesture.number] = reason
            self._gesture = None

    def _frame(self, number: int, text: str) -> None:
        t, seq, *values = text.split(",")
        row = np.array([float(value) for value in values])
        if len(row) != self._sensors:
            raise ValueError(f"{len(row)} values, {self._sensors} sensors")
        if not isfinite(float(t)) or not np.isfinite(row).all() or "_" in text:
            raise ValueError("no number")
        valid, saturated = np.ones(len(row), dtype=bool), np.zeros(len(row), dtype=bool)
        valid[self._marked["invalid"]] = False
        saturated[self._marked["saturated"]] = True
        if self._limit is not None:
            saturated = row >= self._limit
            valid |= saturated
        number_of = int(seq) if seq else None
        frame = Frame(number_of, float(t), float(t), row, valid, 0, self._missing, "", saturated)
        self._check_time(frame)
        self._missing = 0
        self._last = [*self._last[-1:], (number, frame)]
        self.stored.frames, self.stored.end = self.stored.frames + 1, frame.t
        (self._before if self._gesture is None else self._gesture.frames).append(frame)
        if self._gesture is not None:
            self._sums[id(frame)] = line_sum(text)

    def _check_time(self, frame: Frame) -> None:
        """Check that time increases; of two contradicting frames, drop the one that does not fit."""
        if not self._last or frame.t >= self._last[-1][1].t:
            return
        if len(self._last) == 2 and frame.t < self._last[0][1].t:
            raise ValueError("time goes backwards")
        number, wrong = self._last.pop()
        self.stored.damaged.append(number)
        self.stored.frames -= 1
        self._spoilt += 1
        held = self._before if self._gesture is None else self._gesture.frames
        if held and held[-1] is wrong:
            held.pop()

    def _event(self, content: dict[str, Any], token: str) -> None:
        match content.pop("event"):
            case "meaning":
                bent = content.pop("curves", None)
                curves = None if bent is None else Curves.of_json(bent, self._sensors)
                arrays = {name: np.array(value) for name, value in content.items()}
                if any(
                    len(array) != self._sensors or not np.isfinite(array).all() for array in arrays.values()
                ):
                    raise ValueError("a conversion of other sensors")
                self._conversion = token, UnitConversion(**arrays, curves=curves)
                self._marked = {"invalid": [], "saturated": []}
                self._gesture, self._doubtful = None, False
            case "begin":
                self._begin(content)
            case "end":
                self._end(int(content["number"]), int(content["lost"]), content.get("frames"))
            case "gap":
                # The device's clock restarts; a gesture may begin with the next frame.
                if content["after"] in _STARTS:
                    self._before.clear()
                    if self._gesture is not None and self._gesture.frames:
                        self._gesture = None
                self._missing += max(1, int(content["lost"]))
            case ("invalid" | "saturated") as event:
                self._marked[event] = self._channels(content["channels"])
            case "broken":
                self._gesture = None
            case other:
                raise ValueError(f"unknown event {other}")

    def _channels(self, channels: list[int]) -> list[int]:
        if not all(0 <= channel < self._sensors for channel in channels):
            raise ValueError(f"no channels {channels}")
        return channels

    def _begin(self, content: dict[str, Any]) -> None:
        number, labels = int(content["number"]), content["labels"]
        if not isfinite(content["time"]) or not set((labels or {}).values()) <= {0, 1}:
            raise ValueError("no gesture")
        contacts = content.get("contacts")  # sessions of earlier versions and of people have none
        if contacts is not None:
            contacts = _decode_contacts(contacts, self.stored.about.get("window", 30))
        self._gesture = RecordedGesture(number, labels, float(content["time"]), 0, contacts=contacts)
        self._spoilt = 0
        self._sums = {}
        # Older sessions do not refer to a conversion.
        meant = content.get("meaning")
        if self._conversion is None or (self._doubtful if meant is None else meant != self._conversion[0]):
            self._leave_out("the line with its unit conversion is damaged")
        for event, channels in self._marked.items():
            self._marked[event] = self._channels(content.get(event, channels))

    def _end(self, number: int, lost: int, frames: str | None) -> None:
        gesture, self._gesture = self._gesture, None
        # Another number: the line of an end or a beginning is damaged.
        if gesture is None or gesture.number != number or self._conversion is None:
            return
        if frames is not None:  # older sessions have none
            # Frames that look whole but are not those that were recorded count as lost.
            written = {frames[start : start + _DIGITS] for start in range(0, len(frames), _DIGITS)}
            same = [frame for frame in gesture.frames if self._sums[id(frame)] in written]
            self._spoilt += len(gesture.frames) - len(same)
            gesture.frames[:] = same
        inside = [
            frame.t
            for frame in gesture.frames
            if gesture.begin - _SLACK <= frame.t < gesture.begin + self._length
        ]
        if not inside:
            self.stored.left_out[number] = "it has no frames"
        elif len(inside) > 1 and inside[0] == inside[-1]:
            self.stored.left_out[number] = "the device's clock stood still, all its frames have the same time"
        else:
            gesture.lost = lost + self._spoilt
            about, conversion = self.stored.about, self._conversion[1]
            window = Window(about.get("window", 30), about.get("rate", 10.0), self._sensors)
            polarity = np.sign(conversion.scale) if (conversion.scale < 0).any() else None
            for frame in (*self._before, *gesture.frames):
                window.add(frame._replace(polarity=polarity))
            self._before.extend(gesture.frames)
            gesture.resampled = window.since(gesture.begin)
            self.stored.left_out.pop(number, None)
            self.stored.gestures[number] = gesture, conversion


def describe_contacts(contacts: np.ndarray) -> dict[str, Any]:
    """Return contacts (T, K, 5), NaN where there is none, as JSON data: each that is there in a row."""
    positions = np.argwhere(np.isfinite(contacts).all(axis=2))
    rows = [[*position, *contacts[tuple(position)].tolist()] for position in positions.tolist()]
    return {"most": contacts.shape[1], "rows": rows}


def _decode_contacts(content: dict[str, Any], frames: int) -> np.ndarray:
    """Return the contacts (T, K, 5) of a window of T ``frames``; an error of _BAD if they are invalid."""
    maximum = content["most"]
    if not isinstance(maximum, int) or not 1 <= maximum <= MOST_CONTACTS:
        raise ValueError("no number of contacts")
    contacts = np.full((frames, maximum, len(CONTACT)), np.nan)
    for frame, position, *values in content["rows"]:
        if not (0 <= frame < frames and 0 <= position < maximum and len(values) == len(CONTACT)):
            raise ValueError("no contact of the window")
        contacts[frame, position] = values
    return contacts


def line_sum(text: str) -> str:
    """Return the checksum of a line, 8 hexadecimal digits."""
    return f"{zlib.crc32(text.encode()):08x}"


def encode_event(event: str, **what: Any) -> tuple[str, str]:
    """Return an event as a line of JSON after #, with its checksum, and the checksum."""
    text = "# " + json_line({"event": event, **what})
    token = line_sum(text)
    return f'{text[:-1]}{_SUM}{token}"}}', token


def decode_event(line: str) -> tuple[dict[str, Any], str]:
    """Decode a line of :func:`encode_event`; return event and checksum, which is empty in older sessions.

    Raises:
        ValueError: no JSON, or a wrong checksum.
    """
    content = parse_json(line[1:])
    token = content.pop("sum", "")
    if token and line_sum(line.rpartition(_SUM)[0] + "}") != token:
        raise ValueError("wrong checksum")
    return content, token
