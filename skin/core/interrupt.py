"""Handle Ctrl-C and SIGTERM: the command ends without a traceback, and resources are closed."""

import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread, Timer, current_thread, main_thread
from types import FrameType, TracebackType

_PATIENCE = _LAST = 1.0  # s
_CLOSING = 10.0  # s in which everything must be closed; containers and clusters wait as long or longer
_usual = sys.excepthook


def _handle(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print no traceback for Ctrl-C; the exit code is 130."""
    if not issubclass(kind, KeyboardInterrupt):
        _usual(kind, error, trace)


sys.excepthook = _handle


def leave(code: int) -> None:
    """End the process after everything was closed, without waiting for threads that still compute."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@contextmanager
def ends_on_signal(last: Callable[[], object] = bool) -> Iterator[None]:
    """Turn SIGTERM into SystemExit, so that resources are closed; only in the main thread.

    Python handles a signal between two of its own steps, and a solve or a batch of a network is one step that
    may take ten seconds. If it takes longer than a second, the process ends at once, as if it were killed;
    likewise where the block has not ended ten seconds later. Further signals do not interrupt its cleanup.

    Args:
        last: called in another thread before such an end; it has a second. By default nothing is.
    """
    if current_thread() is not main_thread():
        yield
        return
    # No Event: a signal that interrupts its handler would wait for the lock that this handler holds.
    answered = list[int]()

    def end(number: int, frame: FrameType | None) -> None:
        if not answered:
            answered.append(number)
            raise SystemExit(128 + number)

    ended, handler = Event(), signal.signal(signal.SIGTERM, end)
    # A pair of sockets, because Windows has no pipes that do not block before Python 3.12.
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    # The interpreter writes the numbers of signals at once, whatever the main thread does.
    wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    Thread(target=_watch, args=(receiver, answered, ended, last), name="skin-signals", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        sender.close()
        ended.set()
        signal.signal(signal.SIGTERM, handler)


def _watch(receiver: socket.socket, answered: list[int], ended: Event, last: Callable[[], object]) -> None:
    """End the process where a signal does not end the block."""
    with receiver:
        while signal.SIGTERM not in (numbers := receiver.recv(64)):
            if not numbers:
                return
        # It stays open meanwhile: else the interpreter complains about a further signal.
        in_time = ended.wait(_PATIENCE) or (answered and ended.wait(_CLOSING))
    if not in_time:
        Timer(_LAST, os._exit, [128 + signal.SIGTERM]).start()
        with suppress(Exception):  # nobody can be informed any more
            last()
        os._exit(128 + signal.SIGTERM)
