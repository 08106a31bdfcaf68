"""Pages of results: tables with verdicts, CSV files and figures."""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from experiments.studies.comparison import (
    UNITS,
    Conclusion,
    Estimate,
    by_gesture,
    compare_samples,
    conclude,
    differences,
    estimate,
    values,
)
from experiments.studies.study import Study
from skin.core.files import candidates, whole, write
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.evaluation.metrics import decode
from skin.mechanics.simulator.naive import Naive
from skin.plot.figures import (
    COLOURS,
    MARKS,
    confusions,
    force_and_reading,
    misclassified,
    misclassified_fractions,
    save_figure,
    traces,
)
from skin.runs.build import build_device
from skin.runs.configuration import Config
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


def markdown(table: pd.DataFrame) -> str:
    """Return a table of texts as Markdown."""
    lines = [
        "| " + " | ".join(line) + " |"
        for line in [list(table.columns), *table.fillna("").to_numpy().tolist()]
    ]
    return "\n".join([lines[0], "|" + "---|" * len(table.columns), *lines[1:]]) + "\n"


def publish_study(study: Study, title: str, trials: pd.DataFrame, path: Path) -> list[Path]:
    """Write ``path`` with the endings .md, .csv and .png, each whole, print the tables, and return the paths.

    Args:
        study: whose trials they are.
        title: of the page.
        trials: all of them.
        path: without an ending.
    """
    reference, metric = read_reference(study.reference), study.metrics[0]
    tables = {
        "Variants": variants_table(trials, study.metrics, reference),
        f"Differences in {metric_heading(metric)}": differences_table(study, trials),
        "Statements": statements_table([conclude(statement, trials) for statement in study.statements]),
    }
    print(title)
    for name, table in tables.items():
        if len(table):
            print(name, table.to_string(index=False, justify="left"), "", sep="\n")
    if trials.variant.nunique() > 1 and trials.condition.any():
        # Conditions take the columns, so that each further metric has a table.
        further = {metric_heading(name): variants_table(trials, [name]) for name in study.metrics[1:]}
        tables = {"Variants": tables["Variants"], **further} | tables
    finished = trials[trials.run != ""]
    data = finished.reindex(columns=[*identity(study), *study.metrics])
    if reference:
        data["reference"] = [_referred(row, metric, reference) for row in finished.itertuples()]
    figure = study_figure(study, trials) if len(finished) else None
    shown = {name: table for name, table in tables.items() if len(table)}
    return publish_page(Page("", shown, data, figure), title, path)


def publish_measured(study: Study, trials: pd.DataFrame, path: Path) -> list[Path]:
    """Write the tables of a measure: of several runs a CSV file, each line behind its trial.

    Args:
        study: whose tables they are.
        trials: with the ``page`` of each.
        path: without an ending.
    """
    trials = trials[[isinstance(page, Page) and not page.data.empty for page in trials.page]]
    if len(trials) < (2 if study.has_runs else 1):
        return []
    rows = pd.concat([page.data for page in trials.page], keys=range(len(trials)))
    if study.has_runs:
        keys = trials[identity(study)].set_axis(range(len(trials)))
        joined = keys.loc[rows.index.get_level_values(0)].set_axis(rows.index)
        return [write_csv(pd.concat([joined, rows], axis=1), path.with_name(f"{path.name}.csv"))]
    about = "\n".join(page.about for page in trials.page if page.about)
    figure = next((page.figure for page in trials.page if page.figure), None)
    tables = {} if len(rows) < 2 else {"Measured": rows.astype(str)}
    return publish_page(Page(about, tables, rows, figure), f"{study.name}: {study.about}", path)


def identity(study: Study) -> list[str]:
    """Return the columns that tell the trials of a study apart."""
    return ["variant", "seed", *(["condition", "device"] if study.conditions else []), "run"]


Reference = Mapping[tuple[str, str, str], float]
"""Row, simulator and label -> value."""


def read_reference(path: str | None) -> Reference:
    """Return the values of a CSV file: (row, simulator, label) -> value; none without a file."""
    if path is None:
        return {}
    files = [file for file in candidates(path) if file.is_file()]
    if not files:
        raise InputError(f"there is no file study.reference={path}: give another, or null")
    return pd.read_csv(files[0]).set_index(["row", "simulator", "label"])["value"].to_dict()


