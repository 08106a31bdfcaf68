"""The page of a study: its tables, with verdicts, its CSV and its figure; and the figures of the report."""

import csv
import io
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console

from experiments.studies.comparison import (
    RATIOS,
    UNITS,
    Difference,
    Paired,
    StatementResult,
    by_gesture,
    conclusions,
    differences,
    group_trials,
    mean_and_margin,
    metric_heading,
    paired,
    values,
)
from experiments.studies.pages import Page, Panel, csv_text, draw_panels, print_table, publish_page
from experiments.studies.study import Study
from experiments.studies.trials import TrialResult, row_and_simulator
from skin.core.files import candidates, write
from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.evaluation.metrics import decode
from skin.mechanics.simulator.naive import Naive
from skin.plot.figures import (
    COLOURS,
    confusions,
    force_and_reading,
    misclassified,
    misclassified_shares,
    save_figure,
    traces,
)
from skin.runs.build import build_device
from skin.touch.labels import TOUCH

Reference = Mapping[tuple[str, str, str], float]
"""Row, simulator and label -> value."""


def publish_study(
    study: Study, title: str, trials: Sequence[TrialResult], path: Path, console: Console | None = None
) -> list[Path]:
    """Write ``path`` with the endings .md, .csv and .png, each whole, print the tables, and return the paths.

    Args:
        study: whose trials they are.
        title: of the page.
        trials: all of them.
        path: without an ending.
        console: where to print; None takes standard output.
    """
    console = console or Console()
    several = len({trial.variant.name for trial in trials}) > 1
    further = study.metrics[1:] if several and any(trial.condition for trial in trials) else []
    reference = read_reference(study.reference)
    tables = {
        "Variants": variants_table(trials, study.metrics, reference),
        # Where conditions take the columns, each further metric has a table.
        **({metric_heading(metric): variants_table(trials, [metric]) for metric in further}),
        f"Differences in {metric_heading(study.metrics[0])}": differences_table(
            differences(study, trials), study.metrics[0]
        ),
        "Statements": statements_table(conclusions(study.statements, trials)),
    }
    tables = {name: table for name, table in tables.items() if len(table) > 1}
    figure = study_figure(study, trials) if any(trial.run for trial in trials) else None
    print(title)
    for name, table in tables.items():
        if name not in map(metric_heading, further):
            print_table(table, name, console, wrapped=("statement", "measured"))
    paths = publish_page(Page("", tables, _trials_table(study, trials, reference), figure), title, path)
    print(*paths, sep="\n")
    return paths


def publish_files(study: Study, trials: Sequence[TrialResult], path: Path) -> list[Path]:
    """Write the CSV files that a measure made for several runs as one, each line behind its trial.

    Args:
        study: whose trials they are.
        trials: all of them.
        path: of the file.
    """
    head = [*_names(study), "run"]
    tables = [
        (_identity(trial, head), [*csv.reader(io.StringIO(content.decode()))])
        for trial in trials
        for name, content in trial.files.items()
        if name.endswith(".csv")
    ]
    if len(tables) < 2:
        return []
    lines = [[*before, *line] for before, (_, *body) in tables for line in body]
    write(csv_text([[*head, *tables[0][1][0]], *lines]), path)
    print(path)
    return [path]


def read_reference(path: str | None) -> Reference:
    """Return the values of a CSV file: (row, simulator, label) -> value; none without a file."""
    if path is None:
        return {}
    files = [file for file in candidates(path) if file.is_file()]
    if not files:
        raise InputError(f"there is no file study.reference={path}: give another, or null")
    with files[0].open(newline="", encoding="utf-8") as file:
        return {
            (line["row"], line["simulator"], line["label"]): float(line["value"])
            for line in csv.DictReader(file)
        }


def variants_table(
    trials: Sequence[TrialResult], metrics: Sequence[str], reference: Reference | None = None
) -> list[list[str]]:
    """Return a line per variant: mean ± margin over seeds, devices and gestures, in per cent.

    Where there are conditions, each is a column of the first metric; of a single variant, each is a line.
    A value of the reference stands in brackets behind ours.
    """
    groups = group_trials(trials)
    variants = list(dict.fromkeys(variant for variant, _ in groups))
    conditions = list(dict.fromkeys(condition for _, condition in groups if condition))
    if conditions and len(variants) == 1:
        lines = [
            [name, *(_cell(groups[variants[0], name], metric) for metric in metrics)] for name in conditions
        ]
        return [[variants[0], *map(metric_heading, metrics)], *lines]
    if conditions:
        figures = {key: _cell(group, metrics[0]) for key, group in groups.items()}
        lines = [
            [variant, *(figures.get((variant, name), "") for name in conditions)] for variant in variants
        ]
        return [["variant", *conditions], *lines]
    head = ["variant", *map(metric_heading, metrics)]
    body = []
    for (variant, _), group in groups.items():
        failed = sum(not trial.run for trial in group)
        cells = [_cell(group, metric, reference) for metric in metrics] if failed < len(group) else ["failed"]
        body.append([variant + (f" ({failed} failed)" if failed else ""), *cells])
    return [head, *([*line, *[""] * (len(head) - len(line))] for line in body)]


