"""Results of the trials of a study: its statements, and differences between conditions or variants."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

import numpy as np

from experiments.studies.comparison import (
    RATIOS,
    Estimate,
    Paired,
    combine_verdicts,
    estimate,
    paired,
    verdict,
)
from experiments.studies.study import Statement, Study
from experiments.studies.trials import Trial
from skin.evaluation.metrics import decodable, decode
from skin.touch.labels import TOUCH

UNITS = {"seconds_per_epoch": "s", "parameters": "", "self_share": "", "same/direction/degrees": "°"}
"""Metrics that are no shares -> their unit."""

_HEADINGS = {
    "same/dangerous/alarm_recall": "recall",
    "same/dangerous/false_alarm_rate": "false alarms",
    "train_accuracy": "training",
    "seconds_per_epoch": "s/epoch",
    "self_share": "self",
    "same/direction/degrees": "degrees",
    "same/direction/accuracy": "within 45°",
    "device_shift/dangerous/alarm_recall": "its recall",
    "device_shift/dangerous/false_alarm_rate": "its false alarms",
}


@dataclass(frozen=True)
class StatementResult:
    """The verdict on a statement.

    Attributes:
        statement: the statement.
        compared: name of the other side -> the comparison; shares in percentage points.
        verdict: agree, disagree or undecided.
    """

    statement: Statement
    compared: Mapping[str, Paired | None]
    verdict: str


@dataclass(frozen=True)
class Difference:
    """How a line of the table differs from the one that it is compared with.

    Attributes:
        variant: name.
        condition: name, or empty.
        found: the comparison, shares in percentage points.
        verdict: better, worse or undecided.
    """

    variant: str
    condition: str
    found: Paired | None
    verdict: str


def group_trials(trials: Sequence[Trial]) -> dict[tuple[str, str], list[Trial]]:
    """Return the trials of each variant and condition, in their order."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.variant.name, trial.condition), []).append(trial)
    return groups


def values(trials: Sequence[Trial], metric: str, by: Literal["seed", "device"] = "seed") -> dict[str, float]:
    """Return a metric, or the difference ``a - b`` of two, by training or by device, averaged over the other.

    Args:
        trials: of one line.
        metric: as logged; shares come in per cent. ``/error`` is what is missing of ``/accuracy``.
        by: attribute of the trials.
    """
    first, *subtracted = metric.split(" - ")
    scale = 1 if metric in UNITS else 100
    groups: dict[str, list[float]] = {}
    for trial in trials:
        figures = dict(trial.metrics) | {
            f"{name.removesuffix('accuracy')}error": 1 - value
            for name, value in trial.metrics.items()
            if name.endswith("/accuracy")
        }
        if all(name in figures for name in (first, *subtracted)):
            value = figures[first] - sum(figures[name] for name in subtracted)
            groups.setdefault(getattr(trial, by), []).append(scale * value)
    return {key: fmean(sample) for key, sample in groups.items()}


def by_gesture(trials: Sequence[Trial], metric: str) -> np.ndarray | None:
    """Return the figure of each test gesture, averaged over trials, (G,), in per cent; None: not known.

    Args:
        trials: of one line.
        metric: one of a run on its test gestures; others have no figures by gesture.
    """
    codes = [trial.outcomes for trial in trials if trial.outcomes is not None]
    plain, wrong = metric.removeprefix("same/"), metric.endswith("/error")
    plain = plain.removesuffix("error") + "accuracy" if wrong else plain
    if plain == metric or not decodable(plain, TOUCH):
        return None
    if not codes or len(codes) < len(trials) or len({len(code) for code in codes}) > 1:
        return None
    figures = decode(np.stack(codes), plain, TOUCH)
    mean: np.ndarray = 100 * (1 - figures if wrong else figures).mean(axis=0)
    return mean


def compare(
    one: Sequence[Trial],
    other: Sequence[Trial],
    metric: str,
    ratio: bool = False,
    by: Literal["seed", "device"] = "seed",
) -> Paired | None:
    """Compare the trials of two lines, paired by seed, device and gesture; ``by`` says what is counted."""
    across: Literal["seed", "device"] = "device" if by == "seed" else "seed"
    first, second = ((values(one, metric, axis), values(other, metric, axis)) for axis in (by, across))
    return paired(*first, ratio, second, (by_gesture(one, metric), by_gesture(other, metric)))


def conclusions(statements: Sequence[Statement], trials: Sequence[Trial]) -> list[StatementResult]:
    """Return every statement with its comparisons and its verdict."""
    return [_outcome(statement, trials) for statement in statements]


def differences(study: Study, trials: Sequence[Trial]) -> list[Difference]:
    """Compare each condition with the first one of its variant, or each variant with the first one.

    A comparison of devices counts these, and not the seeds of the training, as its pairs.
    """
    if study.differences is None:
        return []
    words = {"agree": "better", "disagree": "worse", "undecided": "undecided"}
    by: Literal["seed", "device"] = "device" if study.devices else "seed"
    changes, first = [], dict[str, list[Trial]]()
    for (variant, condition), group in group_trials(trials).items():
        base = first.setdefault(variant if study.conditions else "", group)
        if base is not group:
            compared = compare(group, base, study.metrics[0], by=by)
            word = words[verdict(study.differences, compared)]
            changes.append(Difference(variant, condition, compared, word))
    return changes


def _outcome(statement: Statement, trials: Sequence[Trial]) -> StatementResult:
    metric, ratio = statement.metric, statement.claim in RATIOS
    _, first = _line(statement.one, trials)
    lines = dict(_line(chosen, trials) for chosen in statement.others)
    compared = {name: compare(first, line, metric, ratio) for name, line in lines.items()}
    if statement.level is not None:
        figures, gestures = values(first, metric), by_gesture(first, metric)
        level = (1 if metric in UNITS else 100) * statement.level
        even = None if gestures is None else np.full_like(gestures, level)
        compared[f"{statement.level:g}"] = paired(
            figures, dict.fromkeys(figures, level), ratio, gestures=(gestures, even)
        )
    verdicts = [verdict(statement.claim, comparison, statement.by) for comparison in compared.values()]
    return StatementResult(statement, compared, combine_verdicts(verdicts))


def _line(chosen: Mapping[str, str], trials: Sequence[Trial]) -> tuple[str, list[Trial]]:
    """Return the name and the trials of the first line that was so chosen; no trials without one."""
    for (variant, condition), group in group_trials(trials).items():
        settings = {**group[0].variant.chosen, "condition": condition}
        if chosen.items() <= settings.items():
            return f"{variant}, {condition}" if condition else variant, group
    return " ".join(chosen.values()), []


def mean_and_margin(trials: Sequence[Trial], metric: str) -> Estimate:
    """Return the mean of a metric of trials, its standard error and its margin; of shares in per cent."""
    return estimate(values(trials, metric), values(trials, metric, "device"), by_gesture(trials, metric))


def heading(metric: str) -> str:
    """Return a column's name: ``overall`` of ``same/overall/accuracy``."""
    plain = metric.removeprefix("same/").removesuffix("/accuracy").replace("/overall", "")
    return _HEADINGS.get(metric, plain.replace("_", " "))
