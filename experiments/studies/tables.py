"""Tables as CSV, as Markdown and on a terminal, and pages of them; the head is their first line."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure
from rich import table as terminal
from rich.console import Console
from rich.markup import escape

from skin.core.files import write
from skin.plot.figures import save_figure

Table = Sequence[Sequence[str]]

_WIDEST = 250  # characters, more than the table of the report needs


@dataclass(frozen=True)
class Page:
    """What is published of a measurement.

    Attributes:
        about: what matters most, for a person.
        tables: heading -> table.
        data: every figure, as the table of the CSV file; empty: there is no such file.
        figure: of the most important ones; None: there is none.
    """

    about: str
    tables: Mapping[str, Table] = field(default_factory=dict)
    data: Sequence[Sequence[object]] = ()
    figure: Figure | None = None


def publish_page(page: Page, title: str, path: Path) -> list[Path]:
    """Write ``path`` with the endings .md, .csv and .png, each whole, and return their paths."""
    sections = [f"#{markdown(table, heading)}" for heading, table in page.tables.items()]
    parts = [f"# {title}\n", *([f"{page.about}\n"] if page.about else []), *sections]
    paths = [write("\n".join(parts), path.with_name(f"{path.name}.md"))]
    paths += [write(csv_text(page.data), path.with_name(f"{path.name}.csv"))] if page.data else []
    return paths + ([save_figure(page.figure, path.with_name(f"{path.name}.png"))] if page.figure else [])


def csv_text(table: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(table)
    return buffer.getvalue()


def markdown(table: Table, title: str) -> str:
    """Return a table as Markdown, below its title."""
    lines = ["| " + " | ".join(line) + " |" for line in table]
    return "\n".join([f"# {title}", "", lines[0], "|" + "---|" * len(table[0]), *lines[1:]]) + "\n"


def print_table(
    table: Table, title: str, console: Console | None = None, wrapped: Sequence[str] = ()
) -> None:
    """Print a table, all numbers whole, however narrow the terminal is.

    Args:
        table: the head first.
        title: of it.
        console: where to print; None takes standard output.
        wrapped: the columns that may be broken into lines.
    """
    console = console or Console()
    printed = terminal.Table(title=escape(title), box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name in table[0]:
        printed.add_column(escape(name), no_wrap=name not in wrapped)
    for line in table[1:]:
        printed.add_row(*map(escape, line))
    if not set(wrapped) & set(table[0]):
        # A number cut short would be another number: rather let a narrow terminal wrap.
        needed = console.measure(printed, options=console.options.update(width=_WIDEST)).maximum
        console.width = max(console.width, needed)
    console.print(printed)
