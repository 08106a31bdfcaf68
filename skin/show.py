"""An evaluation for a person at the terminal."""

from rich.console import Console
from rich.table import Table

from skin.evaluation import Report

__all__ = ["report"]


def report(found: Report, title: str, console: Console | None = None) -> None:
    """Print one line per label and one column per set of touches, accuracies in per cent.

    Args:
        found: what an evaluation found.
        title: of the table.
        console: where to print; None takes standard output.
    """
    console = console or Console()
    columns = list(dict.fromkeys(name.split("/")[0] for name in found.metrics))
    lines = dict.fromkeys(
        name.split("/", 1)[1] for name in found.metrics if name.endswith(("/accuracy", "/recall"))
    )
    table = Table("", *columns, title=title)
    for line in lines:
        shares = (found.metrics.get(f"{column}/{line}") for column in columns)
        table.add_row(line, *("" if share is None else f"{100 * share:.1f}" for share in shares))
    console.print(table)
    for column, reason in found.cannot.items():
        console.print(f"{column}: {reason}", markup=False)
