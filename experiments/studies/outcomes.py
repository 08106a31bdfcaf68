"""Results of the trials of a study: its statements, and differences between conditions or variants."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

from experiments.studies.comparison import Paired, combine_verdicts, paired, verdict
from experiments.studies.study import Statement, Study
from experiments.studies.trials import Trial

UNITS = {"seconds_per_epoch": "s", "parameters": "", "self_share": "", "same/direction/degrees": "°"}
"""Metrics that are no shares -> their unit."""


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
    found: dict[tuple[str, str], list[Trial]] = {}
    for one in trials:
        found.setdefault((one.variant.name, one.condition), []).append(one)
    return found


def values(trials: Sequence[Trial], metric: str, by: Literal["seed", "device"] = "seed") -> dict[str, float]:
    """Return a metric, or the difference ``a - b`` of two, by training or by device, averaged over the other.

    Args:
        trials: of one line.
        metric: as logged; shares come in per cent.
        by: attribute of the trials.
    """
    first, *rest = metric.split(" - ")
    scale = 1 if metric in UNITS else 100
    groups: dict[str, list[float]] = {}
    for one in trials:
        if all(name in one.metrics for name in (first, *rest)):
            value = one.metrics[first] - sum(one.metrics[name] for name in rest)
            groups.setdefault(getattr(one, by), []).append(scale * value)
    return {key: fmean(each) for key, each in groups.items()}


def conclusions(statements: Sequence[Statement], trials: Sequence[Trial]) -> list[StatementResult]:
    """Return every statement with its comparisons and its verdict."""
    return [_outcome(statement, trials) for statement in statements]


def differences(study: Study, trials: Sequence[Trial]) -> list[Difference]:
    """Compare each condition with the first one of its variant, or each variant with the first one.

    The figures are paired over devices where there are several, over seeds of the training else.
    """
    if study.differences is None:
        return []
    words = {"agree": "better", "disagree": "worse", "undecided": "undecided"}
    by: Literal["seed", "device"] = "device" if study.devices else "seed"
    found, first = [], dict[str, dict[str, float]]()
    for (variant, condition), each in group_trials(trials).items():
        figures = values(each, study.metrics[0], by)
        base = first.setdefault(variant if study.conditions else "", figures)
        if base is not figures:
            compared = paired(figures, base)
            word = words[verdict(study.differences, compared)]
            found.append(Difference(variant, condition, compared, word))
    return found


def _outcome(statement: Statement, trials: Sequence[Trial]) -> StatementResult:
    _, one = _figures(statement.one, statement.metric, trials)
    others = dict(_figures(other, statement.metric, trials) for other in statement.others)
    if statement.level is not None:
        scale = 1 if statement.metric in UNITS else 100
        others[f"{statement.level:g}"] = dict.fromkeys(one, scale * statement.level)
    compared = {name: paired(one, other, statement.claim == "ratio") for name, other in others.items()}
    verdicts = [verdict(statement.claim, found, statement.by) for found in compared.values()]
    return StatementResult(statement, compared, combine_verdicts(verdicts))


def _figures(chosen: Mapping[str, str], metric: str, trials: Sequence[Trial]) -> tuple[str, dict[str, float]]:
    """Return the name and, by seed, the figures of the first line that was so chosen."""
    for (variant, condition), each in group_trials(trials).items():
        known = {**each[0].variant.chosen, "condition": condition}
        if chosen.items() <= known.items():
            name = f"{variant}, {condition}" if condition else variant
            return name, values(each, metric)
    return " ".join(chosen.values()), {}
