"""What a study found: figures by seed, comparisons, verdicts and differences."""

import pandas as pd
import pytest

from experiments.studies.comparison import conclude, differences
from experiments.studies.study import Statement, Study

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
    outcome = conclude(fields, found)
    (compared,) = outcome.compared.values()
    assert (compared.mean, outcome.verdict) == (pytest.approx(mean), verdict)


def test_a_statement_may_be_about_a_condition():
    here = trials("max", 0.8, 0.8, 0.8, condition="none")
    here += trials("max", 0.7, 0.7, 0.7, condition="5 dead")
    one = Statement("x", "x", {"condition": "5 dead"}, ACCURACY, others=[{"condition": "none"}], maximum=0)
    outcome = conclude(one, pd.DataFrame(here))
    assert (list(outcome.compared), outcome.verdict) == (["pooling=max, none"], "agree")


def test_conditions_are_compared_over_devices_of_several_trainings():
    """By hand: device n loses n + 2 per cent with a dead sensor, whatever the training."""
    found = []
    for condition, loss, more in (("0 dead", 0.0, 0.0), ("1 dead", 0.02, 0.01)):
        for n in range(3):
            lost = loss + more * n
            found += trials("max", 0.8 - lost, 0.9 - lost, condition=condition, device=str(n))
    given = study(devices=3, conditions={"0 dead": {}, "1 dead": {}}, differences="greater")
    ((_, condition, compared, verdict),) = differences(given, pd.DataFrame(found))
    assert (condition, verdict, compared.seeds) == ("1 dead", "worse", 3)
    # losses 2, 3 and 4: mean 3, deviation 1, by the root of 3
    assert compared[:2] == (pytest.approx(-3), pytest.approx(3**-0.5))
