"""Pages: tables and panels of lines, and the pages of the measures of single runs."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib.figure import Figure
from rich import table as terminal
from rich.console import Console
from rich.markup import escape
from torch import Tensor

from skin.core.files import write
from skin.evaluation.margins import ALARM_NAME, Faint, MarginReport, Span
from skin.evaluation.streams import WindowReport
from skin.plot.figures import COLOURS, MARKS, save_figure
from skin.touch.labels import OPPOSITE, TOUCH

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


_MEASURES = {
    "big": "area",
    "dynamic": "travel",
    "press": "duration",
    "dangerous": "pressure",
    ALARM_NAME: "pressure",
}
_NEAR = (0.9, 1.1)  # times its threshold
_FAINT = 1.0  # N


def margins_page(report: MarginReport, title: str) -> Page:
    """Return the tables, the CSV (``label,by,low,high,touches,said,wrong``) and the figure, under a title."""
    tables = {
        f"Alarm above {report.point.threshold:.4f}"
        if name == ALARM_NAME
        else f"{name.capitalize()} or {OPPOSITE[name]}": [
            [
                f"{_MEASURES[name]} over threshold",
                "touches",
                f"called {'dangerous' if name == ALARM_NAME else name}, %",
                "95 %",
                "wrong",
            ],
            *([_range(span), str(span.count), *_share(span), str(span.wrong)] for span in spans),
        ]
        for name, spans in report.spans.items()
    }
    kinds = ("accuracy", "balanced_accuracy", "ece")
    tables["All touches"] = [
        ["label", "accuracy, %", "balanced accuracy, %", "calibration error, %"],
        *(
            [name, *(f"{100 * report.metrics[f'{name}/{kind}']:.2f}" for kind in kinds)]
            for name in (*TOUCH.names, "overall")
        ),
    ]
    tables["Errors by the highest reading above idle"] = [
        ["N", "touches", *(f"{name} wrong, %" for name in TOUCH.names)],
        *(
            [_range(faint), str(faint.count), *(f"{100 * n / faint.count:.1f}" for n in faint.wrong.values())]
            for faint in report.faint
        ),
    ]
    data: list[Sequence[object]] = [["label", "by", "low", "high", "touches", "said", "wrong"]]
    for name, spans in report.spans.items():
        data += ([name, "threshold", s.low, s.high, s.count, s.said, s.wrong] for s in spans)
    for name in TOUCH.names:
        data += ([name, "reading", f.low, f.high, f.count, "", f.wrong[name]] for f in report.faint)
    return Page(margins_summary(report), tables, data, _margins_figure(report, title))


def margins_summary(report: MarginReport) -> str:
    """Return a summary in one line: the number of errors close to a threshold or on weak touches."""
    wrong = {name: sum(span.wrong for span in report.spans[name]) for name in TOUCH.names}
    near = {
        name: sum(span.wrong for span in report.spans[name] if _NEAR[0] <= span.low and span.high <= _NEAR[1])
        for name in ("big", "dangerous")
    }
    faint = sum(span.wrong["dynamic"] for span in report.faint if span.high <= _FAINT)
    clear = [span for span in report.spans[ALARM_NAME] if span.low >= _NEAR[1]]
    return (
        f"within 10 % of their thresholds lie {near['big']} of {wrong['big']} errors of big and "
        f"{near['dangerous']} of {wrong['dangerous']} of dangerous; no reading passes {_FAINT:g} N in "
        f"{faint} of {wrong['dynamic']} errors of dynamic; {sum(span.wrong for span in clear)} of "
        f"{sum(span.count for span in clear)} touches more than 10 % above the threshold of dangerous raise "
        f"no alarm; {report.point.sentence()}; {report.reached.sentence()}"
    )


def _margins_figure(report: MarginReport, title: str) -> Figure:
    """Draw what is said against measure over threshold, and errors against the highest reading."""
    called = {
        name: np.array(
            [(s.mean, 100 * s.said / s.count, 100 * s.range[0], 100 * s.range[1]) for s in report.spans[name]]
        ).T
        for name in ("big", "dangerous", ALARM_NAME)
    }
    wrong = {
        name: np.array([(n, 100 * f.wrong[name] / f.count) for n, f in enumerate(report.faint)]).T
        for name in TOUCH.names
    }
    label = "area (big) or pressure (dangerous) over its threshold"
    ticks = [f"{_range(faint)}\n{faint.count}" for faint in report.faint]
    return draw_panels(
        title,
        [
            Panel(label, "touches called so, %, with 95 %", called, limits=(0.4, 2.5)),
            Panel("highest reading above idle, N; touches", "wrong, %", wrong, ticks=ticks),
        ],
    )


def _share(span: Span) -> tuple[str, str]:
    low, high = span.range
    return f"{100 * span.said / span.count:.1f}", f"{100 * low:.1f} to {100 * high:.1f}"


def _range(span: Span | Faint) -> str:
    return f"above {span.low:g}" if math.isinf(span.high) else f"{span.low:g} to {span.high:g}"


def streams_page(report: WindowReport, title: str) -> Page:
    """Return the tables, the CSV (``measure,name,at,value``) and the figure, under a title."""
    trained = "windows of streams" if report.streamed else "whole touches"
    about = f"Trained on {trained}, tried on windows of streams; {report.point.sentence()}."
    return Page(
        f"{streams_summary(report)}\n\n{about}",
        _streams_tables(report),
        _streams_data(report),
        _streams_figure(report, title),
    )


def streams_summary(report: WindowReport) -> str:
    """Return a summary in one line."""
    parts = []
    if report.bins:
        shares = (
            f"{100 * part.overall:.1f} % at share {part.name} (always the commoner answer: "
            f"{100 * fmean(part.majority.values()):.1f} %)"
            for part in (report.bins[0], report.bins[-1])
        )
        parts.append(f"accuracy {', '.join(shares)}")
    parts += [f"touch by {gate} {100 * _right(counts):.1f} %" for gate, counts in report.gates.items()]
    hourly = ", ".join(f"{alarms.per_hour:.1f} ({gate})" for gate, alarms in report.alarms.items())
    touched = 100 * (1 - _idle_hours(report) / report.hours)
    raised = ", ".join(f"{alarms.raised} of {alarms.safe} ({gate})" for gate, alarms in report.alarms.items())
    windows = ", ".join(f"{window:g} s: {_length(value)}" for window, value in report.lengths.items())
    parts += [
        f"false alarms per hour without touch {hourly}; {touched:.0f} % of {report.hours:g} h show a touch",
        f"safe touches that raised the alarm {raised}",
        f"window {windows}",
    ]
    return "; ".join(parts)


def _streams_tables(report: WindowReport) -> dict[str, list[list[str]]]:
    """Return heading -> table, its head first."""
    bins = report.bins
    accuracies = [
        [name, *(f"{100 * part.accuracy[name]:.1f} ({100 * part.majority[name]:.1f})" for part in bins)]
        for name in (bins[0].accuracy if bins else ())
    ]
    gates = [
        [gate, *(str(int(count)) for count in counts.flatten()), f"{100 * _right(counts):.1f}"]
        for gate, counts in report.gates.items()
    ]
    alarms = [
        [
            gate,
            str(heard.false),
            f"{heard.per_hour:.1f} ({heard.range[0]:.1f} to {heard.range[1]:.1f})",
            f"{heard.found} of {heard.dangerous}",
            f"{heard.raised} of {heard.safe}",
        ]
        for gate, heard in report.alarms.items()
    ]
    return {
        "Accuracy by the share of the touch that is seen, % (always the commoner answer)": [
            ["label", *(part.name for part in bins)],
            *accuracies,
            ["windows", *(str(part.count) for part in bins)],
        ],
        f"Touch or none, truth: said (threshold {report.threshold:.3f} N)": [
            ["gate", "idle: idle", "idle: touched", "touched: idle", "touched: touched", "right, %"],
            *gates,
        ],
        f"Alarms in a stream of {report.hours:g} h, {_idle_hours(report):.2f} h of it without touch": [
            ["gate", "false", "false per hour (95 %)", "dangerous found", "safe that raised one"],
            *alarms,
        ],
        "Windows of other lengths": [
            ["s", "overall accuracy, %"],
            *([f"{window:g}", _length(value)] for window, value in report.lengths.items()),
        ],
    }


def _streams_data(report: WindowReport) -> list[Sequence[object]]:
    """Return every figure as ``measure,name,at,value``."""
    data: list[Sequence[object]] = [["measure", "name", "at", "value"]]
    for part in report.bins:
        data.append(["windows", "", part.name, part.count])
        data += (["accuracy", name, part.name, f"{v:.4f}"] for name, v in part.accuracy.items())
        data += (["majority", name, part.name, f"{v:.4f}"] for name, v in part.majority.items())
    cells = ("idle said idle", "idle said touched", "touched said idle", "touched said touched")
    for gate, counts in report.gates.items():
        data += ([cell, gate, "", int(n)] for cell, n in zip(cells, counts.flatten(), strict=True))
    for gate, alarms in report.alarms.items():
        data += ([f"alarms {name}", gate, "", value] for name, value in vars(alarms).items())
    data.append(["threshold, N", "threshold", "", f"{report.threshold:.4f}"])
    data.append(["stream, h", "", "", report.hours])
    data += (["window, s", "overall", f"{window:g}", value] for window, value in report.lengths.items())
    return data


def _streams_figure(report: WindowReport, title: str) -> Figure:
    """Draw accuracy against the share that is seen, and alarms by gate."""
    bins = report.bins
    shares = {
        name: np.array([(n, 100 * part.accuracy[name]) for n, part in enumerate(bins)]).T
        for name in (bins[0].accuracy if bins else ())
    }
    heard = {
        "false alarms": np.array(
            [(n, alarms.per_hour, *alarms.range) for n, alarms in enumerate(report.alarms.values())]
        ).T
    }
    gates = [
        f"{gate}\n{alarms.found}/{alarms.dangerous} found\n{alarms.raised}/{alarms.safe} safe raised"
        for gate, alarms in report.alarms.items()
    ]
    return draw_panels(
        title,
        [
            Panel(
                "share of the touch in the window, number of windows",
                "accuracy, %",
                shares,
                ticks=[f"{part.name}\n{part.count}" for part in bins],
            ),
            Panel(
                f"{_idle_hours(report):.2f} h without touch",
                "false alarms per hour, 95 %",
                heard,
                ticks=gates,
            ),
        ],
    )


def _idle_hours(report: WindowReport) -> float:
    return next(iter(report.alarms.values())).idle_hours


def _right(counts: Tensor) -> float:
    return float(counts.diag().sum() / counts.sum())


def _length(value: float | str) -> str:
    return f"cannot ({value})" if isinstance(value, str) else f"{100 * value:.1f}"
