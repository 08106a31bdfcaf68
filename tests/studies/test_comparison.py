"""Verdicts follow from intervals over paired seeds."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy.stats import ttest_rel

from experiments.studies.comparison import Estimate, combine_verdicts, compare_samples, judge
from experiments.studies.study import Statement
from skin.errors import InputError

INF = math.inf
VERDICTS = [
    (0, INF, 2.1, 2.0, "agree"), (0, INF, 1.9, 2.0, "undecided"), (0, INF, -1.9, 2.0, "undecided"),
    (0, INF, -2.1, 2.0, "disagree"), (-INF, 0, -2.1, 2.0, "agree"), (-INF, 0, 2.1, 2.0, "disagree"),
    (-2, 2, 0.9, 1.0, "agree"), (-2, 2, 1.1, 1.0, "undecided"), (-2, 2, -3.1, 1.0, "disagree"),
    (5, 20, 12.0, 2.0, "agree"), (5, 20, 5.5, 1.0, "undecided"), (5, 20, 4.0, 0.4, "disagree"),
]  # fmt: skip


def paired(one, other, ratio=False, across=None, gestures=(None, None)):
    """Compare figures by seed, as dictionaries."""
    samples = [pd.Series(each, dtype=float) for each in (one, other)]
    devices = across and tuple(pd.Series(each, dtype=float) for each in across)
    return compare_samples(*samples, ratio, devices, gestures)


def test_a_paired_difference_is_that_of_the_paired_t_test():
    one, other = {"0": 71.0, "1": 74.5, "2": 70.2, "3": 79.0}, {"0": 70.0, "1": 71.0, "2": 70.4, "3": 75.0}
    found = paired(one, other)
    assert found.mean / found.error == pytest.approx(ttest_rel([*one.values()], [*other.values()]).statistic)
    assert (found.mean, found.seeds) == (pytest.approx(2.075), 4)


def test_a_ratio_is_taken_seed_by_seed():
    found = paired({"0": 8.0, "1": 30.0}, {"0": 2.0, "1": 5.0}, ratio=True)
    assert found == Estimate(5.0, pytest.approx(1.0), pytest.approx(12.7062), 2)
    with pytest.raises(InputError, match="a ratio needs"):
        paired({"0": 8.0}, {"0": 2.0}, ratio=True, gestures=(np.ones(2), np.ones(2)))


def test_one_seed_has_no_known_error_and_none_no_difference():
    assert paired({"0": 2.0}, {"0": 1.0}) == Estimate(1.0, math.inf, math.inf, 1)
    assert paired({"0": 2.0}, {"1": 1.0}) is None


@pytest.mark.parametrize(("minimum", "maximum", "mean", "margin", "said"), VERDICTS)
def test_a_verdict_needs_the_margin_as_room_and_three_seeds(minimum, maximum, mean, margin, said):
    statement = Statement("", "", {}, "", minimum=minimum, maximum=maximum)
    assert judge(statement, Estimate(mean, margin / 2, margin, 3)) == said
    assert judge(statement, Estimate(mean, margin / 2, margin, 2)) == "undecided"
    assert judge(statement, None) == "undecided"


def test_a_statement_about_several_holds_against_each():
    assert combine_verdicts(["agree", "agree"]) == "agree"
    assert combine_verdicts(["agree", "undecided"]) == combine_verdicts([]) == "undecided"
    assert combine_verdicts(["undecided", "agree", "disagree"]) == "disagree"


def test_the_error_is_that_of_repeated_comparisons():
    """Monte Carlo: seeds, devices and gestures drawn anew give means that spread by the error."""
    random = np.random.default_rng(1)
    means, errors = [], []
    for _ in range(400):
        parts = [
            scale * random.standard_normal((2, *shape))
            for scale, shape in ((0.4, (5, 1, 1)), (0.5, (1, 4, 1)), (3.0, (1, 1, 100)), (1.0, (5, 4, 100)))
        ]
        one, other = sum(parts) + np.array([8.0, 20.0]).reshape(2, 1, 1, 1)
        seeds, devices = (
            [pd.Series(each.mean(axis=axes)) for each in (one, other)] for axes in ((1, 2), (0, 2))
        )
        gestures = one.mean(axis=(0, 1)), other.mean(axis=(0, 1))
        found = compare_samples(*seeds, False, tuple(devices), gestures)
        means.append(found.mean)
        errors.append(found.error)
    assert np.mean(means) == pytest.approx(-12, abs=0.05)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(means), rel=0.12)


def test_gestures_that_are_not_the_same_are_not_paired():
    seeds = {"0": 3.0, "1": 3.0}, {"0": 1.0, "1": 1.0}
    found = paired(*seeds, gestures=(np.array([1.0, 2.0, 3.0, np.nan]), np.array([0.0, 2.0])))
    assert found.error == pytest.approx(math.sqrt(1 / 3 + 2 / 2))
    same = np.array([1.0, 2.0, 9.0, np.nan])
    assert paired(*seeds, gestures=(same, same + 1)).error == 0
