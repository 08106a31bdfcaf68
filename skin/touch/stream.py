"""Streams: touches with idle gaps between them, and the windows cut from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.labels import TOUCH_OR_NOT
from skin.recording import Recording
from skin.touch.movie import Movie, join_movies
from skin.touch.sampler import TouchSampler

_LEAST = 16


class WindowContent(NamedTuple):
    """What W windows show.

    Attributes:
        frames: (W, T), which frames of the stream.
        gesture: (W,), the gesture that a window shows: that of which it shows the most frames, the first of
            equals; -1 where nothing touches.
        share: (W,), part of that gesture's frames in contact that the window shows, 0 to 1.
        labels: (W, 5), 0 or 1, float32, in the order of ``skin.labels.TOUCH_OR_NOT``: the whole gesture's,
            however little of it is seen; all 0 without touch.
    """

    frames: Tensor
    gesture: Tensor
    share: Tensor
    labels: Tensor


@dataclass(frozen=True)
class Timeline:
    """What touches when.

    Attributes:
        movie: G gestures.
        begin: (G,), ascending, the frame of the stream in which each one's contact begins.
        length: F, frames; the last gesture may be cut off.
    """

    movie: Movie
    begin: Tensor
    length: int

    def __post_init__(self) -> None:
        if (self.begin[1:] <= self.end[:-1]).any():
            raise ValueError("gestures of a stream must be at least one frame apart")

    @property
    def duration(self) -> Tensor:
        """Frames in contact, (G,)."""
        return self.movie.parameters["duration"].long()

    @property
    def end(self) -> Tensor:
        """The frame after each gesture's last, (G,)."""
        return self.begin + self.duration

    def spread(self, values: Tensor) -> Tensor:
        """Return what gestures give per frame of their movies, (G, T, ...), along the stream, (F, ...).

        Gaps are 0.
        """
        gesture = torch.arange(len(self.begin)).repeat_interleave(self.duration)
        step = torch.arange(len(gesture)) - (self.duration.cumsum(0) - self.duration)[gesture]
        frame = self.begin[gesture] + step
        inside = frame < self.length
        shown = (self.movie.parameters["onset"].long()[gesture] + step)[inside]
        result = values.new_zeros(self.length, *values.shape[2:])
        result[frame[inside]] = values[gesture[inside], shown]
        return result

    def window_content(self, starts: Tensor, window: int) -> WindowContent:
        """Return what windows of ``window`` frames show that begin at ``starts`` (W,)."""
        nearest = torch.searchsorted(self.end, starts, right=True)
        last = torch.searchsorted(self.begin, starts + window)
        most = max(1, int((last - nearest).amax()))
        candidates = (nearest[:, None] + torch.arange(most)).clamp(max=len(self.begin) - 1)
        first = torch.maximum(self.begin[candidates], starts[:, None])
        beyond = torch.minimum(self.end[candidates], starts[:, None] + window)
        seen, best = (beyond - first).clamp(min=0).max(dim=1)
        gesture = candidates[torch.arange(len(starts)), best]
        touched = seen > 0
        labels = torch.cat([self.movie.labels[gesture], torch.ones(len(starts), 1)], dim=1)
        return WindowContent(
            starts[:, None] + torch.arange(window),
            gesture.where(touched, -1),
            seen / self.duration[gesture],
            labels * touched[:, None],
        )


def draw_timeline(
    sampler: TouchSampler, length: int, gap: Sequence[int], generator: np.random.Generator
) -> Timeline:
    """Draw a stream of ``length`` frames that begins with a gap.

    Args:
        sampler: where gestures come from, balanced.
        length: F, frames.
        gap: [least, most] idle frames between two touches, drawn evenly, both ends included.
        generator: where all randomness comes from.
    """
    settings = sampler.settings
    typical = (sum(settings.tap) + sum(settings.press)) / 4 + sum(gap) / 2
    movies: list[Movie] = []
    begins: list[np.ndarray] = []
    filled = 0
    while filled < length:
        count = max(_LEAST, math.ceil((length - filled) / typical))
        movies.append(sampler.sample(count, generator))
        duration = movies[-1].parameters["duration"].long().numpy()
        ends = filled + np.cumsum(duration + generator.integers(gap[0], gap[1], count, endpoint=True))
        begins.append(ends - duration)
        filled = int(ends[-1])
    begin = torch.from_numpy(np.concatenate(begins))
    kept = begin < length
    kept[0] = True  # one at least, though a short stream may end before it
    return Timeline(join_movies(movies)[kept], begin[kept], length)


@dataclass(frozen=True)
class TouchStream:
    """A stream as a skin feels it.

    Attributes:
        timeline: what touches when.
        whole: the stream as one touch of F frames, (1, F, ...), whose windows have labels, not itself.
    """

    timeline: Timeline
    whole: Recording

    @classmethod
    def of(cls, timeline: Timeline, gestures: Recording) -> "TouchStream":
        """Return the stream of gestures that were felt one by one.

        Args:
            timeline: when each of them touches.
            gestures: (G, T, ...), idle where nothing touches, so without noise or offset.
        """

        def along(values: Tensor | None) -> Tensor | None:
            return None if values is None else timeline.spread(values)[None]

        readings = timeline.spread(gestures.touches.readings)[None]
        valid = torch.ones_like(readings, dtype=torch.bool)
        whole = replace(
            gestures,
            touches=replace(
                gestures.touches,
                readings=readings,
                valid=valid,
                labels=None,
                motion=along(gestures.touches.motion),
            ),
            task=TOUCH_OR_NOT,
            force=along(gestures.force),
            displacement=along(gestures.displacement),
            parameters={},
        )
        return cls(timeline, whole)

    def cut(self, starts: Tensor, window: int) -> Recording:
        """Return the windows (W, T, ...) of T = ``window`` frames that begin at ``starts`` (W,).

        Labels and ``share`` are those of :class:`WindowContent`. The other parameters are those of the
        gesture in the window, with its onset counted from the window's first frame, and 0 without a touch;
        ``clipped`` refers to the frames of the window.
        """
        frames, gesture, share, labels = self.timeline.window_content(starts, window)

        def windows(values: Tensor | None) -> Tensor | None:
            return None if values is None else values[0][frames]

        whole, felt = self.whole, self.whole.touches
        known = {name: values[gesture] for name, values in self.timeline.movie.parameters.items()}
        known["onset"] = (self.timeline.begin[gesture] - starts).float()
        shown = {name: values.where(gesture >= 0, 0) for name, values in known.items()}
        saturated = windows(felt.saturated)
        own = {} if saturated is None else {"clipped": saturated.flatten(1).any(1).float()}
        own |= {"share": share.float()}
        return replace(
            whole,
            touches=replace(
                felt,
                readings=felt.readings[0][frames],
                valid=felt.valid[0][frames],
                labels=labels,
                motion=windows(felt.motion),
                saturated=saturated,
            ),
            force=windows(whole.force),
            displacement=windows(whole.displacement),
            parameters=shown | own,
        )


def only_touches(recording: Recording) -> Recording:
    """Return what shows a touch: all, unless the labels say otherwise."""
    labels, gate = recording.touches.labels, recording.task.gate
    if labels is None or gate is None:
        return recording
    return recording[labels[:, recording.task.names.index(gate)] > 0.5]
