"""The threshold of the alarm from all touches, chosen in a process of low priority beside a live view."""

import io
import os
import signal
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Any

from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.operating_point import OperatingPoint


def start_beside(target: Callable[..., object], name: str, *arguments: Any) -> tuple[BaseProcess, Connection]:
    """Start a process beside a live view; to be called in the main thread.

    Args:
        target: its function, of the arguments and of the other end of the pipe.
        name: of the process.
        arguments: that can be sent to it.

    Returns:
        The process, and the end of the pipe.
    """
    context = get_context("spawn")
    pipe, end = context.Pipe()
    process = context.Process(target=target, args=(*arguments, end), name=name, daemon=True)
    # A process that begins while Ctrl-C is ignored ignores it for good.
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    process.start()
    signal.signal(signal.SIGINT, handler)
    end.close()
    return process, pipe


def _choose(source: AlarmSource, live: LiveConditions, pipe: Connection) -> None:
    """Send the threshold, or why there is none; low priority keeps verdicts in time."""
    import torch

    # Ends with the view, also where that is killed.
    Thread(target=lambda: pipe.poll(None) and os._exit(1), daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(10)  # below the estimates of contacts
    torch.set_num_threads(1)
    with redirect_stderr(io.StringIO()):  # of the progress
        try:
            point = choose_alarm_threshold(source, live, say=lambda text: None)
            assert point is not None
            point.announced(lambda text: None)  # refuses one that hides dangerous touches
            pipe.send(point)
        except InputError as error:
            pipe.send(str(error))


class FinalThreshold:
    """The threshold that follows a provisional one, and the process that chooses it.

    Args:
        source: the model and what it is used on.
        live: conditions of the live view.
    """

    def __init__(self, source: AlarmSource, live: LiveConditions) -> None:
        self.process, self._pipe = start_beside(_choose, "skin-threshold", source, live)

    def take(self) -> OperatingPoint | str | None:
        """Return the threshold, or why there is none, once that is known; None before and afterwards."""
        if self._pipe.closed or not self._pipe.poll():
            return None
        answer: OperatingPoint | str = "the process that chooses the final one has ended"
        with suppress(EOFError, OSError):
            answer = self._pipe.recv()
        self.close()
        return answer

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self._pipe.close()
