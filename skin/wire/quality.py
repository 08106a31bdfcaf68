"""Detect that most frames are bad, so that the baud rate or format must be wrong."""

from skin.signal.frame import FrameError

__all__ = ["Quality"]

_SPAN = 2.0  # s
_FEW = 3  # bad frames that say nothing yet


class Quality:
    """Compares good with bad frames over two seconds at a time.

    Attributes:
        trouble: the sentence for a person; empty while most frames are good.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._since: float | None = None
        self._good = self._bad = 0
        self._latest = FrameError("")

    def note(self, bad: FrameError) -> None:
        """Keep what the latest bad frame was like."""
        self._latest = bad

    def count(self, now: float, good: int, bad: int) -> None:
        """Add what came by ``now``, s."""
        self._since = now if self._since is None else self._since
        self._good += good
        self._bad += bad
        if now - self._since >= _SPAN:
            most = self._bad > max(self._good, _FEW)
            self.trouble = self._sentence() if most else ""
            self._since, self._good, self._bad = now, 0, 0

    def _sentence(self) -> str:
        share = f"{self._bad} of {self._bad + self._good} frames in {_SPAN:g} s were bad"
        if self._latest.reason == "fields":
            return f"{share}: the device sends {self._latest.found} values per frame now"
        return f"{share} ({self._latest.reason}): wrong baud rate or format?"
