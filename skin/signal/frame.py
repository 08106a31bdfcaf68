"""One frame of a skin, and the counters of its connection."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

Check = Literal["crc16", "xor", "none"]
After = Literal["", "gap", "cut", "reset", "reconnect"]
"""What lies before a frame: nothing; lost frames; another touch of a recording; a restart of the device; an
unplugged cable. Later ones outweigh earlier ones."""

_WEIGHT: dict[After, int] = {"": 0, "gap": 1, "cut": 2, "reset": 3, "reconnect": 4}


class Frame(NamedTuple):
    """The readings of all sensors at one moment.

    Attributes:
        seq: the device's own count, as sent; None where it sends none.
        t: s, the device's clock, unwrapped, within a segment; the host's where the device tells no time.
        t_host: s, the host's monotonic clock (``time.monotonic``), never before the frame before.
        values: (S,), float64, what the device sends (raw counts, or N from a recording): never re-scaled.
        valid: (S,), bool: False where a value means nothing (stuck or dead channel).
        segment: counts restarts, reconnections and cuts: no window should span two.
        lost: how many frames are known to be missing just before this one; 0 where nobody can know.
        after: what lies before this frame; empty if it follows the one before without a gap.
        saturated: (S,), bool: the channel is at its limit, so the force is at least what it says; None: no
            channel is.
    """

    seq: int | None
    t: float
    t_host: float
    values: np.ndarray
    valid: np.ndarray
    segment: int = 0
    lost: int = 0
    after: After = ""
    saturated: np.ndarray | None = None

    def behind(self, dropped: "Frame") -> "Frame":
        """Return this frame as it is told where the one before it was dropped: the gap is never hidden."""
        after = max(self.after, dropped.after, "gap", key=_WEIGHT.__getitem__)
        return self._replace(lost=self.lost + dropped.lost + 1, after=after)


class FrameError(Exception):
    """A frame that cannot be used.

    Attributes:
        reason: ``checksum``, ``fields`` (their count), ``number``, ``long``, ``structure`` or ``repeat``.
        found: what the frame holds, where that helps: how many fields.
    """

    def __init__(self, reason: str, found: int | None = None) -> None:
        super().__init__(reason)
        self.reason, self.found = reason, found


@dataclass
class Counters:
    """What a decoder has seen.

    Attributes:
        bytes: received.
        frames: good ones.
        bad: reason -> how many frames were dropped for it.
        skipped: pieces before the first good frame of a connection: half a line, a banner, noise.
        resyncs: how often a good frame followed bad ones.
        gaps: how often frames were missing.
        lost: how many frames were missing, as far as their numbers tell.
        resets: how often the device started anew.
        weak: frames taken without a CRC, which let wrong values through.
    """

    bytes: int = 0
    frames: int = 0
    bad: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    resyncs: int = 0
    gaps: int = 0
    lost: int = 0
    resets: int = 0
    weak: int = 0