def differences_table(changes: Sequence[Difference], metric: str) -> list[list[str]]:
    """Return a line per difference, ± margin; none without."""
    unit = UNITS.get(metric, "points")
    return [
        ["variant", "condition", "difference", "n", "verdict"],
        *(
            [
                change.variant,
                change.condition,
                _figure(change.compared, unit),
                str(change.compared.seeds if change.compared else 0),
                change.verdict,
            ]
            for change in changes
        ),
    ]


def statements_table(results: Sequence[StatementResult]) -> list[list[str]]:
    """Return a line per statement."""
    body = [
        [result.statement.section, result.statement.says, comparison_text(result), result.verdict]
        for result in results
    ]
    return [["section", "statement", "measured", "verdict"], *body]


def comparison_text(result: StatementResult) -> str:
    """Return every comparison of a statement: the mean over paired seeds ± margin."""
    statement, several = result.statement, len(result.compared) > 1
    unit = "times" if statement.claim in RATIOS else UNITS.get(statement.metric, "points")
    texts = {name: _figure(comparison, unit) for name, comparison in result.compared.items()}
    return "; ".join(text + f" ({name})" if several else text for name, text in texts.items())


def _trials_table(
    study: Study, trials: Sequence[TrialResult], reference: Reference
) -> list[Sequence[object]]:
    """Return a line per finished trial."""
    head = [*_names(study), "run"]
    return [
        [*head, *study.metrics, *(["reference"] if reference else [])],
        *(
            [
                *_identity(trial, head),
                *(trial.metrics.get(metric, "") for metric in study.metrics),
                *([_referred(trial, study.metrics[0], reference) or ""] if reference else []),
            ]
            for trial in trials
            if trial.run
        ),
    ]


def _names(study: Study) -> list[str]:
    """Return what tells the trials of a study apart."""
    return ["variant", "seed", *(["condition", "device"] if study.conditions else [])]


def _identity(trial: TrialResult, names: Sequence[str]) -> list[str]:
    return [trial.variant.name if name == "variant" else getattr(trial, name) for name in names]


def _referred(trial: TrialResult, metric: str, reference: Reference) -> float | None:
    """Return the value of the reference for a metric of a trial; None: it has none."""
    label = metric.removeprefix("same/").removesuffix("/accuracy")
    return reference.get((*row_and_simulator(trial.variant), label))


def _cell(trials: Sequence[TrialResult], metric: str, reference: Reference | None = None) -> str:
    """Return the mean and its margin, and the reference in brackets."""
    figures = values(trials, metric)
    if not figures:
        return "cannot" if any(metric.startswith(tuple(trial.cannot)) for trial in trials) else ""
    mean, _, margin = mean_and_margin(trials, metric)
    if metric in ("seconds_per_epoch", "parameters"):
        return f"{mean:.{0 if metric == 'parameters' else 2}f}"
    several = len(figures) > 1 or margin > 0 or by_gesture(trials, metric) is not None
    referred = _referred(trials[0], metric, reference or {})
    brackets = "" if referred is None else f" ({100 * referred:.1f})"
    return f"{mean:.1f}" + (f" ± {margin:.1f}" if several else "") + brackets


def _figure(compared: Paired | None, unit: str) -> str:
    if compared is None:
        return "no paired runs"
    sign, digits = ("" if unit == "times" else "+"), (2 if unit in ("s", "times") else 1)
    margin = "" if math.isinf(compared.margin) else f" ± {compared.margin:.{digits}f}"
    return f"{compared.mean:{sign}.{digits}f}{margin} {unit}".rstrip()


_NUMBERED = re.compile(r"(.+) (\d+)")
_MARKERS = "osD^v<>pP*"


def study_figure(study: Study, trials: Sequence[TrialResult]) -> Figure:
    """Draw the first metric: lines over the numbers in the names if the study has an axis, else strips."""
    return _lines(study, trials) if study.axis else _strips(study, trials)


def _strips(study: Study, trials: Sequence[TrialResult]) -> Figure:
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


def _lines(study: Study, trials: Sequence[TrialResult]) -> Figure:
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
    return f"{metric_heading(metric)}{f', {unit}' if unit else ''}"


_SHOWN = ("best_fresh", "features", "temporal_graph", "sequence_graph", "sequence_image")
_SIMULATED = "the figures of the report are of a simulated skin"
_SPEEDS = np.linspace(0.03, 0.20, 7)  # m/s


