"""The progress of a command, as a bar."""

import sys
from collections.abc import Mapping

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

CONSOLE = Console(stderr=True)  # one for all bars, which it shows one below the other


class Steps(Progress):
    """A bar of the steps of a command, on a terminal at standard error; use it in a ``with`` statement.

    ``stop`` and ``start`` hide and show it, such as while a person is prompted.

    Args:
        seconds: expected duration of each step, in order, by its name; they are relative to each other.
    """

    def __init__(self, seconds: Mapping[str, float]) -> None:
        columns = "{task.description}", BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
        super().__init__(
            *columns,
            console=CONSOLE,
            transient=True,
            disable=not CONSOLE.is_terminal,
            redirect_stdout=sys.stdout.isatty(),  # what is printed on a terminal goes above the bar
        )
        self._seconds, self._task = dict(seconds), self.add_task("", total=sum(seconds.values()))
        self.begin(next(iter(seconds)))

    def begin(self, name: str) -> None:
        """Show which step begins; those before it have ended."""
        self._name = name
        self.update(self._task, description=name)
        self.report(0.0)

    def report(self, fraction: float) -> None:
        """Show how much of the present step is done, from 0 to 1."""
        names = list(self._seconds)
        done = sum(self._seconds[before] for before in names[: names.index(self._name)])
        self.update(self._task, completed=done + fraction * self._seconds[self._name])
