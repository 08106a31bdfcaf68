"""Page and summary of an evaluation on streams."""

from collections.abc import Sequence
from statistics import fmean

from matplotlib.figure import Figure
from torch import Tensor

from experiments.studies.tables import Page
from skin.evaluation.streams import Alarms, WindowReport
from skin.plot.figures import COLOURS, MARKS


def build_streams_page(found: WindowReport, title: str) -> Page:
    """Return the tables, the CSV and the figure, under a title."""
    learnt = "windows of streams" if found.streamed else "whole touches"
    about = f"Trained on {learnt}, tried on windows of streams; {found.point.sentence()}."
    return Page(f"{streams_summary(found)}\n\n{about}", _tables(found), _csv(found), _figure(found, title))


def streams_summary(found: WindowReport) -> str:
    """Return a summary in one line."""
    parts = []
    if found.bins:
        ends = found.bins[0], found.bins[-1]
        told = (
            f"{100 * one.overall:.1f} % at share {one.name} (always the commoner answer: "
            f"{100 * fmean(one.majority.values()):.1f} %)"
            for one in ends
        )
        parts.append(f"accuracy {', '.join(told)}")
    for gate, counts in found.gates.items():
        parts.append(f"touch by {gate} {100 * _right(counts):.1f} %")
    hourly = ", ".join(f"{alarms.per_hour:.1f} ({gate})" for gate, alarms in found.alarms.items())
    share = 100 * (1 - _idle(found.alarms) / found.hours)
    parts.append(
        f"false alarms per hour without touch {hourly}; {share:.0f} % of {found.hours:g} h show a touch"
    )
    raised = ", ".join(f"{one.raised} of {one.safe} ({gate})" for gate, one in found.alarms.items())
    parts.append(f"safe touches that raised the alarm {raised}")
    windows = (f"{window:g} s: {_length(value)}" for window, value in found.lengths.items())
    return "; ".join([*parts, "window " + ", ".join(windows)])


def _tables(found: WindowReport) -> dict[str, list[list[str]]]:
    """Return heading -> table, its head first."""
    names = list(found.bins[0].accuracy) if found.bins else []
    shares = [
        [name, *(f"{100 * one.accuracy[name]:.1f} ({100 * one.majority[name]:.1f})" for one in found.bins)]
        for name in names
    ]
    told = [
        [gate, *(str(int(count)) for count in counts.flatten()), f"{100 * _right(counts):.1f}"]
        for gate, counts in found.gates.items()
    ]
    alarms = [
        [
            gate,
            str(heard.false),
            f"{heard.per_hour:.1f} ({heard.range[0]:.1f} to {heard.range[1]:.1f})",
            f"{heard.found} of {heard.dangerous}",
            f"{heard.raised} of {heard.safe}",
        ]
        for gate, heard in found.alarms.items()
    ]
    head = ["gate", "idle: idle", "idle: touched", "touched: idle", "touched: touched", "right, %"]
    return {
        "Accuracy by the share of the touch that is seen, % (always the commoner answer)": [
            ["label", *(one.name for one in found.bins)],
            *shares,
            ["windows", *(str(one.count) for one in found.bins)],
        ],
        f"Touch or none, truth: said (threshold {found.threshold:.3f} N)": [head, *told],
        f"Alarms in a stream of {found.hours:g} h, {_idle(found.alarms):.2f} h of it without touch": [
            ["gate", "false", "false per hour (95 %)", "dangerous found", "safe that raised one"],
            *alarms,
        ],
        "Windows of other lengths": [
            ["s", "overall accuracy, %"],
            *([f"{window:g}", _length(value)] for window, value in found.lengths.items()),
        ],
    }


def _csv(found: WindowReport) -> list[Sequence[object]]:
    """Return every figure as ``measure,name,at,value``."""
    table: list[Sequence[object]] = [["measure", "name", "at", "value"]]
    for one in found.bins:
        table.append(["windows", "", one.name, one.count])
        table += (["accuracy", name, one.name, f"{v:.4f}"] for name, v in one.accuracy.items())
        table += (["majority", name, one.name, f"{v:.4f}"] for name, v in one.majority.items())
    for gate, counts in found.gates.items():
        cells = ("idle said idle", "idle said touched", "touched said idle", "touched said touched")
        table += ([gate_cell, gate, "", int(n)] for gate_cell, n in zip(cells, counts.flatten(), strict=True))
    for gate, alarms in found.alarms.items():
        table += ([f"alarms {name}", gate, "", value] for name, value in vars(alarms).items())
    table.append(["threshold, N", "threshold", "", f"{found.threshold:.4f}"])
    table.append(["stream, h", "", "", found.hours])
    table += (["window, s", "overall", f"{window:g}", value] for window, value in found.lengths.items())
    return table


def _figure(found: WindowReport, title: str) -> Figure:
    """Draw accuracy against the share that is seen, and alarms by gate."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    names = list(found.bins[0].accuracy) if found.bins else []
    places = range(len(found.bins))
    for name, colour, mark in zip(names, COLOURS, MARKS, strict=False):
        style = {"marker": mark, "color": colour}
        left.plot(places, [100 * one.accuracy[name] for one in found.bins], ms=4, label=name, **style)
        left.plot(places, [100 * one.majority[name] for one in found.bins], ":", ms=2, lw=1, **style)
    left.set_xticks(places, [f"{one.name}\n{one.count}" for one in found.bins])
    left.set_xlabel("share of the touch in the window, number of windows")
    left.set_ylabel("accuracy, % (dotted: commoner answer)")
    left.legend(fontsize=8)
    left.set_title(title, fontsize=10)
    spots = range(len(found.alarms))
    rates = [heard.per_hour for heard in found.alarms.values()]
    spread = [
        [rate - heard.range[0] for rate, heard in zip(rates, found.alarms.values(), strict=True)],
        [heard.range[1] - rate for rate, heard in zip(rates, found.alarms.values(), strict=True)],
    ]
    right.bar(spots, rates, yerr=spread, color=COLOURS[1], width=0.6, capsize=4)
    right.set_ylim(bottom=0)
    labels = [
        f"{gate}\n{heard.found}/{heard.dangerous} found\n{heard.raised}/{heard.safe} safe raised"
        for gate, heard in found.alarms.items()
    ]
    right.set_xticks(spots, labels, fontsize=8)
    right.set_ylabel("false alarms per hour, 95 %")
    right.set_title(f"{_idle(found.alarms):.2f} h without touch", fontsize=10)
    return figure


def _idle(alarms: dict[str, Alarms]) -> float:
    return next(iter(alarms.values())).idle_hours


def _right(counts: Tensor) -> float:
    return float(counts.diag().sum() / counts.sum())


def _length(value: float | str) -> str:
    return f"cannot ({value})" if isinstance(value, str) else f"{100 * value:.1f}"
