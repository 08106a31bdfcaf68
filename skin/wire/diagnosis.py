"""Diagnosis of a skin at a port: frame rate, errors, and the state of each channel."""

from collections import deque
from collections.abc import Iterator
from math import inf
from time import monotonic

import numpy as np

from skin.signal.frame import Frame
from skin.wire.skin import Skin
from skin.wire.text import encode_header

_KEPT = 10_000  # frames for the statistics of channels
_SPREAD = 1.4826  # median absolute deviation -> standard deviation of normal noise


class PortMonitor:
    """Collects statistics of an open skin."""

    def __init__(self, skin: Skin) -> None:
        self._skin = skin
        self._frames: deque[Frame] = deque(maxlen=_KEPT)

    def lines(self, seconds: float | None) -> Iterator[str]:
        """Yield a line each second, and the last one after ``seconds`` s; None: without end."""
        start = printed = monotonic()
        for frame in self._skin:
            self._frames.append(frame)
            now = monotonic()
            over = now - start >= (inf if seconds is None else seconds)
            if over or now - printed >= 1:
                printed = now
                yield f"{now - start:6.1f} s  {self._line()}"
            if over:
                return

    def _line(self) -> str:
        stats, sensors = self._skin.stats, len(self._frames[-1].values)
        counts = {
            "bad": stats.bad_frames,
            "lost": stats.lost,
            "skipped": stats.skipped,
            "resets": stats.resets,
            "invalid values": stats.invalid,
        }
        errors = "".join(f", {count} {name}" for name, count in counts.items() if count)
        reasons = ", ".join(f"{count} {reason}" for reason, count in stats.bad)
        frames = f"{stats.frames} frames{errors}" + (f" ({reasons})" if reasons else "")
        checksum = f"checksum {stats.check}" if stats.check != "none" else "NO CHECKSUM"
        trouble = f"; {stats.trouble}" if stats.trouble else ""
        return f"{stats.format}, {checksum}, {sensors} sensors, {stats.rate_hz:.4g} Hz, {frames}{trouble}"

    def summary(self) -> str:
        """Return the header, and the minimum, median, maximum, noise and state of each channel."""
        if not self._frames:
            return "nothing received"
        values = np.stack([frame.values for frame in self._frames])
        valid = np.stack([frame.valid for frame in self._frames])
        states = self._skin.channels or ("ok",) * values.shape[1]
        # Of a channel that is never valid, the values that it repeats.
        kept = [row[mask] if mask.any() else row for row, mask in zip(values.T, valid.T, strict=True)]
        middle = [float(np.median(row)) for row in kept]
        noise = [_SPREAD * float(np.median(np.abs(row - mid))) for row, mid in zip(kept, middle, strict=True)]
        words = [_state(*pair) for pair in zip(states, valid.mean(axis=0), strict=True)]
        rows = zip(
            [row.min() for row in kept], middle, [row.max() for row in kept], noise, words, strict=True
        )
        return "\n".join(
            [
                f"header: {self._header()}",
                "channel     least    median   largest     noise",
                *(
                    f"{channel:7d}{low:10.5g}{mid:10.5g}{high:10.5g}{spread:10.3g}  {state}"
                    for channel, (low, mid, high, spread, state) in enumerate(rows)
                ),
            ]
        )

    def _header(self) -> str:
        header = self._skin.header
        if header is None:
            return "none"
        return encode_header(header, "none").decode().removeprefix("# skin ").strip()


def _state(state: str, share: float) -> str:
    """Return the state of a channel in words, with the share of its invalid values where there are any."""
    return state if share == 1 else f"{state}, invalid in {1 - share:.0%}"
