"""The results table: our numbers from MLflow beside the report's."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
from mlflow.entities import Run
from omegaconf import DictConfig
from rich.console import Console

from experiments.studies import tables
from experiments.studies.comparison import estimate
from experiments.studies.runs import load_outcomes, newest_finished
from experiments.studies.tables import percent
from skin.evaluation.metrics import decode
from skin.labels import TOUCH
from skin.tracking import Store

ACCURACIES = ("overall", "big", "dynamic", "press", "dangerous")
ALARM = {"dangerous_recall": "dangerous/alarm_recall", "false_alarms": "dangerous/false_alarm_rate"}
"""Label in the table -> metric; at the threshold that is stored with each run."""
LABELS = (*ACCURACIES, *ALARM)
COLUMNS = (
    "row",
    "simulator",
    "label",
    "ours",
    "ours_error",
    "ours_margin",
    "report",
    "device_shift",
    "unseen_layout",
    "seconds_per_epoch",
    "parameters",
    "failed",
    "budget",
)


@dataclass(frozen=True)
class Cell:
    """The runs of one row on one simulator, one per seed.

    Attributes:
        row: name of the experiment.
        simulator: on whose data.
        runs: those that finished.
        missing: how many did not: failed, killed, or never started.
        outcomes: of the test gestures of each run (:func:`skin.evaluation.metrics.encode`), where known.
    """

    row: str
    simulator: str
    runs: tuple[Run, ...]
    missing: int
    outcomes: tuple[np.ndarray, ...] = ()

    def values(self, metric: str) -> list[float]:
        """Return a metric of every run that has it."""
        found = (run.data.metrics.get(metric) for run in self.runs)
        return [value for value in found if value is not None]

    def uncertainty(self, metric: str) -> tuple[str, str]:
        """Return error and margin of a metric of ``same`` over seeds and gestures; empty if unknown."""
        by_seed = {str(number): value for number, value in enumerate(self.values(f"same/{metric}"))}
        known = decode(np.stack(self.outcomes), metric, TOUCH) if self.outcomes else None
        if not by_seed or (known is None and len(by_seed) < 2):
            return "", ""
        _, error, margin = estimate(by_seed, {}, None if known is None else known.mean(axis=0))
        return f"{error:.6f}", f"{margin:.6f}"

    def shift(self, column: str, label: str) -> str:
        """Return the mean over seeds on other devices or layouts; ``cannot`` where the row takes none."""
        if any(f"cannot_{column}" in run.data.tags for run in self.runs):
            return "cannot"
        return _number(self.values(_metric(column, label)))


def collect(store: Store, jobs: Iterable[tuple[str, str, DictConfig]]) -> list[Cell]:
    """Return the cells of jobs (row, simulator, configuration), by the fingerprint of each."""
    groups: dict[tuple[str, str], list[Run | None]] = {}
    for row, simulator, config in jobs:
        groups.setdefault((row, simulator), []).append(newest_finished(store, config))
    cells = []
    for key, runs in groups.items():
        finished = tuple(run for run in runs if run is not None)
        outcomes = [load_outcomes(store, run) for run in finished]
        known = tuple(one for one in outcomes if one is not None)
        cells.append(Cell(*key, finished, runs.count(None), known))
    return cells


def report_values(path: Path) -> dict[tuple[str, str, str], float]:
    """Return the report's numbers, (row, simulator, label) -> value, from ``data/report_table.csv``."""
    with path.open(newline="") as file:
        return {
            (line["row"], line["simulator"], line["label"]): float(line["value"])
            for line in csv.DictReader(file)
        }


