"""Listen to the bytes of a skin for announcements."""

from collections import deque
from collections.abc import Callable

from skin.wire.announcement import Announcement, parse
from skin.wire.transport import ByteStream

__all__ = ["Tap"]

_LONGEST = 4096  # bytes
_KEPT = 64  # announcements, where nobody takes them


class Tap:
    """An opener for ``open_skin`` that hands bytes on as they are and keeps the announcements among them.

    Args:
        opener: opens the stream of bytes.

    Attributes:
        heard: announcements that nobody has taken yet.
    """

    def __init__(self, opener: Callable[[], ByteStream]) -> None:
        self._opener = opener
        self.heard: deque[Announcement] = deque(maxlen=_KEPT)

    def __call__(self) -> ByteStream:
        """Open the stream, once more after each unplugging."""
        self._stream, self._rest = self._opener(), b""
        self.heard.clear()
        return self

    def read(self) -> bytes:
        """Return what came."""
        data = self._stream.read()
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-_LONGEST:]
        self.heard.extend(said for line in lines if (said := parse(line)))
        return data

    def close(self) -> None:
        """Let go of the stream."""
        self._stream.close()
