"""A study's tables, its CSV and its figure."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from experiments.studies.comparison import RATIOS, Paired
from experiments.studies.outcomes import (
    UNITS,
    Difference,
    StatementResult,
    conclusions,
    differences,
    group_trials,
    heading,
    mean_and_margin,
    values,
)
from experiments.studies.study import Study
from experiments.studies.study_figure import study_figure
from experiments.studies.tables import Page, csv_text, print_table, read_csv
from experiments.studies.tables import publish_page as write_page
from experiments.studies.trials import Trial
from skin.files import write


def variants_table(trials: Sequence[Trial], metrics: Sequence[str]) -> list[list[str]]:
    """Return a line per variant: mean ± margin over seeds, devices and gestures, in per cent.

    Where there are conditions, each is a column of the first metric; of a single variant, each is a line.
    """
    found = group_trials(trials)
    variants = list(dict.fromkeys(variant for variant, _ in found))
    conditions = list(dict.fromkeys(condition for _, condition in found if condition))
    if conditions and len(variants) == 1:
        lines = [[name, *(_cell(found[variants[0], name], one) for one in metrics)] for name in conditions]
        return [[variants[0], *map(heading, metrics)], *lines]
    if conditions:
        head = ["variant", *conditions]
        cells = {key: _cell(each, metrics[0]) for key, each in found.items()}
        return [head, *([one, *(cells.get((one, name), "") for name in conditions)] for one in variants)]
    head = ["variant", *map(heading, metrics)]
    body = []
    for (variant, _), each in found.items():
        failed = sum(not one.run for one in each)
        shown = [_cell(each, metric) for metric in metrics] if failed < len(each) else ["failed"]
        body.append([variant + (f" ({failed} failed)" if failed else ""), *shown])
    return [head, *([*line, *[""] * (len(head) - len(line))] for line in body)]


def differences_table(found: Sequence[Difference], metric: str) -> list[list[str]]:
    """Return a line per difference, ± margin; none without."""
    head = ["variant", "condition", "difference", "n", "verdict"]
    unit = UNITS.get(metric, "points")
    return [
        head,
        *(
            [
                one.variant,
                one.condition,
                _figure(one.found, unit),
                str(one.found.seeds if one.found else 0),
                one.verdict,
            ]
            for one in found
        ),
    ]


def statements_table(outcomes: Sequence[StatementResult]) -> list[list[str]]:
    """Return a line per statement."""
    body = [
        [one.statement.section, one.statement.says, comparison_text(one), one.verdict] for one in outcomes
    ]
    return [["section", "statement", "measured", "verdict"], *body]


def comparison_text(outcome: StatementResult) -> str:
    """Return every comparison of a statement: the mean over paired seeds ± margin."""
    said, several = outcome.statement, len(outcome.compared) > 1
    unit = "times" if said.claim in RATIOS else UNITS.get(said.metric, "points")
    figures: Mapping[str, str] = {name: _figure(found, unit) for name, found in outcome.compared.items()}
    return "; ".join(text + f" ({name})" if several else text for name, text in figures.items())


def publish_study(
    study: Study, title: str, trials: Sequence[Trial], path: Path, console: Console | None = None
) -> None:
    """Write ``path`` with the endings .md, .csv and .png, each whole, and print the tables.

    Args:
        study: whose trials they are.
        title: of the page.
        trials: all of them.
        path: without an ending.
        console: where to print; None takes standard output.
    """
    console = console or Console()
    changed = differences(study, trials)
    several = len({one.variant.name for one in trials}) > 1
    further = study.metrics[1:] if several and any(one.condition for one in trials) else []
    tables = {
        "Variants": variants_table(trials, study.metrics),
        # Where conditions take the columns, each further metric has a table.
        **({heading(one): variants_table(trials, [one]) for one in further}),
        f"Differences in {heading(study.metrics[0])}": differences_table(changed, study.metrics[0]),
        "Statements": statements_table(conclusions(study.statements, trials)),
    }
    told = {name: each for name, each in tables.items() if len(each) > 1}
    drawn = study_figure(study, trials) if any(one.run for one in trials) else None
    print(title)
    for name, each in told.items():
        if name not in map(heading, further):
            print_table(each, name, console, wrapped=("statement", "measured"))
    print(*write_page(Page("", told, _csv(study, trials), drawn), title, path), sep="\n")


def publish_files(study: Study, trials: Sequence[Trial], path: Path) -> None:
    """Write the CSV files that a measure wrote for several runs as one, each line behind its trial.

    Args:
        study: whose trials they are.
        trials: all of them.
        path: of the file.
    """
    head = [*_names(study), "run"]
    found = [(one, file) for one in trials for file in one.files if file.suffix == ".csv"]
    tables = [(_trial(one, head), read_csv(file)) for one, file in found]
    if len(tables) > 1:
        lines = [[*before, *line] for before, (_, *body) in tables for line in body]
        print(write(csv_text([[*head, *tables[0][1][0]], *lines]), path))


def _csv(study: Study, trials: Sequence[Trial]) -> list[Sequence[object]]:
    """Return a line per finished trial."""
    head = [*_names(study), "run"]
    body = [
        [*_trial(one, head), *(one.metrics.get(metric, "") for metric in study.metrics)]
        for one in trials
        if one.run
    ]
    return [[*head, *study.metrics], *body]


def _names(study: Study) -> list[str]:
    """Return what tells the trials of a study apart."""
    return ["variant", "seed", *(["condition", "device"] if study.conditions else [])]


def _trial(trial: Trial, names: Sequence[str]) -> list[str]:
    return [trial.variant.name if name == "variant" else getattr(trial, name) for name in names]


def _cell(trials: Sequence[Trial], metric: str) -> str:
    """Return the mean and its margin."""
    figures = values(trials, metric)
    if not figures:
        return "cannot" if any(one.cannot for one in trials) else ""
    mean, _, margin = mean_and_margin(trials, metric)
    if metric in ("seconds_per_epoch", "parameters", "self_share"):
        return f"{mean:.{0 if metric == 'parameters' else 2}f}"
    several = len(figures) > 1 or margin > 0
    return f"{mean:.1f}" + (f" ± {margin:.1f}" if several else "")


def _figure(found: Paired | None, unit: str) -> str:
    if found is None:
        return "no paired runs"
    sign, digits = ("" if unit == "times" else "+"), (2 if unit in ("s", "times") else 1)
    margin = "" if math.isinf(found.margin) else f" ± {found.margin:.{digits}f}"
    return f"{found.mean:{sign}.{digits}f}{margin} {unit}".rstrip()