def result_rows(
    cells: Sequence[Cell], report: dict[tuple[str, str, str], float], budget: str = "full"
) -> list[dict[str, str]]:
    """Return one line per row, simulator and label, with the columns of ``COLUMNS``.

    ``ours`` is the mean over seeds of the accuracy on the test gestures, or of what the alarm reaches there
    with the threshold stored with each run; ``failed`` where no run finished, empty where it is
    undefined. ``ours_error`` is its standard error, ``ours_margin`` half of its 95 % interval. The column
    ``failed`` counts the seeds that are missing, ``budget`` is theirs.
    """
    lines = []
    for cell in cells:
        for label in LABELS:
            same = cell.values(_metric("same", label))
            error, margin = cell.uncertainty(ALARM.get(label, f"{label}/accuracy"))
            values = {
                "ours": _number(same) if cell.runs else "failed",
                "ours_error": error,
                "ours_margin": margin,
                "report": _reported(report.get((cell.row, cell.simulator, label))),
                "device_shift": cell.shift("device_shift", label),
                "unseen_layout": cell.shift("unseen_layout", label),
                "seconds_per_epoch": _number(cell.values("seconds_per_epoch"), 2),
                "parameters": _number(cell.values("parameters"), 0),
                "failed": str(cell.missing),
                "budget": budget,
            }
            lines.append({"row": cell.row, "simulator": cell.simulator, "label": label, **values})
    return lines


def display_rows(lines: Sequence[dict[str, str]]) -> list[list[str]]:
    """Return the table for a person, its head first: one line per row and simulator, accuracies in per cent.

    Where the report has a number, it stands behind ours.
    """
    head = ["row", "simulator", "overall", "big", "dynamic", "press", "dangerous", "recall", "false alarms"]
    shifts = ["device shift", "its recall", "its false alarms", "unseen layout"]
    table = [[*head, *shifts, "s/epoch", "parameters"]]
    for start in range(0, len(lines), len(LABELS)):
        group = {line["label"]: line for line in lines[start : start + len(LABELS)]}
        whole = group["overall"]
        partly = whole["failed"] != "0" and whole["ours"] != "failed"
        table.append(
            [whole["row"] + (f" ({whole['failed']} failed)" if partly else ""), whole["simulator"]]
            + [beside(group[label]) for label in LABELS]
            + [percent(group[label]["device_shift"]) for label in ("overall", *ALARM)]
            + [percent(whole["unseen_layout"])]
            + [whole["seconds_per_epoch"], whole["parameters"]]
        )
    return table


def results_csv(lines: Sequence[dict[str, str]]) -> str:
    """Return the lines as CSV with a header."""
    return tables.csv_text([COLUMNS, *([line[name] for name in COLUMNS] for line in lines)])


def seeds_csv(cells: Sequence[Cell]) -> str:
    """Return one line per run as CSV: row, simulator, seed, fingerprint, and each number of the table."""
    shown = [
        _metric(column, label) for column in ("same", "device_shift", "unseen_layout") for label in LABELS
    ]
    lines: list[list[object]] = [
        [cell.row, cell.simulator, run.data.tags["seed"], run.data.tags["fingerprint"]]
        + [run.data.metrics.get(metric, "") for metric in shown]
        for cell in cells
        for run in cell.runs
    ]
    return tables.csv_text([["row", "simulator", "seed", "run", *shown], *lines])


def _metric(column: str, label: str) -> str:
    return f"{column}/{ALARM.get(label, f'{label}/accuracy')}"


def _number(values: Sequence[float], digits: int = 6) -> str:
    return f"{fmean(values):.{digits}f}" if values else ""


def _reported(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


def beside(line: dict[str, str]) -> str:
    """Return our number ± its margin and, in brackets, the report's."""
    reported = percent(line["report"])
    return (percent(line["ours"], line["ours_margin"]) or "-") + (f" ({reported})" if reported else "")


def print_results(lines: Sequence[dict[str, str]], title: str, console: Console | None = None) -> None:
    """Print the results table, narrow enough for 80 columns with one seed; the report's overall in brackets.

    Args:
        lines: as :func:`result_rows` gives them.
        title: of the table.
        console: where to print; None takes standard output.
    """
    head = ["row", "data", "overall", "big", "dyn.", "press", "dang.", "recall", "false", "dev.", "lay."]
    table = [head]
    for start in range(0, len(lines), len(LABELS)):
        group = {line["label"]: line for line in lines[start : start + len(LABELS)]}
        whole = group["overall"]
        table.append(
            [whole["row"], whole["simulator"], beside(whole)]
            + [percent(group[label]["ours"]) for label in LABELS[1:]]
            + [percent(whole["device_shift"]), percent(whole["unseen_layout"])]
        )
    tables.print_table(table, title, console)
