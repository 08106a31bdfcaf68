"""Streams: touches with idle gaps between them, and the windows cut from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.device.touches import Recording
from skin.touch.labels import TOUCH_OR_NOT
from skin.touch.movie import Movie, join_movies
from skin.touch.sampler import TouchSampler

_LEAST = 16


class WindowContent(NamedTuple):
    """The content of W windows.

    Attributes:
        frames: (W, T), indices into the stream.
        gesture: (W,), the gesture with the most frames in the window, the first in a tie; -1 without contact.
        share: (W,), fraction of that gesture's contact frames in the window, 0 to 1.
        labels: (W, 5), 0 or 1, float32, in the order of ``skin.touch.labels.TOUCH_OR_NOT``: those of the
            whole gesture, even if the window shows a part of it; all 0 without contact.
    """

    frames: Tensor
    gesture: Tensor
    share: Tensor
    labels: Tensor


@dataclass(frozen=True)
class Timeline:
    """The gestures of a stream and their times.

    Attributes:
        movie: G gestures.
        begin: (G,), ascending, the frame of the stream at which each contact begins.
        length: F, frames; the last gesture may be truncated.
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
        """The frame after the last one of each gesture, (G,)."""
        return self.begin + self.duration

    def spread(self, values: Tensor) -> Tensor:
        """Return values per gesture and frame, (G, T, ...), along the stream, (F, ...); 0 in the gaps."""
        gesture = torch.arange(len(self.begin)).repeat_interleave(self.duration)
        step = torch.arange(len(gesture)) - (self.duration.cumsum(0) - self.duration)[gesture]
        frame = self.begin[gesture] + step
        inside = frame < self.length
        column = (self.movie.parameters["onset"].long()[gesture] + step)[inside]
        result = values.new_zeros(self.length, *values.shape[2:])
        result[frame[inside]] = values[gesture[inside], column]
        return result

    def window_content(self, starts: Tensor, window: int) -> WindowContent:
        """Return the content of windows of ``window`` frames that begin at ``starts`` (W,)."""
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
        sampler: draws the gestures, with balanced labels.
        length: F, frames.
        gap: [least, most] idle frames between two touches, drawn uniformly, both ends included.
        generator: source of randomness.
    """
    frames = sampler.settings.frames
    typical = (sum(frames.tap) + sum(frames.press)) / 4 + sum(gap) / 2
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
    inside = begin < length
    inside[0] = True  # at least one, even if a short stream ends before it
    return Timeline(join_movies(movies)[inside], begin[inside], length)


@dataclass(frozen=True)
class TouchStream:
    """The readings of a stream.

    Attributes:
        timeline: the gestures and their times.
        whole: the stream as one touch of F frames, (1, F, ...), without labels; its windows have labels.
    """

    timeline: Timeline
    whole: Recording

    @classmethod
    def of(cls, timeline: Timeline, gestures: Recording) -> "TouchStream":
        """Return the stream of gestures that were simulated one by one.

        Args:
            timeline: the times of the gestures.
            gestures: (G, T, ...), 0 without contact, so without noise or offset.
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
        drawn = {name: values[gesture] for name, values in self.timeline.movie.parameters.items()}
        drawn["onset"] = (self.timeline.begin[gesture] - starts).float()
        parameters = {name: values.where(gesture >= 0, 0) for name, values in drawn.items()}
        saturated = windows(felt.saturated)
        content = {} if saturated is None else {"clipped": saturated.flatten(1).any(1).float()}
        content |= {"share": share.float()}
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
            parameters=parameters | content,
        )


def only_touches(recording: Recording) -> Recording:
    """Return the windows that show a touch; all of them where the task has no label for that."""
    labels, gate = recording.touches.labels, recording.task.gate
    if labels is None or gate is None:
        return recording
    return recording[labels[:, recording.task.names.index(gate)] > 0.5]
