"""What a study found: figures by seed, comparisons, and verdicts of the report's statements."""

from types import SimpleNamespace

import pytest

from studies.findings import Finding, conclusions, graph_share
from studies.study import Statement, Variant

ACCURACY = "same/overall/accuracy"


def finding(pooling, *accuracies, seconds=1.0, planned=3):
    """Return a variant whose runs, of seed 0, 1, ..., have these accuracies and train to 90 %."""
    runs = {
        str(seed): SimpleNamespace(
            data=SimpleNamespace(
                metrics={ACCURACY: value, "train_accuracy": 0.9, "seconds_per_epoch": seconds + seed}
            )
        )
        for seed, value in enumerate(accuracies)
    }
    configs = dict.fromkeys(map(str, range(planned)))
    return Finding(
        Variant(f"pooling={pooling}", {"model.pooling": pooling, "experiment": "x"}, configs), runs
    )


def said(claim, *others, metric=ACCURACY, **more):
    fields = {"one": {"model.pooling": "max"}, "others": [{"model.pooling": other} for other in others]}
    return Statement(id="x", section="3.2.2", says="x", metric=metric, claim=claim, **fields, **more)


FOUND = [
    finding("max", 0.80, 0.82, 0.81, seconds=20.0),
    finding("mean", 0.70, 0.71, 0.72, seconds=2.0),
    finding("attention", 0.80, 0.79, 0.83, seconds=2.0),
]


def test_shares_are_compared_in_points():
    (outcome,) = conclusions([said("greater", "mean")], FOUND)
    (compared,) = outcome.compared.values()
    # differences 10, 11 and 9 points: deviation 1, by the root of 3
    assert (compared.mean, compared.error) == (pytest.approx(10.0), pytest.approx(3**-0.5))
    assert (outcome.verdict, list(outcome.compared)) == ("agree", ["pooling=mean"])


def test_a_statement_about_several_is_as_good_as_its_weakest():
    (outcome,) = conclusions([said("greater", "mean", "attention")], FOUND)
    assert (outcome.verdict, len(outcome.compared)) == ("undecided", 2)


def test_costs_are_compared_as_they_are():
    (outcome,) = conclusions([said("ratio", "mean", metric="seconds_per_epoch", by=10)], FOUND)
    (compared,) = outcome.compared.values()
    assert compared.mean == pytest.approx((20 / 2 + 21 / 3 + 22 / 4) / 3)


def test_a_gap_is_a_difference_of_two_metrics():
    gap = FOUND[0].values(f"train_accuracy - {ACCURACY}")
    assert gap == {"0": pytest.approx(0.1), "1": pytest.approx(0.08), "2": pytest.approx(0.09)}


def test_a_level_stands_for_the_other():
    (outcome,) = conclusions([said("alike", level=0.5, by=2)], [finding("max", 0.50, 0.51, 0.49)])
    (compared,) = outcome.compared.values()
    assert (compared.mean, outcome.verdict) == (pytest.approx(0.0), "agree")
    (outcome,) = conclusions([said("alike", level=0.5, by=2)], FOUND)
    assert outcome.verdict == "disagree"


def test_what_did_not_finish_is_missing_and_decides_nothing():
    partly = finding("mean", 0.70, 0.71)
    assert partly.missing == 1
    (outcome,) = conclusions([said("greater", "mean")], [FOUND[0], partly])
    assert (next(iter(outcome.compared.values())).seeds, outcome.verdict) == (2, "undecided")
    (outcome,) = conclusions([said("greater", "set2set")], FOUND)
    assert (outcome.compared, outcome.verdict) == ({"set2set": None}, "undecided")


def test_four_sensors_that_are_all_neighbours_are_a_quarter_themselves(configured):
    square = ["layout=grid", "layout.rows=2", "layout.columns=2", "representation.count=3"]
    small = ["simulator=naive", "data.gestures=10", "representation=graph", "representation.weight=none"]
    assert graph_share(configured(*square, *small)) == pytest.approx(0.25)
