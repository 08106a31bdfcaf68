"""Segment a stream into gestures, with labels announced, prompted or unknown."""

import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from threading import Thread

import numpy as np

from skin.errors import InputError
from skin.labels import OPPOSITE, Task
from skin.rng import Stream, generator
from skin.signal.frame import Frame
from skin.signal.resampling import Resampled, Window
from skin.wire.announcement import AnnouncementListener

Labels = Mapping[str, int]

_LATE = 0.25  # share of an announced window that may be missed at its beginning


@dataclass
class RecordedGesture:
    """The frames of one gesture.

    Attributes:
        number: of the gesture.
        labels: name -> 0 or 1; None where nobody knows.
        begin: of the window, s, the device's clock.
        segment: of the device's clock.
        frames: of the window.
        lost: frames that are known to be missing in it.
        broken: the device started anew within it: it cannot be used.
        resampled: the window at the model's rate, in the device's unit; None until it is over.
    """

    number: int
    labels: Labels | None
    begin: float
    segment: int
    frames: list[Frame] = field(default_factory=list)
    lost: int = 0
    broken: bool = False
    resampled: Resampled | None = None


def label_plan(names: Sequence[str], repetitions: int, seed: int) -> Iterator[Labels]:
    """Yield every combination of the labels, in another random order each repetition."""
    for repetition in range(repetitions):
        order = generator(Stream.SPLIT, 2, seed, repetition).permutation(2 ** len(names))
        for code in order:
            yield {name: int(code) >> place & 1 for place, name in enumerate(names)}


def label_text(labels: Labels) -> str:
    """Return labels in words, as ``small, dynamic, press, safe``."""
    return ", ".join(name if on else OPPOSITE.get(name, f"not {name}") for name, on in labels.items())


def typed_lines(file: int) -> Iterator[str]:
    """Yield the lines that a person types into an open file."""
    rest = b""
    # Not from sys.stdin: a thread that waits there cannot be left when the program ends.
    while data := os.read(file, 1024):
        *lines, rest = (rest + data).split(b"\n")
        yield from (line.decode(errors="replace") for line in lines)


class AbstractSegmenter(ABC):
    """Is shown every frame and says which make a gesture.

    Args:
        window: of the model; frames that came before the first one shown may have been added to it.

    Attributes:
        window: as given.
        gesture: the window that is being filled; None between two.
        over: nothing more will come.
    """

    def __init__(self, window: Window) -> None:
        self.window, self._length = window, window.frames / window.rate
        self.gesture: RecordedGesture | None = None
        self.over = False

    def add(self, frame: Frame) -> RecordedGesture | None:
        """Take a frame; return the gesture whose window ended before it, or one that broke off."""
        done = self._close(frame)
        if done is not None and not done.broken:
            done.resampled = self.window.since(done.begin)
        self.window.add(frame)
        if self.gesture is None:
            self.gesture = self._begin(frame)
        if self.gesture is not None:
            # The first frame's loss lies before the window.
            self.gesture.lost += frame.lost if self.gesture.frames else 0
            self.gesture.frames.append(frame)
        return done

    def _close(self, frame: Frame) -> RecordedGesture | None:
        gesture = self.gesture
        if gesture is None:
            return None
        gesture.broken = frame.segment != gesture.segment
        if not gesture.broken and frame.t < gesture.begin + self._length - 1e-7:
            return None
        self.gesture = None
        return gesture

    @abstractmethod
    def _begin(self, frame: Frame) -> RecordedGesture | None:
        """Return a window that begins with this frame, if one does."""


