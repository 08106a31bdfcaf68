"""Tables as CSV, as Markdown and on a terminal; the head is their first line."""

import csv
import io
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

__all__ = ["as_csv", "markdown", "percent", "show"]

_WIDEST = 200  # characters


def as_csv(table: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(table)
    return buffer.getvalue()


def markdown(table: Sequence[Sequence[str]], title: str) -> str:
    """Return a table as Markdown, below its title."""
    lines = ["| " + " | ".join(line) + " |" for line in table]
    return "\n".join([f"# {title}", "", lines[0], "|" + "---|" * len(table[0]), *lines[1:]]) + "\n"


def percent(value: str, deviation: str = "") -> str:
    """Return a share in per cent, with its deviation if there is one; what is no number stays as it is."""
    if value in ("", "failed", "cannot"):
        return value
    spread = f" ± {100 * float(deviation):.1f}" if deviation else ""
    return f"{100 * float(value):.1f}{spread}"


def show(
    table: Sequence[Sequence[str]], title: str, console: Console | None = None, wrapped: Sequence[str] = ()
) -> None:
    """Print a table, all numbers whole, however narrow the terminal is.

    Args:
        table: the head first.
        title: of it.
        console: where to print; None takes standard output.
        wrapped: the columns that may be broken into lines.
    """
    console = console or Console()
    shown = Table(title=escape(title), box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name in table[0]:
        shown.add_column(escape(name), no_wrap=name not in wrapped)
    for line in table[1:]:
        shown.add_row(*map(escape, line))
    if not set(wrapped) & set(table[0]):
        # A number cut short would be another number: rather let a narrow terminal wrap.
        needed = console.measure(shown, options=console.options.update(width=_WIDEST)).maximum
        console.width = max(console.width, needed)
    console.print(shown)
