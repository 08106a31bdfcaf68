"""Pages of the measures of single runs: errors by margin, and windows of streams."""

import math
from collections.abc import Sequence
from statistics import fmean

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from experiments.studies.figures import Panel, draw_panels
from experiments.studies.tables import Page
from skin.evaluation.margins import ALARM_NAME, Faint, MarginReport, Span
from skin.evaluation.streams import WindowReport
from skin.touch.labels import OPPOSITE, TOUCH

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