class AnnouncedSegmenter(AbstractSegmenter):
    """Takes the windows and labels that an emulated skin announces.

    Args:
        window: as in :class:`AbstractSegmenter`.
        listener: what hears the announcements.
        task: the labels that are wanted; ``touch`` is always true.

    Raises:
        InputError: on a frame without a number, or an announcement without a label.
    """

    def __init__(self, window: Window, listener: AnnouncementListener, task: Task) -> None:
        super().__init__(window)
        self._announcements, self._task = listener.announcements, task

    def _begin(self, frame: Frame) -> RecordedGesture | None:
        if frame.seq is None:
            raise InputError("announcements need frames with numbers: give device.labels=prompted")
        while self._announcements:
            said = self._announcements[0]
            if frame.seq < said.seq:
                return None
            self._announcements.popleft()
            # Of one that began long before somebody listened the rest is no gesture.
            if frame.seq <= said.seq + _LATE * said.frames:
                begin = frame.t - (frame.seq - said.seq) * self._length / said.frames
                labels = {"touch": 1} | dict(said.labels)
                if missing := [name for name in self._task.names if name not in labels]:
                    raise InputError(f"the skin announces no {missing[0]}: give device.labels=prompted")
                known = {name: labels[name] for name in self._task.names}
                return RecordedGesture(said.number, known, begin, frame.segment, lost=frame.seq - said.seq)
        return None


class PromptedSegmenter(AbstractSegmenter):
    """Asks a person for each gesture and begins when Enter is pressed: s skips one, q ends.

    Args:
        window: as in :class:`AbstractSegmenter`.
        wanted: (number, labels) of the gestures.
        notify: says a sentence to the person.
        lines: what the person types; None: standard input. What is typed before it is asked for counts,
            unless it comes from a keyboard.
    """

    def __init__(
        self,
        window: Window,
        wanted: Iterator[tuple[int, Labels]],
        notify: Callable[[str], None],
        lines: Iterator[str] | None = None,
    ) -> None:
        super().__init__(window)
        self._wanted, self._notify = wanted, notify
        self._typed: SimpleQueue[str] = SimpleQueue()
        self._asked: tuple[int, Labels] | None = None
        self._over_now = False
        self._hasty = lines is None and sys.stdin.isatty()
        # A thread, because frames come while a person thinks.
        Thread(target=self._listen, args=(lines or typed_lines(sys.stdin.fileno()),), daemon=True).start()

    def _listen(self, lines: Iterator[str]) -> None:
        for line in lines:
            self._typed.put(line.strip().lower())
        self._hasty = False
        self._typed.put("q")

    def _close(self, frame: Frame) -> RecordedGesture | None:
        done = super()._close(frame)
        # The next one is asked for a frame later, so that what is said of this one is said before.
        self._over_now = done is not None
        return done

    def add(self, frame: Frame) -> RecordedGesture | None:
        """As above; a gesture that broke off is asked for again."""
        done = super().add(frame)
        if done is not None and done.broken and done.labels is not None:
            self._notify("that one broke off: the skin was unplugged or started anew")
            self._ask((done.number, done.labels))
        return done

    def _begin(self, frame: Frame) -> RecordedGesture | None:
        if self._over_now:
            return None
        if self._asked is None:
            following = next(self._wanted, None)
            if following is None:
                self.over = True
                return None
            self._ask(following)
        try:
            said = self._typed.get_nowait()
        except Empty:
            return None
        number, labels = self._asked or (0, {})
        self._asked = None
        self.over = said == "q"
        if said in ("q", "s"):
            return None
        self._notify(f"  now: {self._length:g} s")
        return RecordedGesture(number, labels, frame.t, frame.segment)

    def _ask(self, asked: tuple[int, Labels]) -> None:
        self._asked = asked
        # Enter pressed twice is no second gesture.
        while self._hasty and not self._typed.empty():
            self._typed.get_nowait()
        self._notify(f"next: {label_text(asked[1])} - press Enter, then touch; s skips it, q ends")


class ContinuousSegmenter(AbstractSegmenter):
    """Takes windows one after the other, without labels.

    Args:
        window: as in :class:`AbstractSegmenter`.
        first: number of the first.
        wanted: asked of every frame that could begin a window; None: each does.
    """

    def __init__(
        self, window: Window, first: int = 0, wanted: Callable[[np.ndarray], bool] | None = None
    ) -> None:
        super().__init__(window)
        self._number, self._wanted = first, wanted

    def _begin(self, frame: Frame) -> RecordedGesture | None:
        if self._wanted is not None and not self._wanted(frame.values):
            return None
        self._number += 1
        return RecordedGesture(self._number - 1, None, frame.t, frame.segment)
