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
        middle = np.median(values, axis=0)
        noise = _SPREAD * np.median(np.abs(values - middle), axis=0)
        states = self._skin.channels or ("ok",) * len(middle)
        rows = zip(values.min(axis=0), middle, values.max(axis=0), noise, states, strict=True)
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
