"""The page of a study: its tables, with verdicts, its CSV and its figure."""

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.studies.comparison import (
    UNITS,
    Comparison,
    Estimate,
    by_gesture,
    conclude,
    differences,
    estimate,
    values,
)
from experiments.studies.pages import Page, Panel, draw_panels, publish_page, write_csv
from experiments.studies.study import Study
from skin.core.files import candidates
from skin.errors import InputError
from skin.plot.figures import COLOURS

Reference = Mapping[tuple[str, str, str], float]
"""Row, simulator and label -> value."""

_HEADINGS = {
    "same/dangerous/alarm_recall": "recall",
    "same/dangerous/false_alarm_rate": "false alarms",
    "train_accuracy": "training",
    "seconds_per_epoch": "s/epoch",
    "same/direction/degrees": "degrees",
    "same/direction/accuracy": "within 45°",
    "device_shift/dangerous/alarm_recall": "its recall",
    "device_shift/dangerous/false_alarm_rate": "its false alarms",
}


def publish_study(study: Study, title: str, trials: pd.DataFrame, path: Path) -> list[Path]:
    """Write ``path`` with the endings .md, .csv and .png, each whole, print the tables, and return the paths.

    Args:
        study: whose trials they are.
        title: of the page.
        trials: all of them.
        path: without an ending.
    """
    several = trials.variant.nunique() > 1 and trials.condition.any()
    reference = read_reference(study.reference)
    conclusions = [conclude(statement, trials) for statement in study.statements]
    metric = study.metrics[0]
    tables = {
        "Variants": variants_table(trials, study.metrics, reference),
        f"Differences in {metric_heading(metric)}": differences_table(differences(study, trials), metric),
        "Statements": statements_table(conclusions),
    }
    print(title)
    for name, table in tables.items():
        if len(table):
            print(name, table.to_string(index=False, justify="left"), "", sep="\n")
    # Where conditions take the columns, each further metric has a table.
    further = {
        metric_heading(name): variants_table(trials, [name])
        for name in (study.metrics[1:] if several else ())
    }
    tables = {"Variants": tables.pop("Variants"), **further, **tables}
    finished = trials[trials.run != ""]
    figure = study_figure(study, trials) if len(finished) else None
    data = finished.reindex(columns=[*_identity(study), *study.metrics])
    if reference:
        data["reference"] = [_referred(row, metric, reference) for row in finished.itertuples()]
    shown = {name: table for name, table in tables.items() if len(table)}
    paths = publish_page(Page("", shown, data, figure), title, path)
    print(*paths, sep="\n")
    return paths


def publish_tables(study: Study, tables: Sequence[tuple[Mapping[str, Any], Page]], path: Path) -> list[Path]:
    """Write and print the tables of a measure: of several runs a CSV file, each line behind its trial.

    Args:
        study: whose tables they are.
        tables: row of the trials, and page.
        path: without an ending.
    """
    pages = [page for _, page in tables]
    if len(pages) < (2 if study.has_runs else 1):
        return []
    if study.has_runs:
        keys = [pd.DataFrame([{name: row[name] for name in _identity(study)}]) for row, _ in tables]
        data = [key.merge(page.data, how="cross") for key, page in zip(keys, pages, strict=True)]
        paths = [write_csv(pd.concat(data), path.with_name(f"{path.name}.csv"))]
    else:
        rows = pd.concat([page.data for page in pages])
        about = "\n".join(page.about for page in pages if page.about)
        figure = next((page.figure for page in pages if page.figure), None)
        shown = {} if len(rows) < 2 else {"Measured": rows.astype(str)}
        paths = publish_page(Page(about, shown, rows, figure), f"{study.name}: {study.about}", path)
        print(about, end="\n" if about else "")
    print(*paths, sep="\n")
    return paths


def _identity(study: Study) -> list[str]:
    """Return the columns that tell the trials of a study apart."""
    return ["variant", "seed", *(["condition", "device"] if study.conditions else []), "run"]


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
    plain = metric.removeprefix("same/").removesuffix("/accuracy").replace("/overall", "")
    return _HEADINGS.get(metric, plain.replace("_", " "))


