"""Paired comparisons over seeds, devices and gestures, and verdicts on statements."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

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
        mean: of one - other, or one / other.
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
    than once, so that the error is rather too large.) The margin is the root of the sum of three squares in
    the same way, each part with the quantile of its own number of values.

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
    seeds = Uncertainty.of(_pairs(one, other, ratio)) if len(shared) > 1 else NOT_KNOWN
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
    known = [] if gestures is None else list(gestures[~np.isnan(gestures)])
    parts = map(Uncertainty.of, ([*by_seed.values()], [*by_device.values()], known))
    return Estimate(fmean(by_seed.values()), *Uncertainty.together(*parts))


def _pairs(one: Mapping[str, float], other: Mapping[str, float], ratio: bool) -> list[float]:
    pairs = [(one[key], other[key]) for key in one if key in other]
    return [first / second if ratio else first - second for first, second in pairs]


def _across(one: Mapping[str, float], other: Mapping[str, float], ratio: bool) -> Uncertainty:
    """Return the uncertainty over devices, of which one variant may have several and the other one."""
    if len(pairs := _pairs(one, other, ratio)) > 1 or not one or not other:
        return Uncertainty.of(pairs)
    first, second = fmean(one.values()), fmean(other.values())
    above, below = Uncertainty.of([*one.values()]), Uncertainty.of([*other.values()])
    if not ratio:
        return Uncertainty.together(above, below)
    return Uncertainty.together(above.times(1 / second), below.times(first / second**2))


def _over_gestures(gestures: Gestures, ratio: bool) -> Uncertainty:
    """Return the uncertainty over gestures: unpaired if their numbers differ, 0 if they are unknown."""
    one, other = gestures
    if one is None or other is None:
        return Uncertainty(0.0, 0.0)
    if len(one) != len(other):
        each = (Uncertainty.of(list(part[~np.isnan(part)])) for part in (one, other))
        return Uncertainty.together(*each)
    counted = ~(np.isnan(one) | np.isnan(other))
    one, other = one[counted], other[counted]
    if not ratio:
        return Uncertainty.of(list(one - other))
    # The ratio of two means, linearised (delta method).
    below = other.mean()
    return Uncertainty.of(list((one - one.mean() / below * other) / below) if below else [])


def verdict(claim: str, found: Paired | None, by: float = 0.0) -> str:
    """Return ``agree``, ``disagree`` or ``undecided``.

    A claim is an interval in which the difference (for ``RATIOS``: the ratio) must lie. The verdict is
    ``agree`` if the mean with its margin on either side lies wholly inside, ``disagree`` if it lies
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
    low, high = found.mean - found.margin, found.mean + found.margin
    if least < low and high < most:
        return "agree"
    return "disagree" if high < least or low > most else "undecided"


def combine_verdicts(verdicts: Sequence[str]) -> str:
    """Return the verdict of a statement with several comparisons: it holds only if it holds for each."""
    if "disagree" in verdicts:
        return "disagree"
    return "agree" if verdicts and set(verdicts) == {"agree"} else "undecided"
