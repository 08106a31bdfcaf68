"""A session on disk: raw frames as they come, and what happened between them.

A CSV that experiments/calibrate.py reads too: ``time`` (s since the start), ``seq`` and a column of raw
values per sensor. Lines that start with # are JSON: what values mean, where a gesture begins and ends, gaps,
invalid channels. Unit, layout and start time stand in ``x.csv.json``. Lines are only ever added, each in one
piece, so the file is valid up to its last whole frame whatever ends the program.
"""

import json
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from skin.errors import InputError
from skin.port.frame import Frame
from skin.session.newtons import Newtons
from skin.session.takes import Take
from skin.signal.resampling import Window

__all__ = ["Log", "Stored", "read"]


@dataclass
class Stored:
    """What a session holds.

    Attributes:
        about: the JSON beside it.
        takes: whole gestures by number, each with what its values mean; the last one of a number counts.
        frames: how many.
        end: time of the last frame, s.
    """

    about: dict[str, Any]
    takes: dict[int, tuple[Take, Newtons]] = field(default_factory=dict)
    frames: int = 0
    end: float = -1.0


class Log:
    """A session that is being written; one that exists is resumed.

    Args:
        path: x.csv.
        about: what is written beside it; a resumed session keeps its own.
        sensors: S.

    Attributes:
        done: numbers of the gestures that are whole.

    Raises:
        InputError: the file cannot be written, or is of another number of sensors or another layout.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], sensors: int) -> None:
        self._marked: dict[str, list[int]] = {"invalid": [], "saturated": []}
        self._segment, self._anchor = -1, 0.0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            stored = self._resume(path, about) if path.exists() else None
            self._about = stored.about if stored else dict(about) | {"started_unix": time.time()}
            if stored is None:
                _write_about(path, self._about)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            raise InputError(f"cannot write {path}: {error}") from error
        self.done = set(stored.takes) if stored else set()
        self._last = stored.end if stored else -1.0
        if stored is None:
            self._line(",".join(["time", "seq", *(f"raw_{number:02d}" for number in range(sensors))]))

    @staticmethod
    def _resume(path: Path, about: Mapping[str, Any]) -> Stored | None:
        whole = path.read_bytes()
        # What a power cut left of a last line would make the next one wrong.
        os.truncate(path, whole.rfind(b"\n") + 1)
        if b"\n" not in whole:
            path.unlink()
            return None
        stored = read(path)
        for name in ("positions", "unit"):
            if stored.about.get(name) != about[name]:
                raise InputError(f"{path} was recorded with another {name}: give another out=")
        return stored

    def mark(self, event: str, **what: Any) -> None:
        """Say what happens before the next frame."""
        self._line("# " + json.dumps({"event": event, **what}))

    def meaning(self, meaning: Newtons) -> None:
        """Say what values from now on mean; its ``zero`` is the baseline."""
        self.mark("meaning", **{name: value.tolist() for name, value in vars(meaning).items()})

    def begin(self, take: Take, frame: Frame) -> None:
        """Say that a gesture's window begins at or just before a frame."""
        begin = round(self._time(frame) - (frame.t - take.begin), 9)
        self.mark("begin", number=take.number, time=begin, labels=take.labels)

    def end(self, take: Take) -> None:
        """Say that it is over, and let it reach the disk."""
        self.mark("broken" if take.broken else "end", number=take.number, lost=take.lost)
        os.fsync(self._file)
        if not take.broken:
            self.done.add(take.number)

    def frame(self, frame: Frame) -> None:
        """Add a frame, raw."""
        if frame.after:
            self.mark("gap", after=frame.after, lost=frame.lost)
        none = np.zeros(len(frame.values), dtype=bool)
        marks = {"invalid": ~frame.valid, "saturated": none if frame.saturated is None else frame.saturated}
        for event, found in marks.items():
            channels = np.flatnonzero(found).tolist()
            if channels != self._marked[event]:
                self.mark(event, channels=channels)
                self._marked[event] = channels
        self._last = self._time(frame)
        values = ",".join(f"{value:.9g}" for value in frame.values.tolist())
        self._line(f"{self._last:.9f},{'' if frame.seq is None else frame.seq},{values}")

    @property
    def time(self) -> float:
        """When the last frame came, s since the session began."""
        return self._last

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._file)

    def _time(self, frame: Frame) -> float:
        """Return s since the start of the session, by the device's clock within a segment."""
        if frame.segment != self._segment:
            ago = time.monotonic() - frame.t_host
            self._segment = frame.segment
            self._anchor = time.time() - ago - self._about["started_unix"] - frame.t
            self._anchor = max(self._anchor, self._last + 1e-3 - frame.t)
        return frame.t + self._anchor

    def _line(self, text: str) -> None:
        # One call: a program that is killed has written all of a line or nothing of it.
        os.write(self._file, text.encode() + b"\n")


