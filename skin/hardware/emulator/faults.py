"""Faults of an emulated skin, injected on request."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from skin.errors import InputError

__all__ = ["BANNER", "KINDS", "Faults"]

BANNER = b"\x00\xff\x00ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\nentry 0x400805f0\r\n"
"""What an ESP32 says at 115200 baud when it starts, after two bytes of noise."""

KINDS = ("silence", "reset", "unplug")
"""What happens at a moment."""


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

    Raises:
        InputError: a share outside of 0 to 1, or a negative number.
    """

    flipped_bits: float = 0.0
    lost_bytes: float = 0.0
    banner: bool = False
    silence: float | Sequence[float] = 0.0
    reset: float | Sequence[float] = 0.0
    unplug: float | Sequence[float] = 0.0
    silent: float = 2.0
    away: float = 2.0
    stuck: Sequence[int] = ()
    dead: Sequence[int] = ()
    since: float = 0.0

    def __post_init__(self) -> None:
        for name in ("flipped_bits", "lost_bytes"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"faults.{name} is a share from 0 to 1, got {getattr(self, name)}")
        for name in (*KINDS, "silent", "away", "since", "stuck", "dead"):
            if not np.all(np.asarray(getattr(self, name), dtype=float) >= 0):
                raise InputError(f"faults.{name} must be at least 0, got {getattr(self, name)}")

    @classmethod
    def of(cls, given: dict[str, Any]) -> "Faults":
        """Return the faults that a configuration asks for."""
        if unknown := sorted(set(given) - {entry.name for entry in fields(cls)}):
            known = ", ".join(entry.name for entry in fields(cls))
            raise InputError(f"faults has no {', '.join(unknown)}: it takes {known}")
        return cls(**given)

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
