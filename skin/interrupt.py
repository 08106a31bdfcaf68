"""Handle Ctrl-C from the first import on: the command ends as by the signal, without a traceback."""

import sys
from types import TracebackType

_usual = sys.excepthook


def _said(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Say nothing of Ctrl-C: who pressed it knows. A shell sees exit code 130."""
    if not issubclass(kind, KeyboardInterrupt):
        _usual(kind, error, trace)


sys.excepthook = _said
