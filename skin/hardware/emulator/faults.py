"""Faults of an emulated skin, injected on request."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from pydantic import NonNegativeFloat, NonNegativeInt

from skin.errors import InputError

BANNER = b"\x00\xff\x00ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\nentry 0x400805f0\r\n"
"""What an ESP32 says at 115200 baud when it starts, after two bytes of noise."""

KINDS = ("silence", "reset", "unplug")
"""What happens at a moment."""

Share = Annotated[float, Ge(0), Le(1)]
Often = NonNegativeFloat | Sequence[NonNegativeFloat]


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults by their rates; all are off unless asked for.

    ``silence``, ``reset`` and ``unplug`` are how often a minute on average, or a list of moments, s of the
    device since it was started.

    Attributes:
        flipped_bits: share of bits that arrive flipped.
        lost_bytes: share of bytes that never arrive.
        banner: say what a board says when it starts, first of all and after each reset and unplugging.
        silence: nothing comes for ``silent`` s; the device counts on.
        reset: the device counts from 0 again.
        unplug: the port vanishes for ``away`` s.
        silent, away: s.
        stuck: channels, from 0, that repeat what they said at ``since``.
        dead: channels that say 0 from ``since`` on.
        since: s.
    """

    flipped_bits: Share = 0.0
    lost_bytes: Share = 0.0
    banner: bool = False
    silence: Often = 0.0
    reset: Often = 0.0
    unplug: Often = 0.0
    silent: NonNegativeFloat = 2.0
    away: NonNegativeFloat = 2.0
    stuck: Sequence[NonNegativeInt] = ()
    dead: Sequence[NonNegativeInt] = ()
    since: NonNegativeFloat = 0.0

    def fits(self, sensors: int) -> None:
        """Raise InputError where a broken channel does not exist."""
        for number in (*self.stuck, *self.dead):
            if number >= sensors:
                raise InputError(f"there is no channel {number}: the layout has {sensors} sensors, from 0")

    def happen(self, kind: str, frames: int, rate: float, generator: np.random.Generator) -> np.ndarray:
        """Return in which of the next frames something happens, (frames,), bool, where it is a rate."""
        per_minute: float | Sequence[float] = getattr(self, kind)
        if not isinstance(per_minute, int | float) or not per_minute:
            return np.zeros(frames, dtype=bool)
        return generator.random(frames) < per_minute / 60 / rate

    def moments(self, kind: str, rate: float) -> frozenset[int]:
        """Return the frames, counted from the start, at which something happens, where they are listed."""
        listed = getattr(self, kind)
        return frozenset() if isinstance(listed, int | float) else frozenset(round(t * rate) for t in listed)

    def damaged(self, data: bytes, generator: np.random.Generator) -> bytes:
        """Return bytes as they arrive."""
        if not self.flipped_bits and not self.lost_bytes:
            return data
        bits = np.unpackbits(np.frombuffer(data, np.uint8))
        bits ^= generator.random(len(bits)) < self.flipped_bits
        arrived = np.packbits(bits)
        return arrived[generator.random(len(arrived)) >= self.lost_bytes].tobytes()
