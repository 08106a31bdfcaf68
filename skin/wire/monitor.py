"""Statistics of an open skin, for who looks at it for the first time."""

from collections import deque
from collections.abc import Iterator
from math import inf
from time import monotonic

import numpy as np
from scipy.ndimage import maximum_filter1d

from skin.device.resampling import Frame
from skin.wire.channels import fails_in_contact
from skin.wire.skin import Skin


class PortMonitor:
    """Collects statistics of an open skin.

    Args:
        skin: open.
        kept: frames for the statistics of channels.
        far, near: times the noise, and s, that make a touch.
    """

    def __init__(self, skin: Skin, kept: int = 10_000, far: float = 10.0, near: float = 0.5) -> None:
        self._skin, self._far, self._near = skin, far, near
        self._frames: deque[Frame] = deque(maxlen=kept)

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
        counts = stats.list_counts(
            bad_frames="bad", lost="lost", skipped="skipped", resets="resets", invalid="invalid values"
        )
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(stats.bad.items()))
        frames = ", ".join([f"{stats.frames} frames", *counts]) + (f" ({reasons})" if reasons else "")
        checksum = f"checksum {stats.check}" if stats.check != "none" else "NO CHECKSUM"
        line = f"{stats.format}, {checksum}, {sensors} sensors, {stats.rate_hz:.4g} Hz, {frames}"
        return "; ".join(filter(None, (line, stats.clock, stats.trouble)))

    def summary(self) -> str:
        """Return the header, and the minimum, median, maximum, noise and state of each channel."""
        if not self._frames:
            return "nothing received"
        values = np.stack([frame.values for frame in self._frames])
        valid = np.stack([frame.valid for frame in self._frames])
        states = self._skin.channels or ("ok",) * values.shape[1]
        touched = self._find_contact(values, valid)
        # Of a channel that is never valid, the values that it repeats.
        rows = [row[mask] if mask.any() else row for row, mask in zip(values.T, valid.T, strict=True)]
        lines = [f"header: {self._skin.header or 'none'}", "channel     least    median   largest     noise"]
        for channel, (row, state, fraction) in enumerate(zip(rows, states, valid.mean(axis=0), strict=True)):
            middle = np.median(row)
            noise = 1.4826 * np.median(np.abs(row - middle))  # as of a normal distribution
            text = state if fraction == 1 else f"{state}, invalid in {1 - fraction:.0%}"
            if fraction == 0 and state == "ok":
                text = "no value"
            elif _fails_under_touch(~valid[:, channel], touched):
                text += ", more often in contact than at rest: beyond its range?"
            numbers = f"{channel:7d}{row.min():10.5g}{middle:10.5g}{row.max():10.5g}{noise:10.3g}"
            lines.append(f"{numbers}  {text}")
        if _fails_under_touch(np.array([frame.lost > 0 for frame in self._frames]), touched):
            lines.append(
                "more frames are unreadable or lost in contact than at rest: values beyond the range?"
            )
        return "\n".join(lines)

    def _find_contact(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the frames (F,), bool, within half a second of which a channel is far from its median."""
        away, noise = np.abs(values - np.median(values, axis=0)), np.abs(np.diff(values, axis=0)).mean(axis=0)
        touched = ((away > self._far * noise) & valid).any(axis=1)
        near = 2 * round(self._near * self._skin.stats.rate_hz) + 1
        return np.asarray(maximum_filter1d(touched, near))


def _fails_under_touch(failed: np.ndarray, touched: np.ndarray) -> bool:
    """Return whether frames (F,) fail more often while the skin is touched, (F,)."""
    counts = (int(part.sum()) for part in (failed & touched, touched, failed & ~touched, ~touched))
    return fails_in_contact(*counts)
