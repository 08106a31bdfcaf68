"""Handle Ctrl-C and SIGTERM: the command ends without a traceback, and resources are closed."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

_usual = sys.excepthook


def _handle(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print no traceback for Ctrl-C; the exit code is 130."""
    if not issubclass(kind, KeyboardInterrupt):
        _usual(kind, error, trace)


sys.excepthook = _handle


@contextmanager
def ends_on_signal() -> Iterator[None]:
    """Turn SIGTERM into SystemExit, so that resources are closed; only in the main thread."""

    def leave(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    try:
        before = signal.signal(signal.SIGTERM, leave)
    except ValueError:
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
