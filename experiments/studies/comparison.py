"""Means, margins and paired comparisons of trials; what they decide of the statements of a study."""

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import t

from experiments.studies.study import Statement, Study
from skin.errors import InputError
from skin.evaluation.metrics import decodable, decode
from skin.touch.labels import TOUCH

UNITS = {
    "seconds_per_epoch": "s",
    "parameters": "",
    "same/direction/degrees": "°",
    "same/place/rms_mm": "mm",
    "same/force/rms_N": "N",
}
"""Metrics that are not fractions -> their unit."""

By = Literal["seed", "device"]
Gestures = tuple[np.ndarray | None, np.ndarray | None]
"""The figures of two variants by gesture, each (G,), NaN where a gesture does not count; None: unknown."""


class Estimate(NamedTuple):
    """A mean, or a difference or a ratio of two variants.

    Attributes:
        mean: of a variant, of left - right, or of left / right.
        error: standard error of the mean; infinite for a comparison of a single pair.
        margin: half of its interval (:func:`uncertainty`), published behind "±".
        seeds: number of seeds or devices, or of pairs of them.
    """

    mean: float
    error: float
    margin: float
    seeds: int


class Conclusion(NamedTuple):
    """What trials say about a statement.

    Attributes:
        statement: that was tested.
        compared: name of the other side -> the comparison; fractions in percentage points.
        verdict: agree, disagree or undecided.
    """

    statement: Statement
    compared: Mapping[str, Estimate | None]
    verdict: str


def uncertainty(sample: Sequence[float] | np.ndarray | pd.Series) -> np.ndarray:
    """Return the standard error of the mean of a sample and half of its 95 % interval, (2,); 0 below two.

    Half of the interval is the error times the quantile of Student's t distribution: 4.30 for three seeds,
    1.96 for 4000 gestures. NaN does not count.
    """
    values = pd.Series(sample, dtype=float).dropna()
    if len(values) < 2:
        return np.zeros(2)
    return values.sem() * np.array([1.0, t.interval(0.95, len(values) - 1)[1]])


def together(*parts: np.ndarray) -> np.ndarray:
    """Return the uncertainty of a sum of independent parts, the root of the sum of squares, (2,)."""
    return np.array([math.hypot(*column) for column in zip(*parts, strict=True)])


def compare_samples(
    left: pd.Series,
    right: pd.Series,
    ratio: bool = False,
    across: tuple[pd.Series, pd.Series] | None = None,
    gestures: Gestures = (None, None),
) -> Estimate | None:
    """Compare two variants; None where they share no seed (or device, where these are the first).

    Seeds, devices and gestures are a sample each, and every seed meets every device and gesture. The variance
    of the mean is the sum of three: over seeds, over devices and over gestures, each that of the paired
    differences, averaged over the other two, divided by their number. (The sum counts the interactions more
    than once, so that the error is rather too large.) The margin is the root of the sum of three squares in
    the same way, each part with the quantile of its own number of values.

    Args:
        left, right: figures by seed, or by device.
        ratio: take left / right instead of left - right; of figures without devices and gestures.
        across: the same by what the first two are not by, device or seed.
        gestures: the same by gesture, in the same unit.

    Raises:
        InputError: a ratio of figures by gesture.
    """
    pairs, devices = _pair(left, right, ratio), np.zeros(2)
    if pairs.empty:
        return None
    if ratio and gestures[0] is not None:
        raise InputError("a ratio needs a metric without figures by gesture, such as seconds_per_epoch")
    seeds = uncertainty(pairs) if len(pairs) > 1 else np.full(2, math.inf)
    if across is not None and not across[0].empty and not across[1].empty:
        shared = _pair(*across, ratio)
        devices = uncertainty(shared) if len(shared) > 1 else _unpaired(*across)
    error, margin = together(seeds, devices, _over_gestures(*gestures))
    return Estimate(fmean(pairs), error, margin, len(pairs))


def _pair(left: pd.Series, right: pd.Series, ratio: bool) -> pd.Series:
    first, second = left.align(right, join="inner")
    return first / second if ratio else first - second


def _unpaired(left: pd.Series | np.ndarray, right: pd.Series | np.ndarray) -> np.ndarray:
    return together(uncertainty(left), uncertainty(right))


def _over_gestures(left: np.ndarray | None, right: np.ndarray | None) -> np.ndarray:
    """Return the uncertainty over gestures: unpaired if their numbers differ, 0 if they are unknown."""
    if left is None or right is None:
        return np.zeros(2)
    if len(left) != len(right):
        return _unpaired(left, right)
    return uncertainty(left - right)


def judge(statement: Statement, compared: Estimate | None) -> str:
    """Return ``agree``, ``disagree`` or ``undecided``.

    ``agree`` if the mean with its margin on either side lies wholly inside of the interval of the statement,
    ``disagree`` if it lies wholly outside, else, and always with fewer than three pairs, ``undecided``: two
    pairs have a margin of 12.7 standard errors.
    """
    if compared is None or compared.seeds < 3:
        return "undecided"
    low, high = compared.mean - compared.margin, compared.mean + compared.margin
    if statement.minimum < low and high < statement.maximum:
        return "agree"
    return "disagree" if high < statement.minimum or low > statement.maximum else "undecided"