def metric_heading(metric: str) -> str:
    """Return the name of a column: ``overall`` of ``same/overall/accuracy``."""
    headings = {
        "same/dangerous/alarm_recall": "recall",
        "same/dangerous/false_alarm_rate": "false alarms",
        "train_accuracy": "training",
        "seconds_per_epoch": "s/epoch",
        "same/direction/degrees": "degrees",
        "same/direction/accuracy": "within 45°",
        "device_shift/dangerous/alarm_recall": "its recall",
        "device_shift/dangerous/false_alarm_rate": "its false alarms",
    }
    plain = metric.removeprefix("same/").removesuffix("/accuracy").replace("/overall", "")
    return headings.get(metric, plain.replace("_", " "))


def variants_table(
    trials: pd.DataFrame, metrics: Sequence[str], reference: Reference | None = None
) -> pd.DataFrame:
    """Return a line per variant with the mean and margin of each metric; or of conditions.

    Where one variant has conditions, each is a line. Where several do, each is a column of the first metric.
    A value of the reference stands in brackets behind ours.
    """
    groups = trials.groupby(["variant", "condition"], sort=False)
    variants, conditions = trials.variant.unique(), [name for name in trials.condition.unique() if name]
    if conditions and len(variants) > 1:
        cells = pd.Series({key: _cell(group, metrics[0]) for key, group in groups}).unstack(fill_value="")
        return cells.reindex(variants, columns=conditions).fillna("").rename_axis("variant").reset_index()
    lines = []
    for (variant, condition), group in groups:
        if conditions and not condition:
            continue
        failed = int((group.run == "").sum())
        cells = [_cell(group, metric, reference) for metric in metrics]
        cells = ["failed", *[""] * (len(metrics) - 1)] if failed == len(group) else cells
        lines.append([condition or variant + (f" ({failed} failed)" if failed else ""), *cells])
    heading = variants[0] if conditions else "variant"
    return pd.DataFrame(lines, columns=[heading, *map(metric_heading, metrics)])


def differences_table(study: Study, trials: pd.DataFrame) -> pd.DataFrame:
    """Return a line per difference, ± margin; none where the study compares nothing."""
    unit, lines = UNITS.get(study.metrics[0], "points"), []
    for variant, condition, compared, verdict in differences(study, trials) if study.differences else ():
        count = str(compared.seeds if compared else 0)
        lines.append([variant, condition, figure_text(compared, unit), count, verdict])
    return pd.DataFrame(lines, columns=["variant", "condition", "difference", "n", "verdict"])


def statements_table(conclusions: Iterable[Conclusion]) -> pd.DataFrame:
    """Return a line per statement."""
    lines = [
        [each.statement.section, each.statement.says, comparison_text(each), each.verdict]
        for each in conclusions
    ]
    return pd.DataFrame(lines, columns=["section", "statement", "measured", "verdict"])


def comparison_text(conclusion: Conclusion) -> str:
    """Return every comparison of a statement: the mean over paired seeds ± margin."""
    statement, several = conclusion.statement, len(conclusion.compared) > 1
    unit = "times" if statement.ratio else UNITS.get(statement.metric, "points")
    texts = {name: figure_text(comparison, unit) for name, comparison in conclusion.compared.items()}
    return "; ".join(text + f" ({name})" if several else text for name, text in texts.items())


def _referred(trial: Any, metric: str, reference: Reference) -> float | None:
    """Return the value of the reference for a metric of a trial; None: it has none."""
    label = metric.removeprefix("same/").removesuffix("/accuracy")
    return reference.get((trial.row, trial.simulator, label))


def _cell(trials: pd.DataFrame, metric: str, reference: Reference | None = None) -> str:
    """Return the mean and its margin, and the reference in brackets."""
    figures = values(trials, metric)
    if figures.empty:
        return "cannot" if any(metric.startswith(tuple(cannot)) for cannot in trials.cannot) else ""
    mean, _, margin, _ = estimate(trials, metric)
    digits = {"": 0, "s": 2, "mm": 2, "N": 2}.get(UNITS.get(metric, "%"), 1)
    if metric in ("seconds_per_epoch", "parameters"):
        return f"{mean:.{digits}f}"
    several = len(figures) > 1 or margin > 0 or by_gesture(trials, metric) is not None
    referred = _referred(next(trials.itertuples()), metric, reference or {})
    brackets = "" if referred is None else f" ({100 * referred:.1f})"
    return f"{mean:.{digits}f}" + (f" ± {margin:.{digits}f}" if several else "") + brackets


def figure_text(compared: Estimate | None, unit: str) -> str:
    """Return a comparison with its margin and unit."""
    if compared is None:
        return "no paired runs"
    sign, digits = ("" if unit == "times" else "+"), (2 if unit in ("s", "times") else 1)
    margin = "" if math.isinf(compared.margin) else f" ± {compared.margin:.{digits}f}"
    return f"{compared.mean:{sign}.{digits}f}{margin} {unit}".rstrip()


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


