"""Paired comparisons over seeds, devices and gestures, and what they decide of the trials of a study."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import stdtrit

from experiments.studies.study import Statement, Study
from experiments.studies.trials import TrialResult
from skin.evaluation.metrics import decodable, decode
from skin.touch.labels import TOUCH

RATIOS = ("at most", "ratio")
"""Claims about one / other; all others are about one - other."""

CONFIDENCE = 0.95
"""Of the intervals that a margin describes."""

FEWEST = 3
"""Paired seeds below which every verdict is ``undecided``."""


Gestures = tuple[np.ndarray | None, np.ndarray | None]
"""The figures of two variants by gesture, each (G,), NaN where a gesture does not count; None: not known."""


class Uncertainty(NamedTuple):
    """How far a mean may be from the true one.

    The margin of a sample of n is the standard error times the quantile of Student's t distribution with
    n - 1 degrees of freedom: 4.30 standard errors of three seeds, 1.96 of 4000 gestures.

    Attributes:
        error: standard error.
        margin: half of the interval that covers the true mean with ``CONFIDENCE``; published behind "±".
    """

    error: float
    margin: float

    @classmethod
    def of(cls, sample: Sequence[float]) -> "Uncertainty":
        """Return the uncertainty of the mean of a sample; 0 of less than two values."""
        if len(sample) < 2:
            return cls(0.0, 0.0)
        error = stdev(sample) / math.sqrt(len(sample))
        return cls(error, t_quantile(len(sample)) * error)

    @classmethod
    def together(cls, *parts: "Uncertainty") -> "Uncertainty":
        """Return the uncertainty of a sum of independent parts, the root of the sum of squares."""
        return cls(math.hypot(*(part.error for part in parts)), math.hypot(*(part.margin for part in parts)))

    def times(self, factor: float) -> "Uncertainty":
        """Return the uncertainty of a multiple of the mean."""
        return Uncertainty(abs(factor) * self.error, abs(factor) * self.margin)


NOT_KNOWN = Uncertainty(math.inf, math.inf)
"""Of a single seed."""


class Estimate(NamedTuple):
    """A mean, its standard error, and its margin (:class:`Uncertainty`)."""

    mean: float
    error: float
    margin: float


@dataclass(frozen=True)
class Paired:
    """A difference or a ratio of two variants.

    Attributes:
        mean: of left - right, or left / right.
        error: standard error of that mean; infinite with a single pair.
        margin: half of its interval (:class:`Uncertainty`); infinite with a single pair.
        seeds: number of pairs.
    """

    mean: float
    error: float
    margin: float
    seeds: int


def t_quantile(count: int) -> float:
    """Return how many standard errors of the mean of ``count`` values the interval has on either side."""
    return float(stdtrit(count - 1, (1 + CONFIDENCE) / 2))


def paired(
    left: Mapping[str, float],
    right: Mapping[str, float],
    ratio: bool = False,
    across: tuple[Mapping[str, float], Mapping[str, float]] = ({}, {}),
    gestures: Gestures = (None, None),
) -> Paired | None:
    """Compare two variants; None where they share no seed (or device, where these are the first).

    Seeds, devices and gestures are a sample each, and every seed meets every device and gesture. The variance
    of the mean is the sum of three: over seeds, over devices and over gestures, each that of the paired
    differences, averaged over the other two, divided by their number. (The sum counts the interactions more
    than once, so that the error is rather too large.) The margin is the root of the sum of three squares in
    the same way, each part with the quantile of its own number of values.

    Args:
        left: seed -> figure, or device -> figure.
        right: the same.
        ratio: take left / right instead of left - right.
        across: the same by what the first two are not by, device or seed.
        gestures: the same by gesture, in the same unit.
    """
    shared = [seed for seed in left if seed in right]
    if not shared:
        return None
    mean = fmean(_pairs(left, right, ratio))
    seeds = Uncertainty.of(_pairs(left, right, ratio)) if len(shared) > 1 else NOT_KNOWN
    devices, touches = _across(*across, ratio), _over_gestures(gestures, ratio)
    return Paired(mean, *Uncertainty.together(seeds, devices, touches), len(shared))


def estimate(
    by_seed: Mapping[str, float], by_device: Mapping[str, float], gestures: np.ndarray | None
) -> Estimate:
    """Return the mean of a variant, and its error and margin over seeds, devices and gestures.

    Args:
        by_seed: seed -> figure; at least one.
        by_device: the same by device.
        gestures: the same by gesture, (G,); None: not known.
    """
    counted = [] if gestures is None else list(gestures[~np.isnan(gestures)])
    parts = map(Uncertainty.of, ([*by_seed.values()], [*by_device.values()], counted))
    return Estimate(fmean(by_seed.values()), *Uncertainty.together(*parts))


def _pairs(left: Mapping[str, float], right: Mapping[str, float], ratio: bool) -> list[float]:
    pairs = [(left[key], right[key]) for key in left if key in right]
    return [first / second if ratio else first - second for first, second in pairs]


def _across(left: Mapping[str, float], right: Mapping[str, float], ratio: bool) -> Uncertainty:
    """Return the uncertainty over devices, of which one variant may have several and the other one."""
    if len(pairs := _pairs(left, right, ratio)) > 1 or not left or not right:
        return Uncertainty.of(pairs)
    first, second = fmean(left.values()), fmean(right.values())
    above, below = Uncertainty.of([*left.values()]), Uncertainty.of([*right.values()])
    if not ratio:
        return Uncertainty.together(above, below)
    return Uncertainty.together(above.times(1 / second), below.times(first / second**2))


def _over_gestures(gestures: Gestures, ratio: bool) -> Uncertainty:
    """Return the uncertainty over gestures: unpaired if their numbers differ, 0 if they are unknown."""
    left, right = gestures
    if left is None or right is None:
        return Uncertainty(0.0, 0.0)
    if len(left) != len(right):
        parts = (Uncertainty.of(list(part[~np.isnan(part)])) for part in (left, right))
        return Uncertainty.together(*parts)
    counted = ~(np.isnan(left) | np.isnan(right))
    left, right = left[counted], right[counted]
    if not ratio:
        return Uncertainty.of(list(left - right))
    # The ratio of two means, linearised (delta method).
    below = right.mean()
    return Uncertainty.of(list((left - left.mean() / below * right) / below) if below else [])


def judge_claim(claim: str, compared: Paired | None, by: float = 0.0) -> str:
    """Return ``agree``, ``disagree`` or ``undecided``.

    A claim is an interval in which the difference (for ``RATIOS``: the ratio) must lie. The verdict is
    ``agree`` if the mean with its margin on either side lies wholly inside, ``disagree`` if it lies
    wholly outside, else, and always with fewer than three paired seeds, ``undecided``.

    Args:
        claim: ``greater`` (by to infinity), ``less`` (minus infinity to by), ``alike`` (-by to by),
            ``no better`` and ``at most`` (minus infinity to by), ``about`` or ``ratio`` (by / 2 to 2 by).
        compared: the variants, None without paired seeds.
        by: in the unit of the comparison.
    """
    least, most = {
        "greater": (by, math.inf),
        "less": (-math.inf, by),
        "alike": (-by, by),
        "no better": (-math.inf, by),
        "at most": (-math.inf, by),
        "about": (by / 2, 2 * by),
        "ratio": (by / 2, 2 * by),
    }[claim]
    if compared is None or compared.seeds < FEWEST:
        return "undecided"
    low, high = compared.mean - compared.margin, compared.mean + compared.margin
    if least < low and high < most:
        return "agree"
    return "disagree" if high < least or low > most else "undecided"


def combine_verdicts(verdicts: Sequence[str]) -> str:
    """Return the verdict of a statement with several comparisons: it holds only if it holds for each."""
    if "disagree" in verdicts:
        return "disagree"
    return "agree" if verdicts and set(verdicts) == {"agree"} else "undecided"


UNITS = {"seconds_per_epoch": "s", "parameters": "", "same/direction/degrees": "°"}
"""Metrics that are no shares -> their unit."""

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
        compared: the two lines, shares in percentage points.
        verdict: better, worse or undecided.
    """

    variant: str
    condition: str
    compared: Paired | None
    verdict: str


