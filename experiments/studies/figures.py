"""The figure of a study, and those of measures of single runs."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from experiments.studies.outcomes import UNITS, group_trials, heading, mean_and_margin
from experiments.studies.study import Study
from experiments.studies.trials import Trial
from skin.plot.figures import COLOURS, MARKS

_NUMBERED = re.compile(r"(.+) (\d+)")
_MARKERS = "osD^v<>pP*"


def study_figure(study: Study, trials: Sequence[Trial]) -> Figure:
    """Draw the first metric: lines over the numbers in the names if the study has an axis, else strips."""
    return _lines(study, trials) if study.axis else _strips(study, trials)


def _strips(study: Study, trials: Sequence[Trial]) -> Figure:
    """Draw every trial of each variant and condition, the mean, and its 95 % interval.

    Conditions have a line each, or share the line of their variant if there are several of both.
    """
    metric, groups = study.metrics[0], group_trials(trials)
    variants, conditions = (list(dict.fromkeys(key[part] for key in groups)) for part in (0, 1))
    shared = len(variants) > 1 and len(conditions) > 1
    lines = variants if shared else [", ".join(filter(None, key)) for key in groups]
    height = 0.1 * max(len(conditions), 3) if shared else 0.3
    figure = Figure(figsize=(8, 1.2 + height * len(lines)), layout="constrained")
    axis = figure.subplots()
    scale, labelled = 1 if metric in UNITS else 100, set[str]()
    for number, ((variant, condition), group) in enumerate(groups.items()):
        if not (figures := [scale * trial.metrics[metric] for trial in group if metric in trial.metrics]):
            continue
        style = conditions.index(condition) if shared else 0
        apart = 0.8 * ((style + 0.5) / len(conditions) - 0.5) if shared else 0.0
        place = (variants.index(variant) if shared else number) + apart
        colour, marker = COLOURS[style % len(COLOURS)], _MARKERS[style % len(_MARKERS)]
        mean, _, margin = mean_and_margin(group, metric)
        axis.plot(figures, [place] * len(figures), marker, color=colour, alpha=0.35, ms=4)
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
        figure.legend(loc="outside right center", fontsize=7)
        axis.grid(axis="y", alpha=0.2)
    return figure


def _lines(study: Study, trials: Sequence[Trial]) -> Figure:
    """Draw the mean and its 95 % interval over the number at the end of a variant's or condition's name.

    Names of several words before the number, as "arm grid 9", get a panel for each beginning.
    """
    metric, groups = study.metrics[0], group_trials(trials)
    single = len({variant for variant, _ in groups}) == 1
    points: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
    for (variant, condition), group in groups.items():
        numbered = _NUMBERED.fullmatch(condition if single else variant)
        if numbered and any(metric in trial.metrics for trial in group):
            panel, _, name = numbered[1].rpartition(" ")
            mean, _, margin = mean_and_margin(group, metric)
            label = ", ".join(filter(None, (name, "" if single else condition)))
            points[panel, label].append((int(numbered[2]), mean, mean - margin, mean + margin))
    lines = {key: np.array(sorted(line)).T for key, line in points.items() if len(line) > 1}
    up = f"{_label(metric)}: mean and 95 % interval"
    panels = [
        Panel(study.axis or "", up, {name: line for (at, name), line in lines.items() if at == panel}, panel)
        for panel in dict.fromkeys(panel for panel, _ in lines)
    ]
    return draw_panels(study.about, panels or [Panel(study.axis or "", up, {})])


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
