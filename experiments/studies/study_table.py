"""A study as a table of variants, and one of the report's statements with verdicts."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from skin.files import write
from studies.findings import COSTS, Finding, Outcome
from studies.study import Paired
from studies.table import ACCURACIES, ALARM, markdown

__all__ = ["as_csv", "measured", "page", "publish", "show", "statements", "variants"]

_MEASURES = (
    *(f"same/{label}/accuracy" for label in ACCURACIES),
    *(f"same/{metric}" for metric in ALARM.values()),
    *COSTS,
)


def variants(findings: Sequence[Finding], brief: bool = False) -> list[list[str]]:
    """Return a line per variant, the head first: mean and deviation over seeds, shares in per cent.

    Args:
        findings: as :func:`studies.findings.collect` gives them.
        brief: leave out the deviations of all but the overall accuracy.
    """
    extra = list(dict.fromkeys(name for finding in findings for name in finding.extra))
    lines = [["variant", *ACCURACIES, "recall", "false alarms", "s/epoch", "parameters", *extra]]
    for finding in findings:
        partly = f" ({finding.missing} failed)" if finding.missing else ""
        cells = [_cell([*finding.values(metric).values()], metric, brief) for metric in _MEASURES]
        more = [finding.extra.get(name, "") for name in extra]
        lines.append([finding.variant.name + partly, *cells, *more])
    return lines


def statements(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Return a line per statement, the head first."""
    lines = [["section", "the report says", "measured", "verdict"]]
    for outcome in outcomes:
        said = outcome.statement
        lines.append([said.section, said.says, measured(outcome), outcome.verdict])
    return lines


def measured(outcome: Outcome) -> str:
    """Return every comparison of a statement: the mean over paired seeds ± its standard error."""
    said, several = outcome.statement, len(outcome.compared) > 1
    unit = {"seconds_per_epoch": "s", "parameters": ""}.get(said.metric, "points")
    figures: Mapping[str, str] = {
        name: _figure(found, "times" if said.claim == "ratio" else unit)
        for name, found in outcome.compared.items()
    }
    return "; ".join(text + f" ({name})" if several else text for name, text in figures.items())


def page(title: str, findings: Sequence[Finding], outcomes: Sequence[Outcome]) -> str:
    """Return both tables as Markdown."""
    return (
        markdown(variants(findings), title) + "\n#" + markdown(statements(outcomes), "What the report says")
    )


def publish(path: Path, title: str, findings: Sequence[Finding], outcomes: Sequence[Outcome]) -> None:
    """Write ``<path>.md`` and ``<path>.csv`` and print the same.

    Args:
        path: without its ending.
        title: of the whole.
        findings: as :func:`studies.findings.collect` gives them.
        outcomes: as :func:`studies.findings.conclusions` gives them.
    """
    write(page(title, findings, outcomes), path.with_suffix(".md"))
    write(as_csv(findings), path.with_suffix(".csv"))
    show(title, findings, outcomes)
    print(f"{path}.md and {path.name}.csv\n")


def as_csv(findings: Sequence[Finding]) -> str:
    """Return a line per run: variant, seed, id of the run, and its figures, shares of 1."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    columns = ("train_accuracy", *_MEASURES)
    writer.writerow(["variant", "seed", "run", *columns])
    for finding in findings:
        for seed, run in finding.runs.items():
            figures = (run.data.metrics.get(name, "") for name in columns)
            writer.writerow([finding.variant.name, seed, run.info.run_id, *figures])
    return buffer.getvalue()


def show(
    title: str, findings: Sequence[Finding], outcomes: Sequence[Outcome], console: Console | None = None
) -> None:
    """Print both tables; where the terminal is narrow sentences wrap, names and numbers do not."""
    console, widest = console or Console(), 200
    tables = [_shown(title, variants(findings, brief=True)), _shown("", statements(outcomes))]
    # A number cut short would be another number: rather let a narrow terminal wrap.
    needed = console.measure(tables[0], options=console.options.update(width=widest)).maximum
    console.width = max(console.width, needed)
    for table in tables:
        console.print(table)


def _shown(title: str, lines: Sequence[Sequence[str]]) -> Table:
    table = Table(title=escape(title), box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name in lines[0]:
        table.add_column(name, no_wrap=name not in ("the report says", "measured"))
    for line in lines[1:]:
        table.add_row(*map(escape, line))
    return table


def _cell(values: Sequence[float], metric: str, brief: bool) -> str:
    """Return mean and deviation; of a cost, or where it shall be brief, the mean alone."""
    if not values:
        return "failed" if metric == _MEASURES[0] else ""
    if metric in COSTS:
        return f"{fmean(values):.{2 if metric == 'seconds_per_epoch' else 0}f}"
    spread = (
        f" ± {100 * stdev(values):.1f}" if len(values) > 1 and (metric == _MEASURES[0] or not brief) else ""
    )
    return f"{100 * fmean(values):.1f}{spread}"


def _figure(found: Paired | None, unit: str) -> str:
    if found is None:
        return "no paired runs"
    sign, digits = ("" if unit == "times" else "+"), (2 if unit == "s" else 1)
    error = "" if math.isinf(found.error) else f" ± {found.error:.{digits}f}"
    return f"{found.mean:{sign}.{digits}f}{error} {unit}".rstrip()