def group_trials(trials: Sequence[TrialResult]) -> dict[tuple[str, str], list[TrialResult]]:
    """Return the trials of each variant and condition, in their order."""
    groups: dict[tuple[str, str], list[TrialResult]] = {}
    for trial in trials:
        groups.setdefault((trial.variant.name, trial.condition), []).append(trial)
    return groups


def values(
    trials: Sequence[TrialResult], metric: str, by: Literal["seed", "device"] = "seed"
) -> dict[str, float]:
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


def by_gesture(trials: Sequence[TrialResult], metric: str) -> np.ndarray | None:
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
    left: Sequence[TrialResult],
    right: Sequence[TrialResult],
    metric: str,
    ratio: bool = False,
    by: Literal["seed", "device"] = "seed",
) -> Paired | None:
    """Compare the trials of two lines, paired by seed, device and gesture; ``by`` says what is counted."""
    across: Literal["seed", "device"] = "device" if by == "seed" else "seed"
    first, second = ((values(left, metric, axis), values(right, metric, axis)) for axis in (by, across))
    return paired(*first, ratio, second, (by_gesture(left, metric), by_gesture(right, metric)))


def conclusions(statements: Sequence[Statement], trials: Sequence[TrialResult]) -> list[StatementResult]:
    """Return every statement with its comparisons and its verdict."""
    return [_outcome(statement, trials) for statement in statements]


