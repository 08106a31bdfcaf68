"""The table says what the runs say: means, deviations, failures, the report's numbers beside ours."""

import csv
import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from experiments.studies.comparison import Uncertainty, estimate
from experiments.studies.results_table import (
    COLUMNS,
    LABELS,
    Cell,
    display_rows,
    print_results,
    report_values,
    result_rows,
    results_csv,
)
from experiments.studies.tables import markdown
from skin.files import write
from skin.paths import CONF, ROOT

REPORT = {("temporal_graph", "fem", "overall"): 0.732, ("temporal_graph", "fem", "big"): 0.646}


def run(same, shifted=None, recall=0.5):
    """Return what the table reads of an MLflow run whose four labels are equally good."""
    labels = ("overall", "big", "dynamic", "press", "dangerous")
    metrics = {f"same/{label}/accuracy": same for label in labels}
    metrics |= {
        "same/dangerous/alarm_recall": recall,
        "same/dangerous/false_alarm_rate": 0.021,
        "seconds_per_epoch": 2.0,
        "parameters": 145774.0,
    }
    if shifted is not None:
        metrics["device_shift/overall/accuracy"] = shifted
    return SimpleNamespace(data=SimpleNamespace(metrics=metrics, tags={}))


@pytest.fixture
def lines():
    cells = [
        Cell("temporal_graph", "fem", (run(0.8, 0.7), run(0.9, 0.5)), 0),
        Cell("linked_graph", "naive", (), 2),
    ]
    return {(line["row"], line["label"]): line for line in result_rows(cells, REPORT)}


def test_ours_is_mean_and_standard_error_over_seeds(lines):
    line = lines["temporal_graph", "overall"]
    # of 0.8 and 0.9: mean 0.85, sample deviation 0.1 / sqrt(2), by sqrt(2)
    assert (line["ours"], line["ours_error"], line["device_shift"]) == ("0.850000", "0.050000", "0.600000")


def test_the_error_is_also_one_over_gestures():
    """By hand: half of 100 gestures have one of four labels wrong in both runs."""
    codes = np.repeat(np.array([0, 1], dtype=np.uint8), 50)
    cell = Cell("rules", "fem", (run(0.875), run(0.875)), 0, (codes, codes))
    (line, *_) = result_rows([cell], {})
    # a standard deviation of 0.125 sqrt(100 / 99) over gestures, by sqrt(100)
    assert (line["ours"], line["ours_error"]) == ("0.875000", "0.012563")
    # 1.984 standard errors with 99 degrees of freedom
    assert display_rows(result_rows([cell], {}))[1][2] == "87.5 ± 2.5"
    assert float(line["ours_margin"]) == pytest.approx(1.98422 * 0.012563, abs=2e-6)


@pytest.mark.parametrize(
    ("row", "overall", "gestures", "margin"),
    [
        ("features", (0.9685624987, 0.9671875089, 0.9696249962), 0.0011895, 0.0038),
        ("sequence_image", (0.8360625058, 0.8515625, 0.8457499892), 0.0020765, 0.0199),
    ],
)
def test_the_margin_of_three_published_seeds_is_that_of_students_distribution(row, overall, gestures, margin):
    """The published rows: features had ± 0.28 points with two standard errors, sequence_image ± 1.0."""
    found = estimate(dict(enumerate(overall)), {}, None)
    assert found.margin == pytest.approx(4.30265 * found.error, rel=1e-5)
    both = Uncertainty.together(Uncertainty(*found[1:]), Uncertainty(gestures, 1.9606 * gestures))
    assert both.margin == pytest.approx(margin, abs=5e-5), row


def test_a_number_is_rounded_once():
    cell = Cell("features", "fem", (run(0.96846), run(0.96846)), 0)
    assert display_rows(result_rows([cell], {}))[1][2] == "96.8 ± 0.0"


def test_one_seed_has_no_deviation():
    (line, *_) = result_rows([Cell("rules", "fem", (run(0.8),), 0)], {})
    assert (line["ours"], line["ours_error"], line["report"]) == ("0.800000", "", "")


def test_the_reports_number_stands_where_it_has_one(lines):
    assert lines["temporal_graph", "overall"]["report"] == "0.732"
    assert lines["temporal_graph", "press"]["report"] == ""


def test_a_row_without_a_finished_run_shows_as_failed(lines):
    assert {lines["linked_graph", label]["ours"] for label in LABELS} == {"failed"}
    assert "failed" in markdown(display_rows(list(lines.values())), "x").splitlines()[-1]


def test_a_row_that_misses_a_seed_says_so():
    lines = result_rows([Cell("rules", "fem", (run(0.8), run(0.9)), 1)], {})
    assert {line["failed"] for line in lines} == {"1"}
    assert display_rows(lines)[1][0] == "rules (1 failed)"


