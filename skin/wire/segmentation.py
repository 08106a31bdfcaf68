"""Segment a stream into gestures, with labels announced, prompted or unknown."""

import os
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from queue import SimpleQueue
from threading import Thread

import numpy as np

from skin.core.rng import Stream, generator
from skin.device.resampling import Frame, Resampled, Window
from skin.errors import InputError
from skin.touch.labels import OPPOSITE, Task
from skin.wire.protocol import Announcement

Labels = Mapping[str, int]

_INTERRUPTED = "the gesture was interrupted: the skin was unplugged or restarted"
_NO_RESPONSE = "no touch was detected, so the gesture is asked for again: all working sensors read noise"


@dataclass
class RecordedGesture:
    """The frames of one gesture.

    Attributes:
        number: of the gesture.
        labels: name -> 0 or 1; None if unknown.
        begin: start of the window, s, by the device's clock.
        segment: of the device's clock.
        frames: of the window.
        lost: number of frames known to be missing.
        resampled: the window at the model's rate, in the device's unit; None until it is complete, or if
            the device restarted within it.
        contacts: (T, K, 5) at the model's rate, as of :class:`skin.device.touches.Touches`; None if unknown.
    """

    number: int
    labels: Labels | None
    begin: float
    segment: int
    frames: list[Frame] = field(default_factory=list)
    lost: int = 0
    resampled: Resampled | None = None
    contacts: np.ndarray | None = None


def label_plan(names: Sequence[str], repetitions: int, seed: int) -> Iterator[Labels]:
    """Yield every combination of the labels, in another random order each repetition."""
    for repetition in range(repetitions):
        for code in generator(Stream.SPLIT, 2, seed, repetition).permutation(2 ** len(names)):
            yield {name: int(code) >> position & 1 for position, name in enumerate(names)}


def label_text(labels: Labels) -> str:
    """Return labels in words, as ``small, dynamic, press, safe``."""
    return ", ".join(name if on else OPPOSITE.get(name, f"not {name}") for name, on in labels.items())


def typed_lines(file: int) -> Iterator[str]:
    """Yield the lines typed into an open file."""
    partial = b""
    # Not sys.stdin: a thread that blocks there would keep the program from ending.
    while data := os.read(file, 1024):
        *lines, partial = (partial + data).split(b"\n")
        yield from (line.decode(errors="replace") for line in lines)


class AbstractSegmenter(ABC):
    """Segments a stream of frames into gestures.

    Args:
        window: of the model; it may already contain earlier frames.

    Attributes:
        window: as given.
        gesture: the gesture that is being recorded; None between two.
        over: no more gestures follow.
    """

    def __init__(self, window: Window) -> None:
        self.window, self._length = window, window.frames / window.rate
        self.gesture: RecordedGesture | None = None
        self.over = False

    def add(self, frame: Frame) -> RecordedGesture | None:
        """Add a frame; return the whole gesture whose window ended before it; else None."""
        gesture, done = self.gesture, None
        if gesture is not None:
            whole = frame.segment == gesture.segment
            if not whole or frame.t >= gesture.begin + self._length - 1e-7:
                gesture.resampled = self.window.since(gesture.begin) if whole else None
                self.gesture, done = None, gesture if self._keeps(gesture) else None
        self.window.add(frame)
        if self.gesture is None:
            self.gesture = self._begin(frame)
        if self.gesture is not None:
            # The first frame's loss lies before the window.
            self.gesture.lost += frame.lost if self.gesture.frames else 0
            self.gesture.frames.append(frame)
        return done

    def _keeps(self, gesture: RecordedGesture) -> bool:
        """Return whether a gesture that has ended can be used."""
        return gesture.resampled is not None

    @abstractmethod
    def _begin(self, frame: Frame) -> RecordedGesture | None:
        """Return the gesture that begins with this frame, or None."""