def differences(study: Study, trials: Sequence[TrialResult]) -> list[Difference]:
    """Compare each condition with the first one of its variant, or each variant with the first one.

    A comparison of devices counts these, and not the seeds of the training, as its pairs.
    """
    if study.differences is None:
        return []
    words = {"agree": "better", "disagree": "worse", "undecided": "undecided"}
    by: Literal["seed", "device"] = "device" if study.devices else "seed"
    changes, first = [], dict[str, list[TrialResult]]()
    for (variant, condition), group in group_trials(trials).items():
        base = first.setdefault(variant if study.conditions else "", group)
        if base is not group:
            compared = compare(group, base, study.metrics[0], by=by)
            word = words[judge_claim(study.differences, compared)]
            changes.append(Difference(variant, condition, compared, word))
    return changes


def _outcome(statement: Statement, trials: Sequence[TrialResult]) -> StatementResult:
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
    verdicts = [judge_claim(statement.claim, comparison, statement.by) for comparison in compared.values()]
    return StatementResult(statement, compared, combine_verdicts(verdicts))


def _line(chosen: Mapping[str, str], trials: Sequence[TrialResult]) -> tuple[str, list[TrialResult]]:
    """Return the name and the trials of the first line that was so chosen; no trials without one."""
    for (variant, condition), group in group_trials(trials).items():
        settings = {**group[0].variant.chosen, "condition": condition}
        if chosen.items() <= settings.items():
            return f"{variant}, {condition}" if condition else variant, group
    return " ".join(chosen.values()), []


def mean_and_margin(trials: Sequence[TrialResult], metric: str) -> Estimate:
    """Return the mean of a metric of trials, its standard error and its margin; of shares in per cent."""
    return estimate(values(trials, metric), values(trials, metric, "device"), by_gesture(trials, metric))


def metric_heading(metric: str) -> str:
    """Return a column's name: ``overall`` of ``same/overall/accuracy``."""
    plain = metric.removeprefix("same/").removesuffix("/accuracy").replace("/overall", "")
    return _HEADINGS.get(metric, plain.replace("_", " "))