def study_figure(study: Study, trials: pd.DataFrame) -> Figure:
    """Draw the first metric: lines over the numbers in the names if the study has an axis, else strips."""
    return _lines(study, trials) if study.axis else _strips(study, trials)


def _strips(study: Study, trials: pd.DataFrame) -> Figure:
    """Draw every trial of each variant and condition, the mean, and its 95 % interval.

    Conditions have a line each, or share the line of their variant if there are several of both.
    """
    metric, groups = study.metrics[0], trials.groupby(["variant", "condition"], sort=False)
    variants, conditions = list(trials.variant.unique()), list(trials.condition.unique())
    shared = len(variants) > 1 and len(conditions) > 1
    lines = variants if shared else [", ".join(filter(None, key)) for key, _ in groups]
    height = 0.1 * max(len(conditions), 3) if shared else 0.3
    figure = Figure(figsize=(8, 1.2 + height * len(lines)), layout="constrained")
    axis = figure.add_subplot(
        ylim=(len(lines) - 0.5, -0.5), xlabel=f"{_label(metric)}: each run, mean and 95 % interval"
    )
    for number, ((variant, condition), group) in enumerate(groups):
        if values(group, metric).empty:
            continue
        style = conditions.index(condition) if shared else 0
        apart = 0.8 * ((style + 0.5) / len(conditions) - 0.5) if shared else 0.0
        height = (variants.index(variant) if shared else number) + apart
        colour, marker = COLOURS[style % len(COLOURS)], MARKS[style % len(MARKS)]
        mean, _, margin, _ = estimate(group, metric)
        figures = (1 if metric in UNITS else 100) * group[metric].dropna()
        axis.plot(figures, [height] * len(figures), marker, color=colour, alpha=0.35, ms=4)
        label = condition or "no condition"
        known = label in axis.get_legend_handles_labels()[1]
        axis.errorbar(mean, height, xerr=margin, fmt=marker if shared else "|", label="_" * known + label,
                      color=colour if shared else "black", ms=4 if shared else 10, capsize=2)  # fmt: skip
    axis.set_yticks(range(len(lines)), lines, fontsize=8)
    axis.set_title(study.about, fontsize=9, wrap=True)
    if shared:
        figure.legend(loc="outside right center", fontsize=7)
        axis.grid(axis="y", alpha=0.2)
    return figure


def _lines(study: Study, trials: pd.DataFrame) -> Figure:
    """Draw the mean and its 95 % interval over the number at the end of a variant's or condition's name.

    Names of several words before the number, as "arm grid 9", get a panel for each beginning.
    """
    metric, single = study.metrics[0], trials.variant.nunique() == 1
    points: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
    for (variant, condition), group in trials.groupby(["variant", "condition"], sort=False):
        numbered = re.fullmatch(r"(.+) (\d+)", condition if single else variant)
        if numbered and len(values(group, metric)):
            panel, _, name = numbered[1].rpartition(" ")
            mean, _, margin, _ = estimate(group, metric)
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
    return f"{metric_heading(metric)}{f', {unit}' if unit else ''}"


# Figures 7, 8, 10 and 11 of the report, from the outcomes and the skin of the study ``table``.


def draw_report(trials: pd.DataFrame, skins: Mapping[str, Config], folder: Path) -> list[Path]:
    """Draw figures 7 and 8 of each simulator from the outcomes of all runs of each row, and 10 and 11.

    CSV files beside figures 7 and 8 have the numbers of all rows.

    Args:
        trials: of the study ``table``.
        skins: simulator -> a configuration.
        folder: of the figures.
    """
    paths, speeds = list[Path](), np.linspace(0.03, 0.20, 7)  # m/s
    shown = ("best_fresh", "features", "temporal_graph", "sequence_graph", "sequence_image")  # in figure 7
    simulated = "the figures of the report are of a simulated skin"
    devices = {name: build_device(config).simulated(simulated) for name, config in skins.items()}
    for name, group in trials[trials.outcomes.notna()].groupby("simulator", sort=False):
        eight, seven = folder / f"figure08_confusion_{name}", folder / f"figure07_speed_{name}"
        codes = {
            row or "vote": np.stack([np.frombuffer(outcomes, np.uint8) for outcomes in runs.outcomes])
            for row, runs in group.groupby("row", sort=False)
        }
        matrices = {row: _confusion(outcomes) for row, outcomes in codes.items()}
        drawn = devices[name].recording("test", complete=False).parameters["speed"].numpy()
        courses = {
            row: misclassified_fractions(drawn * devices[name].model_rate, each, speeds)
            for row, outcomes in codes.items()
            for each in [1 - decode(outcomes, "big/accuracy", TOUCH).mean(axis=0)]
        }
        some = {row: courses[row] for row in shown if row in courses} or courses
        paths += [
            save_figure(confusions(matrices, ("safe", "dangerous")), eight.with_suffix(".png")),
            write_csv(confusion_rows(codes), eight.with_suffix(".csv")),
            save_figure(misclassified(some, "big", speeds), seven.with_suffix(".png")),
            write_csv(_speed_rows(courses, speeds), seven.with_suffix(".csv")),
        ]
    name = "fem" if "fem" in devices else next(iter(devices))
    return [*paths, *draw_skin(devices[name], folder, name)]