def draw_report(trials: Sequence[TrialResult], folder: Path) -> list[Path]:
    """Draw figures 7 and 8 of each simulator from the outcomes of all runs of each row, and 10 and 11.

    Figure 7 shows the rows of ``_SHOWN``. CSV files beside the figures have the numbers of all rows.

    Args:
        trials: of the study ``table``.
        folder: of the figures.
    """
    paths, skins = list[Path](), dict[str, AbstractSimulated]()
    codes: dict[str, dict[str, list[np.ndarray]]] = {}
    for trial in trials:
        row, simulator = row_and_simulator(trial.variant)
        if trial.outcomes is not None:
            rows = codes.setdefault(simulator, {})
            rows.setdefault(row or "vote", []).append(trial.outcomes)
        for config in trial.variant.configs.values():
            if simulator not in skins:
                skins[simulator] = build_device(config).simulated(_SIMULATED)
    for simulator, outcomes in codes.items():
        skin = skins[simulator]
        speeds = skin.recording("test", complete=False).parameters["speed"].numpy() * skin.model_rate
        paths += _draw_runs(
            {row: np.array(runs) for row, runs in outcomes.items()}, speeds, simulator, folder
        )
    name = "fem" if "fem" in skins else next(iter(skins))
    return [*paths, *draw_skin(skins[name], folder, name)]


def _draw_runs(
    codes: Mapping[str, np.ndarray], speeds: np.ndarray, simulator: str, folder: Path
) -> list[Path]:
    """Draw figures 7 and 8 from the outcomes (N, B) of the runs of each row."""
    wrong = {row: 1 - decode(outcomes, "big/accuracy", TOUCH).mean(axis=0) for row, outcomes in codes.items()}
    courses = {row: misclassified_shares(speeds, shares, _SPEEDS) for row, shares in wrong.items()}
    some = {row: courses[row] for row in _SHOWN if row in courses} or courses
    matrices = {row: _confusion(outcomes) for row, outcomes in codes.items()}
    eight, seven = folder / f"figure08_confusion_{simulator}", folder / f"figure07_speed_{simulator}"
    return [
        save_figure(confusions(matrices, ("safe", "dangerous")), eight.with_suffix(".png")),
        write(csv_text(confusion_rows(codes)), eight.with_suffix(".csv")),
        save_figure(misclassified(some, "big", _SPEEDS), seven.with_suffix(".png")),
        write(csv_text(_courses(courses)), seven.with_suffix(".csv")),
    ]


def _confusion(codes: np.ndarray) -> np.ndarray:
    """Return the confusion matrix of ``dangerous``, (2, 2), over runs and gestures."""
    right = decode(codes, "dangerous/accuracy", TOUCH) > 0.5
    true = ~np.isnan(decode(codes, "dangerous/alarm_recall", TOUCH))
    called = np.where(right, true, ~true)
    return np.array([[np.sum((true == row) & (called == column)) for column in (0, 1)] for row in (0, 1)])


def confusion_rows(codes: Mapping[str, np.ndarray]) -> list[list[str]]:
    """Return both kinds of errors of ``dangerous`` of each row, their difference, its error and margin.

    Args:
        codes: row -> outcomes of its runs, (N, B).
    """
    lines = [["row", "safe_called_dangerous", "dangerous_called_safe", "difference", "error", "margin"]]
    for row, outcomes in codes.items():
        wrong = decode(outcomes, "dangerous/accuracy", TOUCH) < 0.5
        dangerous = ~np.isnan(decode(outcomes[0], "dangerous/alarm_recall", TOUCH))
        kinds = wrong[:, ~dangerous], wrong[:, dangerous]
        safe, missed = ({str(run): float(share.mean()) for run, share in enumerate(kind)} for kind in kinds)
        over = kinds[0].mean(axis=0), kinds[1].mean(axis=0)
        difference = paired(safe, missed, gestures=over)
        assert difference is not None
        numbers = (over[0].mean(), over[1].mean(), difference.mean, difference.error, difference.margin)
        lines.append([row, *(f"{number:.4f}" for number in numbers)])
    return lines


def _courses(courses: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[list[str]]:
    """Return a line per row and speed."""
    ends = [(0.0, 0.0), *pairwise(_SPEEDS)]
    return [["row", "slowest_m_per_s", "fastest_m_per_s", "wrong", "error"]] + [
        [row, f"{low:.4g}", f"{high:.4g}", f"{share:.4f}", f"{error:.4f}"]
        for row, course in courses.items()
        for (low, high), share, error in zip(ends, *course, strict=True)
    ]


def draw_skin(device: AbstractSimulated, folder: Path, name: str = "fem") -> list[Path]:
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
