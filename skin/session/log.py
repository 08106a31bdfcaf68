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
        self._invalid: list[int] = []
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
        invalid = np.flatnonzero(~frame.valid).tolist()
        if invalid != self._invalid:
            self.mark("invalid", channels=invalid)
            self._invalid = invalid
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
        stored, take, meaning = Stored(about), None, None
        invalid: list[int] = []
        for text in _whole_lines(path):
            if not text.startswith("#"):
                frame = _frame(text, invalid)
                stored.frames, stored.end = stored.frames + 1, frame.t
                if take is not None:
                    take.frames.append(frame)
                continue
            said = json.loads(text[1:])
            match said.pop("event"):
                case "meaning":
                    meaning = Newtons(**{name: np.array(value) for name, value in said.items()})
                    invalid, take = [], None
                case "begin":
                    take = Take(said["number"], said["labels"], said["time"], 0)
                case "end" if take is not None and meaning is not None:
                    take.lost = said["lost"]
                    stored.takes[take.number] = take, meaning
                    take = None
                case "broken":
                    take = None
                case "invalid":
                    invalid = said["channels"]
    except OSError as error:
        raise InputError(f"no session {path}: experiments/record.py out={path} makes one") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{path} is damaged or no session of experiments/record.py: {error}") from error
    return stored


def _whole_lines(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8") as file:
        next(file, None)
        for text in file:
            if text.endswith("\n"):
                yield text


def _frame(text: str, invalid: list[int]) -> Frame:
    t, seq, *values = text.split(",")
    row = np.array([float(value) for value in values])
    valid = np.ones(len(row), dtype=bool)
    valid[invalid] = False
    return Frame(int(seq) if seq else None, float(t), float(t), row, valid)


def _write_about(path: Path, about: Mapping[str, Any]) -> None:
    beside = path.with_name(path.name + ".json")
    partial = beside.with_name(beside.name + ".part")
    partial.write_text(json.dumps(dict(about)) + "\n", encoding="utf-8")
    partial.replace(beside)