def combine_verdicts(verdicts: Sequence[str]) -> str:
    """Return the verdict of a statement with several comparisons: it holds only if it holds for each."""
    if "disagree" in verdicts:
        return "disagree"
    return "agree" if verdicts and set(verdicts) == {"agree"} else "undecided"


def values(trials: pd.DataFrame, metric: str, by: By = "seed") -> pd.Series:
    """Return a metric, or the difference ``a - b`` of two, by training or by device, averaged over the other.

    Args:
        trials: of one line.
        metric: as logged; fractions come in per cent.
        by: column of the trials.
    """
    first, *subtracted = (_column(trials, name) for name in metric.split(" - "))
    figures = ((1 if metric in UNITS else 100) * (first - sum(subtracted))).dropna()
    # fmean is exact: what is halfway between two published digits does not hang on the order of the sum.
    return figures.groupby(trials[by], sort=False).agg(fmean)


def _column(trials: pd.DataFrame, metric: str) -> pd.Series:
    return trials[metric] if metric in trials else pd.Series(np.nan, trials.index)


def by_gesture(trials: pd.DataFrame, metric: str) -> np.ndarray | None:
    """Return the figure of each test gesture, averaged over trials, (G,), in per cent; None: unknown.

    Args:
        trials: of one line.
        metric: one of a run on its test gestures; others have no figures by gesture.
    """
    codes = [np.frombuffer(outcomes or b"", np.uint8) for outcomes in trials.outcomes]
    plain = metric.removeprefix("same/")
    if not metric.startswith("same/") or not decodable(plain, TOUCH):
        return None
    if not all(map(len, codes)) or len({len(code) for code in codes}) != 1:
        return None
    return 100 * decode(np.stack(codes), plain, TOUCH).mean(axis=0)


def estimate(trials: pd.DataFrame, metric: str) -> Estimate:
    """Return the mean of a metric over trials, and its error and margin over seeds, devices and gestures."""
    seeds, gestures = values(trials, metric), by_gesture(trials, metric)
    parts = seeds, values(trials, metric, "device"), np.zeros(0) if gestures is None else gestures
    error, margin = together(*map(uncertainty, parts))
    return Estimate(fmean(seeds), error, margin, len(seeds))


def compare(
    left: pd.DataFrame, right: pd.DataFrame, metric: str, ratio: bool = False, by: By = "seed"
) -> Estimate | None:
    """Compare the trials of two lines, paired by seed, device and gesture; ``by`` says what is counted."""
    other: By = "device" if by == "seed" else "seed"
    pairs = [(values(left, metric, axis), values(right, metric, axis)) for axis in (by, other)]
    return compare_samples(*pairs[0], ratio, pairs[1], (by_gesture(left, metric), by_gesture(right, metric)))


def conclude(statement: Statement, trials: pd.DataFrame) -> Conclusion:
    """Return the comparisons of a statement, and its verdict."""
    _, first = _line(statement.one, trials)
    lines = dict(_line(chosen, trials) for chosen in statement.others)
    compared = {name: compare(first, line, statement.metric, statement.ratio) for name, line in lines.items()}
    if statement.level is not None:
        figures, gestures = values(first, statement.metric), by_gesture(first, statement.metric)
        level = (1 if statement.metric in UNITS else 100) * statement.level
        even = None if gestures is None else np.full_like(gestures, level)
        compared[f"{statement.level:g}"] = compare_samples(
            figures, 0 * figures + level, statement.ratio, gestures=(gestures, even)
        )
    if not trials.outcomes.notna().any():  # published files do not hold them
        compared = {
            name: pair and pair._replace(margin=math.hypot(pair.margin, statement.over_gestures))
            for name, pair in compared.items()
        }
    verdicts = [judge(statement, pair) for pair in compared.values()]
    return Conclusion(statement, compared, combine_verdicts(verdicts))


def _line(chosen: Mapping[str, str], trials: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    """Return the name and the trials of the first line that was so chosen; no trials without one."""
    settings = (own | {"condition": name} for own, name in zip(trials.chosen, trials.condition, strict=True))
    matches = trials[np.array([chosen.items() <= each.items() for each in settings], bool)]
    if matches.empty:
        return " ".join(chosen.values()), matches
    first = matches.iloc[0]
    line = trials[(trials.variant == first.variant) & (trials.condition == first.condition)]
    return ", ".join(filter(None, (first.variant, first.condition))), line


def differences(study: Study, trials: pd.DataFrame) -> Iterator[tuple[str, str, Estimate | None, str]]:
    """Compare each condition with the first one of its variant, or each variant with the first one.

    A comparison of devices counts these, and not the seeds of the training, as its pairs.

    Yields:
        variant, condition, the comparison, and better, worse or undecided.
    """
    words = {"agree": "better", "disagree": "worse", "undecided": "undecided"}
    better = (
        Statement("", "", {}, study.metrics[0], minimum=0)
        if study.differences == "greater"
        else (Statement("", "", {}, study.metrics[0], maximum=0))
    )
    by: By = "device" if study.devices else "seed"
    first = dict[str, pd.DataFrame]()
    for (variant, condition), group in trials.groupby(["variant", "condition"], sort=False):
        base = first.setdefault(variant if study.conditions else "", group)
        if base is not group:
            compared = compare(group, base, study.metrics[0], by=by)
            yield variant, condition, compared, words[judge(better, compared)]
