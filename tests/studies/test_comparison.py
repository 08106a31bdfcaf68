"""Verdicts follow from intervals over paired seeds, and what a study concludes from them."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy.stats import ttest_rel

from experiments.studies import comparison
from experiments.studies.comparison import Estimate, judge
from experiments.studies.study import Statement, Study
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
    return comparison.compare_samples(*samples, ratio, devices, gestures)


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
    combine = comparison.combine_verdicts
    assert combine(["agree", "agree"]) == "agree"
    assert combine(["agree", "undecided"]) == combine([]) == "undecided"
    assert combine(["undecided", "agree", "disagree"]) == "disagree"


def test_the_error_is_that_of_repeated_comparisons():
    """Monte Carlo: seeds, devices and gestures drawn anew give means that spread by the error."""
    random = np.random.default_rng(1)
    means, errors = [], []
    for _ in range(400):
        parts = [
            scale * random.standard_normal((2, *shape))
            for scale, shape in ((0.4, (5, 1, 1)), (0.5, (1, 4, 1)), (3.0, (1, 1, 100)), (1.0, (5, 4, 100)))
        ]
        one, other = both = sum(parts) + np.array([8.0, 20.0]).reshape(2, 1, 1, 1)
        seeds, devices = ([pd.Series(one.mean(axis=axes)) for one in both] for axes in ((1, 2), (0, 2)))
        gestures = one.mean(axis=(0, 1)), other.mean(axis=(0, 1))
        found = comparison.compare_samples(*seeds, False, tuple(devices), gestures)
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


ACCURACY = "same/overall/accuracy"


def trials(pooling, *accuracies, seconds=1.0, condition="", device=""):
    """Return the trials of a variant whose runs, of seeds 0, 1, ..., have these accuracies."""
    rows = []
    for seed, value in enumerate(accuracies):
        row = {"variant": f"pooling={pooling}", "chosen": {"model.pooling": pooling, "experiment": "x"}}
        row |= {"seed": str(seed), "condition": condition, "device": device, "run": "id", "outcomes": None}
        rows.append(row | {ACCURACY: value, "train_accuracy": 0.9, "seconds_per_epoch": seconds + seed})
    return rows


def said(*others, metric=ACCURACY, **more):
    fields = {"one": {"model.pooling": "max"}, "others": [{"model.pooling": other} for other in others]}
    return Statement(id="x", section="3.2.2", says="x", metric=metric, **fields, **more)


def study(**settings):
    return Study(**{"name": "x", "about": "x", "seeds": [0], "metrics": [ACCURACY]} | settings)


FOUND = pd.DataFrame([
    *trials("max", 0.80, 0.82, 0.81, seconds=20.0),
    *trials("mean", 0.70, 0.71, 0.72, seconds=2.0),
    *trials("attention", 0.80, 0.79, 0.83, seconds=2.0),
])  # fmt: skip


@pytest.mark.parametrize(
    ("fields", "found", "mean", "verdict"),
    [
        # differences 10, 11 and 9 points
        (said("mean", minimum=0), FOUND, 10, "agree"),
        (said("mean", metric="seconds_per_epoch", ratio=True), FOUND, (10 + 7 + 22 / 4) / 3, "agree"),
        (said(level=0.5, minimum=-2, maximum=2), pd.DataFrame(trials("max", 0.50, 0.505, 0.495)), 0, "agree"),
        (said(level=0.5, minimum=-2, maximum=2), FOUND, 31, "disagree"),
    ],
)
def test_fractions_are_compared_in_points_and_costs_as_they_are(fields, found, mean, verdict):
    outcome = comparison.conclude(fields, found)
    (compared,) = outcome.compared.values()
    assert (compared.mean, outcome.verdict) == (pytest.approx(mean), verdict)


def test_a_statement_may_be_about_a_condition():
    here = trials("max", 0.8, 0.8, 0.8, condition="none")
    here += trials("max", 0.7, 0.7, 0.7, condition="5 dead")
    one = Statement("x", "x", {"condition": "5 dead"}, ACCURACY, others=[{"condition": "none"}], maximum=0)
    outcome = comparison.conclude(one, pd.DataFrame(here))
    assert (list(outcome.compared), outcome.verdict) == (["pooling=max, none"], "agree")


def test_conditions_are_compared_over_devices_of_several_trainings():
    """By hand: device n loses n + 2 per cent with a dead sensor, whatever the training."""
    found = []
    for condition, loss, more in (("0 dead", 0.0, 0.0), ("1 dead", 0.02, 0.01)):
        for n in range(3):
            lost = loss + more * n
            found += trials("max", 0.8 - lost, 0.9 - lost, condition=condition, device=str(n))
    given = study(devices=3, conditions={"0 dead": {}, "1 dead": {}}, differences="greater")
    ((_, condition, compared, verdict),) = comparison.differences(given, pd.DataFrame(found))
    assert (condition, verdict, compared.seeds) == ("1 dead", "worse", 3)
    # losses 2, 3 and 4: mean 3, deviation 1, by the root of 3
    assert compared[:2] == (pytest.approx(-3), pytest.approx(3**-0.5))
