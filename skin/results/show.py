"""Evaluations for a person at the terminal."""

from collections.abc import Sequence
from math import isnan

from rich.console import Console
from rich.table import Table

from skin.evaluation.report import SHARES, Report
from skin.results.table import LABELS, beside, percent

__all__ = ["number", "report", "results"]

_WIDEST = 200


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


def results(lines: Sequence[dict[str, str]], title: str, console: Console | None = None) -> None:
    """Print the results table, narrow enough for 80 columns with one seed; the report's overall in brackets.

    Args:
        lines: as :func:`skin.results.table.rows` gives them.
        title: of the table.
        console: where to print; None takes standard output.
    """
    table = Table(title=title, box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("row", "data"):
        table.add_column(head, no_wrap=True)
    for head in ("overall", "big", "dyn.", "press", "dang.", "recall", "false", "dev.", "lay."):
        table.add_column(head, no_wrap=True, justify="right")
    for start in range(0, len(lines), len(LABELS)):
        group = {line["label"]: line for line in lines[start : start + len(LABELS)]}
        whole = group["overall"]
        table.add_row(
            whole["row"],
            whole["simulator"],
            beside(whole),
            *(percent(group[label]["ours"]) for label in LABELS[1:]),
            percent(whole["device_shift"]),
            percent(whole["unseen_layout"]),
        )
    console = console or Console()
    # A number cut short would be another number: rather let a narrow terminal wrap.
    needed = console.measure(table, options=console.options.update(width=_WIDEST)).maximum
    console.width = max(console.width, needed)
    console.print(table)
