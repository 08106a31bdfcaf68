"""Page and summary of the errors of a learner by margin."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.studies.tables import Page
from skin.evaluation.margins import ALARM_NAME, Faint, MarginReport, Span
from skin.labels import OPPOSITE, TOUCH
from skin.plot.figures import COLOURS, MARKS

_MEASURES = {
    "big": "area",
    "dynamic": "travel",
    "press": "duration",
    "dangerous": "pressure",
    ALARM_NAME: "pressure",
}
_OVERALL = ("accuracy", "balanced_accuracy", "ece")
_NEAR = (0.9, 1.1)  # times its threshold
_FAINT = 1.0  # N


def build_margins_page(found: MarginReport, title: str) -> Page:
    """Return the tables, the CSV and the figure, under a title."""
    return Page(margins_summary(found), _tables(found), _csv(found), _figure(found, title))


def margins_summary(found: MarginReport) -> str:
    """Return a summary in one line: the number of errors close to a threshold or on weak touches."""
    wrong = {name: sum(one.wrong for one in found.spans[name]) for name in TOUCH.names}
    near = {
        name: sum(one.wrong for one in found.spans[name] if _NEAR[0] <= one.low and one.high <= _NEAR[1])
        for name in ("big", "dangerous")
    }
    faint = sum(one.wrong["dynamic"] for one in found.faint if one.high <= _FAINT)
    clear = [one for one in found.spans[ALARM_NAME] if one.low >= _NEAR[1]]
    return (
        f"within 10 % of their thresholds lie {near['big']} of {wrong['big']} errors of big and "
        f"{near['dangerous']} of {wrong['dangerous']} of dangerous; no reading passes {_FAINT:g} N in "
        f"{faint} of {wrong['dynamic']} errors of dynamic; {sum(one.wrong for one in clear)} of "
        f"{sum(one.count for one in clear)} touches more than 10 % above the threshold of dangerous raise no "
        f"alarm; {found.point.sentence()}; {found.reached.sentence()}"
    )


def _tables(found: MarginReport) -> dict[str, list[list[str]]]:
    """Return heading -> table, its head first."""
    tables = {
        _heading(name, found): [
            [f"{_MEASURES[name]} over threshold", "touches", f"called {_called(name)}, %", "95 %", "wrong"],
            *(_row(one) for one in each),
        ]
        for name, each in found.spans.items()
    }
    tables["All touches"] = [
        ["label", "accuracy, %", "balanced accuracy, %", "calibration error, %"],
        *(
            [name, *(f"{100 * found.metrics[f'{name}/{metric}']:.2f}" for metric in _OVERALL)]
            for name in (*TOUCH.names, "overall")
        ),
    ]
    tables["Errors by the highest reading above idle"] = [
        ["N", "touches", *(f"{name} wrong, %" for name in TOUCH.names)],
        *(
            [_span(one), str(one.count), *(f"{100 * value / one.count:.1f}" for value in one.wrong.values())]
            for one in found.faint
        ),
    ]
    return tables


def _heading(name: str, found: MarginReport) -> str:
    if name == ALARM_NAME:
        return f"Alarm above {found.point.threshold:.4f}"
    return f"{name.capitalize()} or {OPPOSITE[name]}"


def _called(name: str) -> str:
    return "dangerous" if name == ALARM_NAME else name


def _row(one: Span) -> list[str]:
    low, high = one.range
    share = f"{100 * one.said / one.count:.1f}"
    return [_span(one), str(one.count), share, f"{100 * low:.1f} to {100 * high:.1f}", str(one.wrong)]


def _span(one: Span | Faint) -> str:
    return f"above {one.low:g}" if math.isinf(one.high) else f"{one.low:g} to {one.high:g}"


def _csv(found: MarginReport) -> list[Sequence[object]]:
    """Return every figure as ``label,by,low,high,touches,said,wrong``."""
    head: list[object] = ["label", "by", "low", "high", "touches", "said", "wrong"]
    spans = [
        [name, "threshold", one.low, one.high, one.count, one.said, one.wrong]
        for name, each in found.spans.items()
        for one in each
    ]
    faint = [
        [name, "reading", one.low, one.high, one.count, "", one.wrong[name]]
        for name in TOUCH.names
        for one in found.faint
    ]
    return [head, *spans, *faint]


def _figure(found: MarginReport, title: str) -> Figure:
    """Draw what is said against measure over threshold, and errors against the highest reading."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    styles = dict(zip([*TOUCH.names, ALARM_NAME], zip(COLOURS, MARKS, strict=True), strict=False))
    for name in ("big", "dangerous", ALARM_NAME):
        _course(left, found.spans[name], name, *styles[name])
    left.axvline(1, color="black", lw=0.8, ls=":")
    left.set_xscale("log")
    left.set_xlim(0.4, 2.5)
    left.set_xticks([0.5, 0.8, 1, 1.25, 2], ["0.5", "0.8", "1", "1.25", "2"])
    left.set_xticks([], minor=True)
    left.set_xlabel("area (big) or pressure (dangerous) over its threshold")
    left.set_ylabel("touches called so, %, with 95 %")
    left.legend(fontsize=8)
    left.set_title(title, fontsize=10)
    places = range(len(found.faint))
    for name in TOUCH.names:
        colour, mark = styles[name]
        shares = [100 * one.wrong[name] / one.count for one in found.faint]
        right.plot(places, shares, marker=mark, color=colour, ms=4, label=name)
    right.set_xticks(places, [f"{_span(one)}\n{one.count}" for one in found.faint], fontsize=7)
    right.set_xlabel("highest reading above idle, N; touches")
    right.set_ylabel("wrong, %")
    right.set_ylim(bottom=0)
    right.legend(fontsize=8)
    return figure


def _course(axis: Axes, each: list[Span], name: str, colour: str, mark: str) -> None:
    shares = [100 * one.said / one.count for one in each]
    spread = [
        [share - 100 * one.range[0] for share, one in zip(shares, each, strict=True)],
        [100 * one.range[1] - share for share, one in zip(shares, each, strict=True)],
    ]
    axis.errorbar(
        [one.mean for one in each],
        shares,
        spread,
        marker=mark,
        color=colour,
        ms=4,
        lw=1,
        capsize=2,
        label=name,
    )
