"""Handle Ctrl-C from the first import on: the command ends without a traceback."""

import sys
from types import TracebackType

_usual = sys.excepthook


def _handle(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print no traceback for Ctrl-C; the exit code is 130."""
    if not issubclass(kind, KeyboardInterrupt):
        _usual(kind, error, trace)


sys.excepthook = _handle
