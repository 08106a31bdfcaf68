"""The figure of a study, and those of measures of single runs."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.studies.outcomes import UNITS, group_trials, heading, mean_and_margin
from experiments.studies.study import Study
from experiments.studies.trials import Trial
from skin.plot.figures import COLOURS, MARKS

_NUMBERED = re.compile(r"(.+) (\d+)")
_MARKERS = "osD^v<>pP*"
_STYLES = ("-", "--", ":", "-.")


def study_figure(study: Study, trials: Sequence[Trial]) -> Figure:
    """Draw the first metric: lines over the numbers in the names if the study has an axis, else strips."""
    return _lines(study, trials) if study.axis else _strips(study, trials)


def _strips(study: Study, trials: Sequence[Trial]) -> Figure:
    """Draw every trial of each variant and condition, the mean, and its 95 % interval.

    Conditions have a line each, or share the line of their variant if there are several of both.
    """
    metric, found = study.metrics[0], group_trials(trials)
    variants, conditions = (list(dict.fromkeys(key[part] for key in found)) for part in (0, 1))
    shared = len(variants) > 1 and len(conditions) > 1
    lines = variants if shared else [", ".join(filter(None, key)) for key in found]
    height = 0.1 * max(len(conditions), 3) if shared else 0.3
    drawn = Figure(figsize=(8, 1.2 + height * len(lines)), layout="constrained")
    axis = drawn.subplots()
    scale, labelled = 1 if metric in UNITS else 100, set[str]()
    for number, ((variant, condition), each) in enumerate(found.items()):
        if not (every := [scale * one.metrics[metric] for one in each if metric in one.metrics]):
            continue
        style = conditions.index(condition) if shared else 0
        apart = 0.8 * ((style + 0.5) / len(conditions) - 0.5) if shared else 0.0
        place = (variants.index(variant) if shared else number) + apart
        colour, marker = COLOURS[style % len(COLOURS)], _MARKERS[style % len(_MARKERS)]
        mean, _, margin = mean_and_margin(each, metric)
        axis.plot(every, [place] * len(every), marker, color=colour, alpha=0.35, ms=4)
        ends = colour if shared else "black"
        label = condition or "no condition" if shared and condition not in labelled else None
        labelled.add(condition)
        axis.errorbar(mean, place, xerr=margin, fmt=marker if shared else "|", color=ends, label=label,
                      ms=4 if shared else 10, capsize=2)  # fmt: skip
    axis.set_yticks(range(len(lines)), lines, fontsize=8)
    axis.set_ylim(len(lines) - 0.5, -0.5)
    axis.set_xlabel(f"{_label(metric)}: each run, mean and 95 % interval")
    axis.set_title(study.about, fontsize=9, wrap=True)
    if shared:
        drawn.legend(loc="outside right center", fontsize=7)
        axis.grid(axis="y", alpha=0.2)
    return drawn


def _lines(study: Study, trials: Sequence[Trial]) -> Figure:
    """Draw the mean and its 95 % interval over the number at the end of a variant's or condition's name.

    Names of several words before the number, as "arm grid 9", get a panel for each beginning.
    """
    metric, found = study.metrics[0], group_trials(trials)
    single = len({variant for variant, _ in found}) == 1
    every: dict[tuple[str, str], list[tuple[int, float, float]]] = defaultdict(list)
    for (variant, condition), each in found.items():
        numbered = _NUMBERED.fullmatch(condition if single else variant)
        if numbered and any(metric in one.metrics for one in each):
            key = numbered[1], "" if single else condition
            mean, _, margin = mean_and_margin(each, metric)
            every[key].append((int(numbered[2]), mean, margin))
    lines = {key: points for key, points in every.items() if len(points) > 1}
    panels = list(dict.fromkeys(name.rpartition(" ")[0] for name, _ in lines)) or [""]
    drawn = Figure(figsize=(7 if len(panels) == 1 else 4 * len(panels), 4.5), layout="constrained")
    for panel, axis in zip(panels, drawn.subplots(ncols=len(panels), squeeze=False)[0], strict=True):
        named = {(name.rpartition(" "), condition): points for (name, condition), points in lines.items()}
        _panel(axis, {(parts[2], key): points for (parts, key), points in named.items() if parts[0] == panel})
        axis.set_title(panel, fontsize=9)
        axis.set_xlabel(study.axis or "")
    drawn.axes[0].set_ylabel(f"{_label(metric)}: mean and 95 % interval")
    drawn.suptitle(study.about, fontsize=9, wrap=True)
    return drawn


def _panel(axis: Axes, lines: dict[tuple[str, str], list[tuple[int, float, float]]]) -> None:
    """Draw a line per name and condition; the name gives colour and marker, the condition the style."""
    names, conditions = (list(dict.fromkeys(key[part] for key in lines)) for part in (0, 1))
    for (name, condition), points in lines.items():
        x, y, margins = zip(*sorted(points), strict=True)
        number, label = names.index(name), ", ".join(filter(None, (name, condition)))
        axis.errorbar(
            x, y, yerr=margins, label=label, ms=4, capsize=2, lw=1.2,
            color=COLOURS[number % len(COLOURS)], marker=_MARKERS[number % len(_MARKERS)],
            linestyle=_STYLES[conditions.index(condition) % len(_STYLES)],
        )  # fmt: skip
    numbers = sorted({x for points in lines.values() for x, *_ in points})
    axis.set_xscale("log")
    axis.set_xticks(numbers, [str(x) for x in numbers], fontsize=7)
    axis.set_xticks([], minor=True)
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)


def _label(metric: str) -> str:
    unit = UNITS.get(metric, "%")
    return f"{heading(metric)}{f', {unit}' if unit else ''}"


@dataclass(frozen=True)
class Panel:
    """Lines with the same axes.

    Attributes:
        across: label of the axis across.
        up: label of the axis up.
        lines: name -> rows of x and y, and of the ends of their intervals where there are some, (2 or 4, N).
        ticks: labels of x = 0, 1, ...; none: numbers on a logarithmic axis.
        limits: of x.
    """

    across: str
    up: str
    lines: Mapping[str, np.ndarray]
    ticks: Sequence[str] = ()
    limits: tuple[float, float] | None = None


def draw_panels(title: str, panels: Sequence[Panel]) -> Figure:
    """Draw panels side by side, under a title."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    figure.suptitle(title, fontsize=10)
    for panel, axis in zip(panels, figure.subplots(ncols=len(panels), squeeze=False)[0], strict=True):
        for (name, line), colour, marker in zip(panel.lines.items(), COLOURS, MARKS, strict=False):
            if not len(line):
                continue
            x, y, *ends = line
            spread = (y - ends[0], ends[1] - y) if ends else None
            axis.errorbar(x, y, spread, label=name, color=colour, marker=marker, ms=4, lw=1, capsize=2)
        if panel.ticks:
            axis.set_xticks(range(len(panel.ticks)), panel.ticks, fontsize=7)
        else:
            axis.axvline(1, color="black", lw=0.8, ls=":")
            axis.set_xscale("log")
        axis.set_xlim(panel.limits)
        axis.set_ylim(bottom=0)
        axis.set_xlabel(panel.across)
        axis.set_ylabel(panel.up)
        axis.legend(fontsize=8)
    return figure
