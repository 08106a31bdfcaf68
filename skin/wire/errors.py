"""Errors of an open skin."""

from collections.abc import Sequence

from skin.errors import InputError
from skin.signal.frame import Frame

__all__ = ["SkinDisconnected", "SkinTimeout", "SkinTouched"]


class SkinTouched(InputError):  # noqa: N818
    """No baseline can be taken, because something touches the skin."""


class SkinTimeout(TimeoutError):  # noqa: N818 - the name says what happened, as TimeoutError's does
    """Fewer frames came than were asked for.

    Attributes:
        frames: those that came.
    """

    def __init__(self, message: str, frames: Sequence[Frame] = ()) -> None:
        super().__init__(message)
        self.frames = list(frames)


class SkinDisconnected(ConnectionError):  # noqa: N818
    """The skin was unplugged, or a recording has ended.

    Attributes:
        frames: those that came before, of those that were asked for.
    """

    def __init__(self, message: str, frames: Sequence[Frame] = ()) -> None:
        super().__init__(message)
        self.frames = list(frames)
