"""The page of a study: its tables, with verdicts, its CSV and its figure."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from experiments.studies.comparison import RATIOS, Paired
from experiments.studies.figures import study_figure
from experiments.studies.outcomes import (
    UNITS,
    Difference,
    StatementResult,
    by_gesture,
    conclusions,
    differences,
    group_trials,
    heading,
    mean_and_margin,
    values,
)
from experiments.studies.runs import row_and_simulator
from experiments.studies.study import Study
from experiments.studies.tables import Page, csv_text, print_table, publish_page
from experiments.studies.trials import Trial
from skin.core.files import candidates, write
from skin.errors import InputError

Reference = Mapping[tuple[str, str, str], float]
"""Row, simulator and label -> value."""


def publish_study(
    study: Study, title: str, trials: Sequence[Trial], path: Path, console: Console | None = None
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
        **({heading(metric): variants_table(trials, [metric]) for metric in further}),
        f"Differences in {heading(study.metrics[0])}": differences_table(
            differences(study, trials), study.metrics[0]
        ),
        "Statements": statements_table(conclusions(study.statements, trials)),
    }
    tables = {name: table for name, table in tables.items() if len(table) > 1}
    figure = study_figure(study, trials) if any(trial.run for trial in trials) else None
    print(title)
    for name, table in tables.items():
        if name not in map(heading, further):
            print_table(table, name, console, wrapped=("statement", "measured"))
    paths = publish_page(Page("", tables, _trials_table(study, trials, reference), figure), title, path)
    print(*paths, sep="\n")
    return paths


def publish_files(study: Study, trials: Sequence[Trial], path: Path) -> list[Path]:
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
        lines = csv.DictReader(file)
        return {(line["row"], line["simulator"], line["label"]): float(line["value"]) for line in lines}


def variants_table(
    trials: Sequence[Trial], metrics: Sequence[str], reference: Reference | None = None
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
        return [[variants[0], *map(heading, metrics)], *lines]
    if conditions:
        figures = {key: _cell(group, metrics[0]) for key, group in groups.items()}
        lines = [
            [variant, *(figures.get((variant, name), "") for name in conditions)] for variant in variants
        ]
        return [["variant", *conditions], *lines]
    head = ["variant", *map(heading, metrics)]
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
                _figure(change.found, unit),
                str(change.found.seeds if change.found else 0),
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


def _trials_table(study: Study, trials: Sequence[Trial], reference: Reference) -> list[Sequence[object]]:
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


def _identity(trial: Trial, names: Sequence[str]) -> list[str]:
    return [trial.variant.name if name == "variant" else getattr(trial, name) for name in names]


def _referred(trial: Trial, metric: str, reference: Reference) -> float | None:
    """Return the value of the reference for a metric of a trial; None: it has none."""
    label = metric.removeprefix("same/").removesuffix("/accuracy")
    return reference.get((*row_and_simulator(trial.variant), label))


def _cell(trials: Sequence[Trial], metric: str, reference: Reference | None = None) -> str:
    """Return the mean and its margin, and the reference in brackets."""
    figures = values(trials, metric)
    if not figures:
        return "cannot" if any(metric.startswith(tuple(trial.cannot)) for trial in trials) else ""
    mean, _, margin = mean_and_margin(trials, metric)
    if metric in ("seconds_per_epoch", "parameters", "self_share"):
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
