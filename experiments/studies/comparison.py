"""Paired comparisons over seeds, and verdicts on statements."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

FEWEST = 3
"""Paired seeds below which every verdict is ``undecided``."""


@dataclass(frozen=True)
class Paired:
    """A difference or a ratio over seeds that two variants share.

    Attributes:
        mean: of one - other, or of one / other.
        error: standard error of that mean; infinite with a single seed.
        seeds: how many pairs there are.
    """

    mean: float
    error: float
    seeds: int


def paired(one: Mapping[str, float], other: Mapping[str, float], ratio: bool = False) -> Paired | None:
    """Compare two sets of figures seed by seed; None where they share no seed.

    The error is the sample deviation of the differences (or ratios) by the root of their number, as in a
    paired t-test.

    Args:
        one: seed -> figure.
        other: seed -> figure.
        ratio: take one / other instead of one - other.
    """
    pairs = [(one[seed], other[seed]) for seed in one if seed in other]
    each = [first / second if ratio else first - second for first, second in pairs]
    if not each:
        return None
    error = stdev(each) / math.sqrt(len(each)) if len(each) > 1 else math.inf
    return Paired(fmean(each), error, len(each))


def verdict(claim: str, found: Paired | None, by: float = 0.0) -> str:
    """Return ``agree``, ``disagree`` or ``undecided``.

    A claim is an interval in which the difference (for ``ratio``: the ratio) must lie. The verdict is
    ``agree`` if the mean with two standard errors on either side lies wholly inside, ``disagree`` if it lies
    wholly outside, else, and always with fewer than three paired seeds, ``undecided``.

    Args:
        claim: ``greater`` (0 to infinity), ``less`` (minus infinity to 0), ``alike`` (-by to by),
            ``no better`` (minus infinity to by), ``about`` or ``ratio`` (by / 2 to 2 by).
        found: the comparison, None without paired seeds.
        by: in the unit of the comparison.
    """
    least, most = {
        "greater": (0.0, math.inf),
        "less": (-math.inf, 0.0),
        "alike": (-by, by),
        "no better": (-math.inf, by),
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