def variants_table(
    trials: pd.DataFrame, metrics: Sequence[str], reference: Reference | None = None
) -> pd.DataFrame:
    """Return a line per variant with the mean and margin of each metric; or of conditions.

    Where one variant has conditions, each is a line. Where several do, each is a column of the first metric.
    A value of the reference stands in brackets behind ours.
    """
    groups = dict([*trials.groupby(["variant", "condition"], sort=False)])
    variants = list(trials.variant.unique())
    conditions = [name for name in trials.condition.unique() if name]
    headings = [*map(metric_heading, metrics)]
    if conditions and len(variants) == 1:
        lines = [
            [name, *(_cell(groups[variants[0], name], metric) for metric in metrics)] for name in conditions
        ]
        return pd.DataFrame(lines, columns=[variants[0], *headings])
    if conditions:
        cells = {key: _cell(group, metrics[0]) for key, group in groups.items()}
        lines = [[each, *(cells.get((each, name), "") for name in conditions)] for each in variants]
        return pd.DataFrame(lines, columns=["variant", *conditions])
    lines = []
    for (variant, _), group in groups.items():
        failed = int((group.run == "").sum())
        cells_of = [_cell(group, metric, reference) for metric in metrics]
        if failed == len(group):
            cells_of = ["failed", *[""] * (len(metrics) - 1)]
        lines.append([variant + (f" ({failed} failed)" if failed else ""), *cells_of])
    return pd.DataFrame(lines, columns=["variant", *headings])


def differences_table(changes: Sequence[Comparison], metric: str) -> pd.DataFrame:
    """Return a line per difference, ± margin; none without."""
    lines = []
    for change in changes:
        (compared,) = change.compared.values()
        count = str(compared.seeds if compared else 0)
        text = _figure(compared, UNITS.get(metric, "points"))
        lines.append([change.variant, change.condition, text, count, change.verdict])
    return pd.DataFrame(lines, columns=["variant", "condition", "difference", "n", "verdict"])


def statements_table(conclusions: Sequence[Comparison]) -> pd.DataFrame:
    """Return a line per statement."""
    lines = [
        [result.statement.section, result.statement.says, comparison_text(result), result.verdict]
        for result in conclusions
        if result.statement
    ]
    return pd.DataFrame(lines, columns=["section", "statement", "measured", "verdict"])


def comparison_text(result: Comparison) -> str:
    """Return every comparison of a statement: the mean over paired seeds ± margin."""
    statement, several = result.statement, len(result.compared) > 1
    assert statement is not None
    unit = "times" if statement.ratio else UNITS.get(statement.metric, "points")
    texts = {name: _figure(comparison, unit) for name, comparison in result.compared.items()}
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


def _figure(compared: Estimate | None, unit: str) -> str:
    if compared is None:
        return "no paired runs"
    sign, digits = ("" if unit == "times" else "+"), (2 if unit in ("s", "times") else 1)
    margin = "" if math.isinf(compared.margin) else f" ± {compared.margin:.{digits}f}"
    return f"{compared.mean:{sign}.{digits}f}{margin} {unit}".rstrip()


_NUMBERED = re.compile(r"(.+) (\d+)")
_MARKERS = "osD^v<>pP*"


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
    axis = figure.subplots()
    scale, labelled = 1 if metric in UNITS else 100, set[str]()
    for number, ((variant, condition), group) in enumerate(groups):
        figures = scale * group[metric].dropna() if metric in group else []
        if not len(figures):
            continue
        style = conditions.index(condition) if shared else 0
        apart = 0.8 * ((style + 0.5) / len(conditions) - 0.5) if shared else 0.0
        height = (variants.index(variant) if shared else number) + apart
        colour, marker = COLOURS[style % len(COLOURS)], _MARKERS[style % len(_MARKERS)]
        mean, _, margin, _ = estimate(group, metric)
        axis.plot(figures, [height] * len(figures), marker, color=colour, alpha=0.35, ms=4)
        ends = colour if shared else "black"
        label = condition or "no condition" if shared and condition not in labelled else None
        labelled.add(condition)
        axis.errorbar(mean, height, xerr=margin, fmt=marker if shared else "|", color=ends, label=label,
                      ms=4 if shared else 10, capsize=2)  # fmt: skip
    axis.set_yticks(range(len(lines)), lines, fontsize=8)
    axis.set_ylim(len(lines) - 0.5, -0.5)
    axis.set_xlabel(f"{_label(metric)}: each run, mean and 95 % interval")
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
        numbered = _NUMBERED.fullmatch(condition if single else variant)
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