def test_a_row_that_takes_no_other_layout_says_so():
    fixed = run(0.8, 0.7)
    fixed.data.tags["cannot_unseen_layout"] = "readings are of 25 sensors in this order"
    (line, *_) = result_rows([Cell("mlp", "fem", (fixed,), 0)], {})
    assert (line["device_shift"], line["unseen_layout"]) == ("0.700000", "cannot")


def test_the_alarm_has_its_recall_and_its_false_alarms_side_by_side(lines):
    assert lines["temporal_graph", "dangerous_recall"]["ours"] == "0.500000"
    assert lines["temporal_graph", "false_alarms"]["ours"] == "0.021000"
    head, first, _ = display_rows(list(lines.values()))
    place = head.index("recall")
    assert head[place + 1] == "false alarms"
    assert first[place : place + 2] == ["50.0 ± 0.0", "2.1 ± 0.0"]


def test_other_devices_have_their_own_recall_and_false_alarms():
    one = run(0.8, 0.7)
    one.data.metrics |= {
        "device_shift/dangerous/alarm_recall": 0.4,
        "device_shift/dangerous/false_alarm_rate": 0.048,
    }
    head, first = display_rows(result_rows([Cell("features", "fem", (one,), 0)], {}))
    place = head.index("device shift")
    assert head[place : place + 3] == ["device shift", "its recall", "its false alarms"]
    assert first[place : place + 3] == ["70.0", "40.0", "4.8"]


def test_what_is_undefined_is_no_number():
    """A run without dangerous test gestures has no recall; it did not fail either."""
    one = run(0.8)
    del one.data.metrics["same/dangerous/alarm_recall"]
    lines = result_rows([Cell("features", "fem", (one,), 0)], {})
    assert next(line["ours"] for line in lines if line["label"] == "dangerous_recall") == ""
    head, first = display_rows(lines)
    assert first[head.index("recall")] == "-"


def test_a_person_reads_ours_with_the_reports_in_brackets(lines):
    head, first, _ = display_rows(list(lines.values()))
    assert dict(zip(head, first, strict=True))["overall"] == "85.0 ± 63.5 (73.2)"


def test_csv_has_the_columns_and_reads_back(lines):
    read = list(csv.DictReader(io.StringIO(results_csv(list(lines.values())))))
    assert tuple(read[0]) == COLUMNS
    assert read == list(lines.values())


def test_a_file_is_written_whole_and_leaves_nothing_beside_it(tmp_path):
    write("old", tmp_path / "new" / "table.md")
    write("new", tmp_path / "new" / "table.md")
    assert [path.read_text() for path in (tmp_path / "new").iterdir()] == ["new"]


def test_the_reports_numbers_belong_to_rows_of_the_table():
    known = report_values(ROOT / "data" / "report_table.csv")
    rows_of_table = {path.stem for path in (CONF / "experiment").glob("*.yaml")}
    assert {row for row, _, _ in known} <= rows_of_table
    assert known["sequence_image", "fem", "overall"] == 0.771
    assert all(0 <= value <= 1 for (_, _, label), value in known.items() if label in LABELS)


@pytest.mark.parametrize("row", ["temporal_graph", "sequence_graph", "sequence_image"])
def test_the_reports_overall_is_the_mean_of_its_labels(row):
    known = report_values(ROOT / "data" / "report_table.csv")
    each = [known[row, "fem", label] for label in ("big", "dynamic", "press", "dangerous")]
    assert known[row, "fem", "overall"] == pytest.approx(sum(each) / 4, abs=2e-3)


def test_a_table_tells_its_budget():
    cell = Cell("rules", "fem", (run(0.8),), 0)
    assert {line["budget"] for line in result_rows([cell], {}, "smoke")} == {"smoke"}


def test_no_number_is_cut_on_a_narrow_terminal():
    line = dict.fromkeys(COLUMNS, "0.1234") | {"row": "temporal_graph", "simulator": "naive", "failed": "0"}
    lines = [
        line | {"label": label, "ours_error": "0.0123", "ours_margin": "0.0246", "report": "0.85"}
        for label in LABELS
    ]
    seen = io.StringIO()
    print_results(lines, "title", Console(file=seen, width=40))
    text = seen.getvalue()
    assert "…" not in text
    assert "12.3 ± 2.5 (85.0)" in text
    assert all(head in text for head in ("overall", "recall", "false", "dev.", "lay."))
    # A temporal_graph of one seed, with the report's number, fits 80 columns.
    line |= {"ours_error": "", "ours_margin": ""}
    seen = io.StringIO()
    print_results([line | {"label": label} for label in LABELS], "title", Console(file=seen, width=40))
    assert max(map(len, seen.getvalue().splitlines())) <= 80
