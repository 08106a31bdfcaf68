"""Exceptions that an open skin raises."""

from collections.abc import Sequence

from skin.errors import InputError
from skin.signal.frame import Frame


class SkinTouched(InputError):  # noqa: N818
    """No baseline can be taken, because something touches the skin."""


class _TooFewFramesError(Exception):
    """Fewer frames arrived than requested.

    Attributes:
        frames: those that arrived.
    """

    def __init__(self, message: str, frames: Sequence[Frame] = ()) -> None:
        super().__init__(message)
        self.frames = list(frames)


class SkinTimeout(_TooFewFramesError, TimeoutError):  # noqa: N818 - named as TimeoutError is
    """The frames did not arrive in time."""


class SkinDisconnected(_TooFewFramesError, ConnectionError):  # noqa: N818
    """The skin was unplugged, or a recording has ended."""