def _speed_rows(courses: Mapping[str, tuple[np.ndarray, np.ndarray]], speeds: np.ndarray) -> pd.DataFrame:
    """Return a line per row and speed."""
    slow, fast = [0.0, *speeds[:-1]], [0.0, *speeds[1:]]
    lines = [
        [row, f"{slowest:.4g}", f"{fastest:.4g}", f"{fraction:.4f}", f"{error:.4f}"]
        for row, course in courses.items()
        for slowest, fastest, fraction, error in zip(slow, fast, *course, strict=True)
    ]
    return pd.DataFrame(lines, columns=["row", "slowest_m_per_s", "fastest_m_per_s", "wrong", "error"])


def _confusion(codes: np.ndarray) -> np.ndarray:
    """Return the confusion matrix of ``dangerous``, (2, 2), over runs and gestures."""
    right = decode(codes, "dangerous/accuracy", TOUCH) > 0.5
    true = ~np.isnan(decode(codes, "dangerous/alarm_recall", TOUCH))
    called = np.where(right, true, ~true)
    return np.array([[np.sum((true == row) & (called == column)) for column in (0, 1)] for row in (0, 1)])


def confusion_rows(codes: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return both kinds of errors of ``dangerous`` of each row, their difference, its error and margin.

    Args:
        codes: row -> outcomes of its runs, (N, B).
    """
    lines = []
    for row, outcomes in codes.items():
        wrong = decode(outcomes, "dangerous/accuracy", TOUCH) < 0.5
        dangerous = ~np.isnan(decode(outcomes[0], "dangerous/alarm_recall", TOUCH))
        kinds = wrong[:, ~dangerous], wrong[:, dangerous]
        safe, missed = (kind.mean(axis=0) for kind in kinds)
        first, second = (pd.Series(kind.mean(axis=1)) for kind in kinds)
        difference = compare_samples(first, second, gestures=(safe, missed))
        assert difference is not None
        lines.append([row, *(f"{number:.4f}" for number in (safe.mean(), missed.mean(), *difference[:3]))])
    columns = ["row", "safe_called_dangerous", "dangerous_called_safe", "difference", "error", "margin"]
    return pd.DataFrame(lines, columns=columns)


def draw_skin(device: Simulated, folder: Path, name: str = "fem") -> list[Path]:
    """Draw figures 10 and 11 from the gestures of a skin whose simulator has a name."""
    recording = device.recording("test", complete=False)
    touches, drawn = recording.touches, recording.parameters
    assert recording.force is not None
    labels = dict(zip(device.task.names, touches.known_labels.T.bool(), strict=True))
    movie = device.sampler.sample(64, np.random.default_rng(0))
    chosen = int((movie.labels[:, 1:].all(1) & (movie.labels[:, 0] == 0)).nonzero()[0])
    simulators = {"naive": Naive(device.body, device.sensors), name: device.model}
    readings = {key: model.respond(movie).readings[chosen] for key, model in simulators.items()}
    blurred = drawn["shape"] == device.sampler.shapes.names.index("blurred_disc")
    presses = (blurred & ~labels["dynamic"] & labels["press"]).nonzero()[:, 0]
    presses = presses[drawn["force"][presses].argsort()]
    four = presses[torch.linspace(0, len(presses) - 1, 4).round().long()]
    courses = traces(readings, device.model_rate)
    forces = force_and_reading(recording.force[four], touches.readings[four], device.model_rate)
    return [
        save_figure(courses, folder / f"figure10_naive_{name}.png"),
        save_figure(forces, folder / "figure11_force_reading.png"),
    ]
