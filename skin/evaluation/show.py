"""Print an evaluation as a table."""

from math import isnan

from rich.console import Console
from rich.table import Table

from skin.evaluation.report import SHARES, Report

__all__ = ["number", "report"]


def report(found: Report, title: str, console: Console | None = None) -> None:
    """Print one line per label and one column per set of touches, accuracies in per cent, errors in degrees.

    Args:
        found: what an evaluation found.
        title: of the table.
        console: where to print; None takes standard output.
    """
    console = console or Console()
    columns = list(dict.fromkeys(name.split("/")[0] for name in found.metrics))
    lines = dict.fromkeys(
        name.split("/", 1)[1] for name in found.metrics if name.endswith((*SHARES, "/degrees"))
    )
    table = Table("", *columns, title=title)
    for line in lines:
        values = (found.metrics.get(f"{column}/{line}") for column in columns)
        unit = 1 if line.endswith("/degrees") else 100
        table.add_row(line, *(number(value, unit) for value in values))
    console.print(table)
    if found.point is not None and found.reached is not None:
        said = f"{found.point.sentence()}; {found.reached.sentence()}"
        console.print(said, markup=False, highlight=False, soft_wrap=True)
    for column, reason in found.cannot.items():
        console.print(f"{column}: {reason}", markup=False)


def number(value: float | None, unit: float = 100) -> str:
    """Return a figure with one digit; "-" where it is not defined, and nothing where there is none."""
    return "" if value is None else "-" if isnan(value) else f"{unit * value:.1f}"
