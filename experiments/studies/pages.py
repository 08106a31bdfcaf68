"""Pages: tables and panels of lines, and the pages of the measures of single runs."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from skin.core.files import whole, write
from skin.evaluation.margins import ALARM_NAME, MarginReport
from skin.evaluation.streams import WindowReport
from skin.plot.figures import COLOURS, MARKS, save_figure
from skin.touch.labels import TOUCH


@dataclass(frozen=True)
class Page:
    """What is published of a measurement.

    Attributes:
        about: what matters most, for a person.
        tables: heading -> table of texts.
        data: every figure, as the CSV file has it; empty: there is no such file.
        figure: of the most important ones; None: there is none.
    """

    about: str
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    data: pd.DataFrame = field(default_factory=pd.DataFrame)
    figure: Figure | None = None


def publish_page(page: Page, title: str, path: Path) -> list[Path]:
    """Write ``path`` with the endings .md, .csv and .png, each whole, and return their paths."""
    parts = [f"# {title}\n", *([f"{page.about}\n"] if page.about else [])]
    parts += [f"## {heading}\n\n{markdown(table)}" for heading, table in page.tables.items()]
    paths = [write("\n".join(parts), path.with_name(f"{path.name}.md"))]
    if not page.data.empty:
        paths.append(write_csv(page.data, path.with_name(f"{path.name}.csv")))
    return paths + ([save_figure(page.figure, path.with_name(f"{path.name}.png"))] if page.figure else [])


def write_csv(frame: pd.DataFrame, path: Path) -> Path:
    """Write a frame as CSV, whole, and return the path."""
    with whole(path) as partial:
        frame.to_csv(partial, index=False, lineterminator="\n")
    return path


def csv_text(table: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(table)
    return buffer.getvalue()


def markdown(table: pd.DataFrame) -> str:
    """Return a table of texts as Markdown."""
    lines = ["| " + " | ".join(line) + " |" for line in [list(table.columns), *table.to_numpy().tolist()]]
    return "\n".join([lines[0], "|" + "---|" * len(table.columns), *lines[1:]]) + "\n"


@dataclass(frozen=True)
class Panel:
    """Lines with the same axes.

    Attributes:
        across: label of the axis across.
        up: label of the axis up.
        lines: name -> rows of x and y, and of the ends of their intervals where there are some, (2 or 4, N).
        title: of the panel.
        ticks: labels of x = 0, 1, ...; none: x is a number on a logarithmic axis.
        limits: of x, a ratio to a threshold.
    """

    across: str
    up: str
    lines: Mapping[str, np.ndarray]
    title: str = ""
    ticks: Sequence[str] = ()
    limits: tuple[float, float] | None = None


def draw_panels(title: str, panels: Sequence[Panel]) -> Figure:
    """Draw panels side by side, under a title."""
    figure = Figure(figsize=(max(7, 4.5 * len(panels)), 4), layout="constrained")
    figure.suptitle(title, fontsize=9, wrap=True)
    for panel, axis in zip(panels, figure.subplots(ncols=len(panels), squeeze=False)[0], strict=True):
        lines = {name: line for name, line in panel.lines.items() if len(line)}
        for (name, line), colour, marker in zip(lines.items(), cycle(COLOURS), cycle(MARKS), strict=False):
            x, y, *ends = line
            spread = (y - ends[0], ends[1] - y) if ends else None
            axis.errorbar(x, y, spread, label=name, color=colour, marker=marker, ms=4, lw=1, capsize=2)
        if panel.ticks:
            axis.set_xticks(range(len(panel.ticks)), panel.ticks, fontsize=7)
            axis.set_ylim(bottom=0)
        else:
            numbers = sorted({x for line in lines.values() for x in line[0]})
            numbers = [0.5, 0.8, 1, 1.25, 2] if panel.limits else numbers
            axis.set_xscale("log")
            axis.set_xticks(numbers, [f"{number:g}" for number in numbers], fontsize=7)
            axis.set_xticks([], minor=True)
        axis.set(title=panel.title, xlabel=panel.across, ylabel=panel.up, xlim=panel.limits)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return figure


_CLOSE = (0.9, 1.1)  # times its threshold: within 10 %
_WEAK = 1.0  # N
_INTERVAL = ["mean", "lower", "upper"]


def margins_frame(report: MarginReport) -> pd.DataFrame:
    """Return touches by their measure over its threshold, and by the highest reading.

    Columns: label, by, low, high, touches, said, wrong; ``mean`` of the measure, and ``lower`` and ``upper``
    end of the interval of said over touches. Limits are texts.
    """
    rows: list[dict[str, object]] = []
    for name, spans in report.spans.items():
        for span in spans:
            rows.append({"label": name, "by": "threshold", "low": str(span.low), "high": str(span.high)})
            rows[-1] |= {"touches": span.count, "said": str(span.said), "wrong": span.wrong}
            rows[-1] |= dict(zip(_INTERVAL, (span.mean, *span.range), strict=True))
    for name in TOUCH.names:
        for group in report.faint:
            rows.append({"label": name, "by": "reading", "low": str(group.low), "high": str(group.high)})
            rows[-1] |= {"touches": group.count, "said": "", "wrong": group.wrong[name]}
    frame = pd.DataFrame(rows)
    frame.attrs |= {"metrics": report.metrics, "about": _summarise_margins(report)}
    return frame


def _summarise_margins(report: MarginReport) -> str:
    """Return the number of errors close to a threshold or on weak touches, in one line."""
    wrong = {name: sum(span.wrong for span in report.spans[name]) for name in TOUCH.names}
    close = {
        name: sum(s.wrong for s in report.spans[name] if _CLOSE[0] <= s.low and s.high <= _CLOSE[1])
        for name in ("big", "dangerous")
    }
    weak = sum(group.wrong["dynamic"] for group in report.faint if group.high <= _WEAK)
    clear = [span for span in report.spans[ALARM_NAME] if span.low >= _CLOSE[1]]
    return (
        f"within 10 % of their thresholds lie {close['big']} of {wrong['big']} errors of big and "
        f"{close['dangerous']} of {wrong['dangerous']} of dangerous; no reading passes {_WEAK:g} N in "
        f"{weak} of {wrong['dynamic']} errors of dynamic; {sum(span.wrong for span in clear)} of "
        f"{sum(span.count for span in clear)} touches more than 10 % above the threshold of dangerous raise "
        f"no alarm; {report.point.sentence()}; {report.reached.sentence()}"
    )


def margins_page(frame: pd.DataFrame, title: str) -> Page:
    """Return the page of :func:`margins_frame`: said against measure over threshold, errors by reading."""
    data = frame.drop(columns=_INTERVAL)
    groups = {" by ".join(key): group for key, group in data.groupby(["label", "by"], sort=False)}
    spans, faint = (dict([*frame[frame.by == by].groupby("label")]) for by in ("threshold", "reading"))
    called = {
        name: np.stack(
            [spans[name]["mean"], 100 * spans[name].said.astype(int) / spans[name].touches,
             100 * spans[name].lower, 100 * spans[name].upper]
        )
        for name in ("big", "dangerous", ALARM_NAME)
    }  # fmt: skip
    wrong = {
        name: np.stack([np.arange(len(faint[name])), 100 * faint[name].wrong / faint[name].touches])
        for name in TOUCH.names
    }
    ranges = [
        f"above {row.low}" if row.high == "inf" else f"{row.low} to {row.high}"
        for row in faint["big"].itertuples()
    ]
    ticks = [f"{each}\n{count}" for each, count in zip(ranges, faint["big"].touches, strict=True)]
    label = "area (big) or pressure (dangerous) over its threshold"
    panels = [
        Panel(label, "touches called so, %, with 95 %", called, limits=(0.4, 2.5)),
        Panel("highest reading above idle, N; touches", "wrong, %", wrong, ticks=ticks),
    ]
    tables = {name: group.iloc[:, 2:].astype(str) for name, group in groups.items()}
    return Page(frame.attrs["about"], tables, data, draw_panels(title, panels))


def streams_frame(report: WindowReport) -> pd.DataFrame:
    """Return every figure of an evaluation on streams, as texts: measure, name, at, value."""
    rows: list[Sequence[object]] = []
    for part in report.bins:
        rows.append(["windows", "", part.name, part.count])
        rows += (["accuracy", name, part.name, f"{v:.4f}"] for name, v in part.accuracy.items())
        rows += (["majority", name, part.name, f"{v:.4f}"] for name, v in part.majority.items())
    cells = ("idle said idle", "idle said touched", "touched said idle", "touched said touched")
    for gate, counts in report.gates.items():
        rows += ([cell, gate, "", int(n)] for cell, n in zip(cells, counts.flatten(), strict=True))
    for gate, alarms in report.alarms.items():
        rows += ([f"alarms {name}", gate, "", value] for name, value in vars(alarms).items())
    rows.append(["threshold, N", "threshold", "", f"{report.threshold:.4f}"])
    rows.append(["stream, h", "", "", report.hours])
    rows += (["window, s", "overall", f"{window:g}", value] for window, value in report.lengths.items())
    frame = pd.DataFrame(
        [[str(value) for value in row] for row in rows], columns=["measure", "name", "at", "value"]
    )
    bins = (report.bins[0], report.bins[-1]) if report.bins else ()
    parts = [f"accuracy {100 * part.overall:.1f} % at share {part.name}" for part in bins]
    for gate, alarms in report.alarms.items():
        low, high = alarms.range
        parts.append(
            f"gate {gate}: {alarms.per_hour:.1f} ({low:.1f} to {high:.1f}) false alarms per hour without "
            f"touch, {alarms.found} of {alarms.dangerous} dangerous touches and {alarms.raised} of "
            f"{alarms.safe} safe ones raised the alarm"
        )
    trained = "windows of streams" if report.streamed else "whole touches"
    parts.append(f"trained on {trained}; {report.point.sentence()}")
    frame.attrs |= {"metrics": report.metrics(), "about": "; ".join(parts)}
    return frame


def streams_page(frame: pd.DataFrame, title: str) -> Page:
    """Return the page of :func:`streams_frame`, with the accuracy by the fraction that is seen."""
    tables = {}
    for measure, group in frame.groupby("measure", sort=False):
        table = group.pivot(index="name", columns="at", values="value").fillna("")
        tables[measure] = table.reindex(columns=group["at"].unique()).reset_index()
    accuracy = tables.get("accuracy", pd.DataFrame({"name": []})).set_index("name").astype(float)
    lines = {name: np.stack([np.arange(len(row)), 100 * row]) for name, row in accuracy.iterrows()}
    ticks = list(accuracy.columns)
    panel = Panel("fraction of the touch in the window", "accuracy, %", lines, ticks=ticks)
    return Page(frame.attrs["about"], tables, frame, draw_panels(title, [panel]))