class AnnouncedSegmenter(AbstractSegmenter):
    """Segments by the windows and labels that an emulated skin announces.

    Args:
        window: as in :class:`AbstractSegmenter`.
        announcements: that have not been used yet.
        task: the required labels; ``touch`` is always 1.
        late: fraction of a window that may be missed at its beginning.

    Raises:
        InputError: a frame without a number, or an announcement without a required label.
    """

    def __init__(
        self, window: Window, announcements: deque[Announcement], task: Task, late: float = 0.25
    ) -> None:
        super().__init__(window)
        self._announcements, self._task, self._late = announcements, task, late

    def _begin(self, frame: Frame) -> RecordedGesture | None:
        if frame.seq is None:
            raise InputError("announcements need frames with numbers: give device.labels=prompted")
        while self._announcements and frame.seq >= self._announcements[0].seq:
            announced = self._announcements.popleft()
            late = frame.seq - announced.seq
            if late > self._late * announced.frames:
                continue  # most of a gesture that began long before the port was opened is missing
            labels = {"touch": 1} | dict(announced.labels)
            if missing := [name for name in self._task.names if name not in labels]:
                raise InputError(f"the skin announces no {missing[0]}: give device.labels=prompted")
            return RecordedGesture(
                announced.number,
                {name: labels[name] for name in self._task.names},
                frame.t - late * self._length / announced.frames,
                frame.segment,
                lost=late,
                contacts=announced.contacts
                if announced.contacts is not None
                and (len(announced.contacts), announced.rate) == (self.window.frames, self.window.rate)
                else None,
            )
        return None


class PromptedSegmenter(AbstractSegmenter):
    """Prompts for each gesture, which begins when Enter is pressed: s skips one, q ends.

    It prompts again where the skin was interrupted, or detected nothing although the labels say a touch.

    Args:
        window: as in :class:`AbstractSegmenter`.
        plan: (number, labels) of the gestures.
        notify: called with each message for the user.
        responded: returns whether the skin has detected a touch in a window.
        lines: typed lines; None: standard input. Lines typed before a prompt count, unless they come from a
            keyboard.
    """

    def __init__(
        self,
        window: Window,
        plan: Iterator[tuple[int, Labels]],
        notify: Callable[[str], None],
        responded: Callable[[Resampled], bool],
        lines: Iterator[str] | None = None,
    ) -> None:
        super().__init__(window)
        self._wanted, self._notify, self._responded = plan, notify, responded
        self._typed: SimpleQueue[str] = SimpleQueue()
        self._asked: tuple[int, Labels] | None = None
        self._hasty = lines is None and sys.stdin.isatty()
        # A thread, because frames arrive while the program waits for a line.
        Thread(target=self._listen, args=(lines or typed_lines(sys.stdin.fileno()),), daemon=True).start()

    def _listen(self, lines: Iterator[str]) -> None:
        for line in lines:
            self._typed.put(line.strip().lower())
        self._hasty = False
        self._typed.put("q")

    def add(self, frame: Frame) -> RecordedGesture | None:
        """As in the base class; a gesture that was not detected is asked for again."""
        done = super().add(frame)
        # A frame after a gesture, so that the message about that is printed first.
        if done is None and self.gesture is None and self._asked is None and not self.over:
            following = next(self._wanted, None)
            self.over = following is None
            if following is not None:
                self._ask(following)
        return done

    def _keeps(self, gesture: RecordedGesture) -> bool:
        labels, resampled = gesture.labels or {}, gesture.resampled
        felt = resampled is not None and (labels.get("touch") == 0 or self._responded(resampled))
        if not felt:
            self._notify(_INTERRUPTED if resampled is None else _NO_RESPONSE)
            self._ask((gesture.number, labels))
        return felt

    def _begin(self, frame: Frame) -> RecordedGesture | None:
        if self._asked is None or self._typed.empty():
            return None
        line, asked, self._asked = self._typed.get(), self._asked, None
        self.over = line == "q"
        if line in ("q", "s"):
            return None
        self._notify(f"  now: {self._length:g} s")
        return RecordedGesture(*asked, frame.t, frame.segment)

    def _ask(self, gesture: tuple[int, Labels]) -> None:
        self._asked = gesture
        # Pressing Enter twice must not start the next gesture.
        while self._hasty and not self._typed.empty():
            self._typed.get_nowait()
        self._notify(f"next: {label_text(gesture[1])} - press Enter, then touch; s skips it, q ends")


class ContinuousSegmenter(AbstractSegmenter):
    """Segments into consecutive windows without labels.

    Args:
        window: as in :class:`AbstractSegmenter`.
        first: number of the first.
        begins: whether a frame may begin a window; None: any may.
    """

    def __init__(self, window: Window, first: int = 0, begins: Callable[[Frame], bool] | None = None) -> None:
        super().__init__(window)
        self._numbers, self._begins = count(first), begins

    def _begin(self, frame: Frame) -> RecordedGesture | None:
        if self._begins is not None and not self._begins(frame):
            return None
        return RecordedGesture(next(self._numbers), None, frame.t, frame.segment)
