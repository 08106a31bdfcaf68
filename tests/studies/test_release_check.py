"""A release check compares to the digit on the same processor, and within the spread of seeds elsewhere."""

import math

import pytest

from experiments.studies.recorded_runs import read_records, write_records
from experiments.studies.release_check import compare

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

OVERALL = "same/overall/accuracy"
SMALL = ["data.gestures=160", "device.test_gestures=64", "evaluation.devices=0", "evaluation.layouts=0",
         "evaluation.safe_gestures=64"]  # fmt: skip


def record(value, processor="here"):
    metrics = {OVERALL: value, "seconds_per_epoch": 1.0}
    return {"tags": {"processor": processor}, "metrics": metrics}


COMMITTED = {0: record(0.80), 1: record(0.82), 2: record(0.84)}


def test_the_same_processor_gives_the_same_digits_except_of_times():
    (same,) = compare(COMMITTED, 0, {OVERALL: 0.80, "seconds_per_epoch": 9.0}, "here")
    (other,) = compare(COMMITTED, 0, {OVERALL: math.nextafter(0.80, 1)}, "here")
    (none,) = compare(COMMITTED, 0, {}, "here")
    assert (same.holds, other.holds, none.holds) == (True, False, False)


@pytest.mark.parametrize(("again", "holds"), [(0.82, True), (0.73, True), (0.72, False), (0.93, False)])
def test_another_processor_gives_a_value_within_the_margin_of_another_draw(again, holds):
    """Of seeds at 80, 82 and 84 %: mean 82, deviation 2, error 2 sqrt(4 / 3) = 2.31; 4.303 of them."""
    (found,) = compare(COMMITTED, 0, {OVERALL: again}, "elsewhere")
    assert found.recorded == pytest.approx(0.82)
    assert found.allowed == pytest.approx(4.3027 * 0.02 * math.sqrt(4 / 3), rel=1e-4)
    assert found.holds == holds


def test_a_metric_that_is_missing_differs():
    (found,) = compare(COMMITTED, 0, {}, "elsewhere")
    assert not found.holds


@pytest.mark.slow
def test_the_check_trains_again_and_tells_what_differs(run, tmp_path):
    table = ["table.simulators=[naive]", "table.seeds=2", "experiment=rules", *SMALL, "out=docs"]
    file = ["results.file=runs.parquet", "out=docs"]
    done = [run(tmp_path, "table", *table), run(tmp_path, "results", "results.action=export", *file)]
    assert [one.returncode for one in done] == [0, 0], [one.stderr for one in done]
    check = ["results.action=check", "results.check.simulator=naive", "results.check.rows=[rules]", *file]
    same = run(tmp_path, "results", *check, *SMALL, store=False)
    assert same.returncode == 0, same.stdout + same.stderr
    assert "as recorded" in same.stdout
    path = tmp_path / "runs.parquet"
    records = read_records(path)
    for one in records:
        one["metrics"][OVERALL] -= 0.2
    write_records(records, path)
    other = run(tmp_path, "results", *check, *SMALL, store=False)
    assert other.returncode == 1, other.stdout + other.stderr
    assert other.stdout.count("DIFFERS") == 1
    unknown = run(tmp_path, "results", *check, *SMALL, "results.check.rows=[gru]", store=False)
    assert (unknown.returncode, unknown.stderr.count("\n")) == (2, 1), unknown.stderr
    assert "the check needs two" in unknown.stderr
