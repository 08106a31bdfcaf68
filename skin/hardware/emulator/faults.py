"""Faults of an emulated skin, injected on request."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from pydantic import NonNegativeFloat, NonNegativeInt

from skin.errors import InputError

BANNER = b"\x00\xff\x00ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\nentry 0x400805f0\r\n"
"""Boot message of an ESP32 at 115200 baud, after two bytes of noise."""

KINDS = ("silence", "reset", "unplug")
"""Faults that occur at a moment."""

Share = Annotated[float, Ge(0), Le(1)]
Often = NonNegativeFloat | Sequence[NonNegativeFloat]


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Rates of faults; all are off by default.

    ``silence``, ``reset`` and ``unplug`` are mean numbers per minute, or lists of times, s since the start
    of the device.

    Attributes:
        flipped_bits: share of bits that arrive flipped.
        lost_bytes: share of bytes that are lost.
        banner: send the boot message of a board at the start and after each reset and unplugging.
        silence: nothing is sent for ``silent`` s; frame numbers continue.
        reset: frame numbers start from 0 again.
        unplug: the port disappears for ``away`` s.
        silent, away: s.
        stuck: channels, from 0, that repeat their value at ``since``.
        dead: channels that send 0 from ``since`` on.
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
        """Raise InputError if a channel does not exist."""
        for number in (*self.stuck, *self.dead):
            if number >= sensors:
                raise InputError(f"there is no channel {number}: the layout has {sensors} sensors, from 0")

    def happen(self, kind: str, frames: int, rate: float, generator: np.random.Generator) -> np.ndarray:
        """Draw the frames in which a fault given by its rate occurs, (frames,), bool."""
        per_minute: float | Sequence[float] = getattr(self, kind)
        if not isinstance(per_minute, int | float) or not per_minute:
            return np.zeros(frames, dtype=bool)
        return generator.random(frames) < per_minute / 60 / rate

    def moments(self, kind: str, rate: float) -> frozenset[int]:
        """Return the frames, counted from the start, in which a fault given by times occurs."""
        listed = getattr(self, kind)
        return frozenset() if isinstance(listed, int | float) else frozenset(round(t * rate) for t in listed)

    def damaged(self, data: bytes, generator: np.random.Generator) -> bytes:
        """Return bytes with flipped bits and lost bytes."""
        if not self.flipped_bits and not self.lost_bytes:
            return data
        bits = np.unpackbits(np.frombuffer(data, np.uint8))
        bits ^= generator.random(len(bits)) < self.flipped_bits
        arrived = np.packbits(bits)
        return arrived[generator.random(len(arrived)) >= self.lost_bytes].tobytes()
