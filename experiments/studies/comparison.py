"""Paired comparisons over seeds, devices and gestures, and verdicts on statements."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

import numpy as np

RATIOS = ("at most", "ratio")
"""Claims about one / other; all others are about one - other."""

FEWEST = 3
"""Paired seeds below which every verdict is ``undecided``."""


Gestures = tuple[np.ndarray | None, np.ndarray | None]
"""The figures of two variants by gesture, each (G,), NaN where a gesture does not count; None: not known."""


@dataclass(frozen=True)
class Paired:
    """A difference or a ratio of two variants.

    Attributes:
        mean: of one - other, or one / other.
        error: standard error of that mean; infinite with a single pair.
        seeds: number of pairs.
    """

    mean: float
    error: float
    seeds: int


def paired(
    one: Mapping[str, float],
    other: Mapping[str, float],
    ratio: bool = False,
    across: tuple[Mapping[str, float], Mapping[str, float]] = ({}, {}),
    gestures: Gestures = (None, None),
) -> Paired | None:
    """Compare two variants; None where they share no seed (or device, where these are the first).

    Seeds, devices and gestures are a sample each, and every seed meets every device and gesture. The variance
    of the mean is the sum of three: over seeds, over devices and over gestures, each that of the paired
    differences, averaged over the other two, divided by their number. (The sum counts the interactions more
    than once, so that the error is rather too large.)

    Args:
        one: seed -> figure, or device -> figure.
        other: the same.
        ratio: take one / other instead of one - other.
        across: the same by what the first two are not by, device or seed.
        gestures: the same by gesture, in the same unit.
    """
    shared = [seed for seed in one if seed in other]
    if not shared:
        return None
    mean = fmean(_pairs(one, other, ratio))
    error = _error(_pairs(one, other, ratio)) if len(shared) > 1 else math.inf
    devices = _across_error(*across, ratio)
    return Paired(mean, math.hypot(error, devices, _gesture_error(gestures, ratio)), len(shared))


def estimate(
    by_seed: Mapping[str, float], by_device: Mapping[str, float], gestures: np.ndarray | None
) -> tuple[float, float]:
    """Return the mean of a variant and its standard error over seeds, devices and gestures.

    Args:
        by_seed: seed -> figure; at least one.
        by_device: the same by device.
        gestures: the same by gesture, (G,); None: not known.
    """
    known = [] if gestures is None else list(gestures[~np.isnan(gestures)])
    errors = _error([*by_seed.values()]), _error([*by_device.values()]), _error(known)
    return fmean(by_seed.values()), math.hypot(*errors)


def _pairs(one: Mapping[str, float], other: Mapping[str, float], ratio: bool) -> list[float]:
    pairs = [(one[key], other[key]) for key in one if key in other]
    return [first / second if ratio else first - second for first, second in pairs]


def _across_error(one: Mapping[str, float], other: Mapping[str, float], ratio: bool) -> float:
    """Return the standard error over devices, of which one variant may have several and the other one."""
    if len(pairs := _pairs(one, other, ratio)) > 1 or not one or not other:
        return _error(pairs)
    first, second = fmean(one.values()), fmean(other.values())
    errors = _error([*one.values()]), _error([*other.values()])
    return math.hypot(errors[0], first / second * errors[1]) / second if ratio else math.hypot(*errors)


def _error(each: Sequence[float]) -> float:
    """Return the standard error of a mean; 0 of less than two values."""
    return stdev(each) / math.sqrt(len(each)) if len(each) > 1 else 0.0


def _gesture_error(gestures: Gestures, ratio: bool) -> float:
    """Return the standard error over gestures: unpaired if their numbers differ, 0 if they are unknown."""
    one, other = gestures
    if one is None or other is None:
        return 0.0
    if len(one) != len(other):
        return math.hypot(*(_error(list(each[~np.isnan(each)])) for each in (one, other)))
    counted = ~(np.isnan(one) | np.isnan(other))
    one, other = one[counted], other[counted]
    if not ratio:
        return _error(list(one - other))
    # The ratio of two means, linearised (delta method).
    below = other.mean()
    return _error(list((one - one.mean() / below * other) / below)) if below else 0.0


def verdict(claim: str, found: Paired | None, by: float = 0.0) -> str:
    """Return ``agree``, ``disagree`` or ``undecided``.

    A claim is an interval in which the difference (for ``RATIOS``: the ratio) must lie. The verdict is
    ``agree`` if the mean with two standard errors on either side lies wholly inside, ``disagree`` if it lies
    wholly outside, else, and always with fewer than three paired seeds, ``undecided``.

    Args:
        claim: ``greater`` (by to infinity), ``less`` (minus infinity to by), ``alike`` (-by to by),
            ``no better`` and ``at most`` (minus infinity to by), ``about`` or ``ratio`` (by / 2 to 2 by).
        found: the comparison, None without paired seeds.
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
    if found is None or found.seeds < FEWEST:
        return "undecided"
    low, high = found.mean - 2 * found.error, found.mean + 2 * found.error
    if least < low and high < most:
        return "agree"
    return "disagree" if high < least or low > most else "undecided"


def combine_verdicts(verdicts: Sequence[str]) -> str:
    """Return the verdict of a statement with several comparisons: it holds only if it holds for each."""
    if "disagree" in verdicts:
        return "disagree"
    return "agree" if verdicts and set(verdicts) == {"agree"} else "undecided"