def read(path: Path) -> Stored:
    """Return what a session holds; half a line at its end and gestures without an end are left out.

    Raises:
        InputError: no such file, or no session of experiments/record.py.
    """
    try:
        about = json.loads(path.with_name(path.name + ".json").read_text(encoding="utf-8"))
        stored = _Reading(Stored(about))
        for text in _whole_lines(path):
            stored.line(text)
    except OSError as error:
        raise InputError(f"no session {path}: experiments/record.py out={path} makes one") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{path} is damaged or no session of experiments/record.py: {error}") from error
    return stored.stored


class _Reading:
    """Goes through the lines of a session."""

    def __init__(self, stored: Stored) -> None:
        self.stored = stored
        self._take: Take | None = None
        self._meaning: Newtons | None = None
        self._window: Window | None = None
        self._lost = 0
        self._marked: dict[str, list[int]] = {}

    def line(self, text: str) -> None:
        if text.startswith("#"):
            self._event(json.loads(text[1:]))
            return
        frame = self._frame(text)
        stored, about = self.stored, self.stored.about
        stored.frames, stored.end = stored.frames + 1, frame.t
        if self._window is None:
            self._window = Window(about.get("window", 30), about.get("rate", 10.0), len(frame.values))
        self._window.add(frame)
        if self._take is not None:
            self._take.frames.append(frame)

    def _event(self, said: dict[str, Any]) -> None:
        match said.pop("event"):
            case "meaning":
                self._meaning = Newtons(**{name: np.array(value) for name, value in said.items()})
                self._marked, self._take = {}, None
            case "begin":
                self._take = Take(said["number"], said["labels"], said["time"], 0)
            case "end" if self._take is not None and self._meaning is not None and self._window is not None:
                self._take.lost, self._take.seen = said["lost"], self._window.since(self._take.begin)
                self.stored.takes[self._take.number] = self._take, self._meaning
                self._take = None
            case "broken":
                self._take = None
            case "gap":
                self._lost = max(said["lost"], 1)
            case ("invalid" | "saturated") as event:
                self._marked[event] = said["channels"]

    def _frame(self, text: str) -> Frame:
        t, seq, *values = text.split(",")
        row = np.array([float(value) for value in values])
        valid, saturated = np.ones(len(row), dtype=bool), np.zeros(len(row), dtype=bool)
        valid[self._marked.get("invalid", [])] = False
        saturated[self._marked.get("saturated", [])] = True
        if self.stored.about.get("format") == 1 and (bits := self.stored.about.get("bits")):
            # Sessions of old called a channel at its limit invalid.
            saturated = row >= 2**bits - 1
            valid |= saturated
        lost, self._lost = self._lost, 0
        return Frame(int(seq) if seq else None, float(t), float(t), row, valid, 0, lost, "", saturated)


def _whole_lines(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8") as file:
        next(file, None)
        for text in file:
            if text.endswith("\n"):
                yield text


def _write_about(path: Path, about: Mapping[str, Any]) -> None:
    beside = path.with_name(path.name + ".json")
    partial = beside.with_name(beside.name + ".part")
    partial.write_text(json.dumps(dict(about)) + "\n", encoding="utf-8")
    partial.replace(beside)
