"""Print an evaluation as a table."""

from collections.abc import Mapping
from math import isnan

from rich.console import Console
from rich.table import Table

from skin.evaluation.report import SHARES, Report


def print_report(found: Report, title: str, console: Console | None = None) -> None:
    """Print one line per label and one column per set of touches, accuracies in per cent, errors in degrees.

    Args:
        found: result of the evaluation.
        title: of the table.
        console: where to print; None: standard output.
    """
    console = console or Console()
    console.print(metrics_table(found.metrics, title))
    if found.point is not None and found.reached is not None:
        said = f"{found.point.sentence()}; {found.reached.sentence()}"
        console.print(said, markup=False, highlight=False, soft_wrap=True)
    for column, reason in found.cannot.items():
        console.print(f"{column}: {reason}", markup=False)


def metrics_table(metrics: Mapping[str, float], title: str) -> Table:
    """Return a table of the metrics with a suffix such as ``/accuracy``; others are omitted."""
    shown = [name for name in metrics if name.endswith((*SHARES, "/degrees"))]
    columns = list(dict.fromkeys(name.split("/")[0] for name in shown))
    made = Table("", *columns, title=title)
    for line in dict.fromkeys(name.split("/", 1)[1] for name in shown):
        values = (metrics.get(f"{column}/{line}") for column in columns)
        unit = 1 if line.endswith("/degrees") else 100
        made.add_row(line, *(format_number(value, unit) for value in values))
    return made


def format_number(value: float | None, unit: float = 100) -> str:
    """Return a value with one decimal; "-" for NaN, and an empty string for None."""
    return "" if value is None else "-" if isnan(value) else f"{unit * value:.1f}"
