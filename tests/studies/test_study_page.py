"""A study's tables say what was found, in files and on a narrow terminal."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from experiments.studies import pages
from experiments.studies.comparison import Conclusion, Estimate
from experiments.studies.measures import Streams, streams_frame
from experiments.studies.pages import Page, publish_measured, read_reference
from experiments.studies.study import Statement, Study
from skin.errors import InputError
from skin.evaluation.metrics import encode
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.streams import Alarms, Bin, WindowReport
from skin.touch.labels import TOUCH

LABELS = ("overall", "big", "dynamic", "press", "dangerous")
METRICS = [f"same/{label}/accuracy" for label in LABELS]
METRICS += [f"same/dangerous/{name}" for name in ("alarm_recall", "false_alarm_rate")]
METRICS += ["seconds_per_epoch", "parameters"]
TIME = {"metric": "seconds_per_epoch"}
COMPARED = [
    ({}, [Estimate(12.345, 0.3, 1.356, 3)], "+12.3 ± 1.4 points"),
    ({}, [Estimate(-1, 0.5, 1, 3), Estimate(2, 0.5, 1, 3)], "-1.0 ± 1.0 points (a); +2.0 ± 1.0 points (b)"),
    ({}, [Estimate(1.0, float("inf"), float("inf"), 1)], "+1.0 points"),
    ({}, [None], "no paired runs"),
    (TIME, [Estimate(-0.12, 0.01, 0.02, 3)], "-0.12 ± 0.02 s"),
    (TIME | {"ratio": True}, [Estimate(4.44, 0.1, 0.2, 3)], "4.44 ± 0.20 times"),
]


def trial(name, seed, accuracy, **more):
    metrics = {}
    if accuracy is not None:
        metrics = {f"same/{label}/accuracy": accuracy for label in LABELS}
        metrics |= {"same/dangerous/alarm_recall": 0.25, "same/dangerous/false_alarm_rate": 0.02}
        metrics |= {"seconds_per_epoch": 1.5, "parameters": 105621.0}
    row = {"variant": name, "seed": seed, "chosen": {"weight": name}, "condition": "", "device": ""}
    row |= {"row": "", "simulator": "", "cannot": (), "outcomes": None, "run": "abc" if metrics else ""}
    return row | metrics | more


TRIALS = ("exp", "0", 0.8), ("exp", "1", 0.9), ("none", "0", None), ("none", "1", 0.7), ("rigid", "0", None)
FOUND = pd.DataFrame([trial(f"weight={weight}", seed, accuracy) for weight, seed, accuracy in TRIALS])
SAID = Statement("x", "one [sic] beats the other", {"weight": "weight=exp"}, METRICS[0], "3.2.2",
                 [{"weight": "weight=none"}], minimum=0)  # fmt: skip
STUDY = Study("edges", "edges", [0, 1], rows="all", metrics=METRICS, statements=[SAID])


def table(trials, *settings):
    shown = pages.variants_table(pd.DataFrame(trials), *settings)
    return [list(shown.columns), *shown.to_numpy().tolist()]


def test_a_line_per_variant_with_mean_and_margin():
    head, first, second, third = table(FOUND, METRICS)
    # of 0.8 and 0.9: mean 0.85, standard error 0.05, and 12.71 of them with one degree of freedom
    names = ["variant", "overall", "recall", "false alarms", "s/epoch", "parameters"]
    values = ["weight=exp", "85.0 ± 63.5", "25.0 ± 0.0", "2.0 ± 0.0", "1.50", "105621"]
    assert [dict(zip(head, first, strict=True))[name] for name in names] == values
    assert second[:2] == ["weight=none (1 failed)", "70.0"]
    assert third[:2] == ["weight=rigid (1 failed)", "failed"]


def under_conditions(name):
    conditions = product(("none", "5 dead"), (0, 1))
    return [trial(name, "0", 0.8 + n / 10, condition=one, device=str(n)) for one, n in conditions]


@pytest.mark.parametrize(
    ("variants", "head", "names"),
    [("ab", ["variant", "none", "5 dead"], ["a", "b"]), ("a", ["a", "overall", "big"], ["none", "5 dead"])],
)
def test_conditions_are_columns_or_lines_of_a_single_variant(variants, head, names):
    trials = [each for name in variants for each in under_conditions(name)]
    cells = ["85.0 ± 63.5", "85.0 ± 63.5"]
    assert table(trials, METRICS[:2]) == [head, *([name, *cells] for name in names)]


@pytest.mark.parametrize(("fields", "compared", "text"), COMPARED)
def test_what_was_measured_has_its_unit(fields, compared, text):
    said = Statement(**vars(SAID) | fields)
    named = dict(zip("ab", compared, strict=False))
    assert pages.comparison_text(Conclusion(said, named, "undecided")) == text


def test_files_and_terminal_say_the_same(tmp_path, capsys):
    pages.publish_study(STUDY, "edges, little [data]", FOUND, tmp_path / "study_edges")
    page = (tmp_path / "study_edges.md").read_text()
    assert page.splitlines()[0] == "# edges, little [data]"
    assert "| 3.2.2 | one [sic] beats the other | +20.0 points | undecided |" in page
    assert page.count("\n| weight=") == 3
    parts, text = ("85.0 ± 63.5", "105621", "weight=rigid (1 failed)", "[sic]"), capsys.readouterr().out
    assert all(part in text for part in parts)
    read = pd.read_csv(tmp_path / "study_edges.csv")
    assert read.variant.tolist() == ["weight=exp", "weight=exp", "weight=none"]
    assert read[["seed", "same/overall/accuracy"]].to_numpy().tolist() == [[0, 0.8], [1, 0.9], [1, 0.7]]
    with Image.open(tmp_path / "study_edges.png") as picture:
        assert picture.size[0] > 500


@pytest.mark.parametrize("single", [False, True])
def test_an_axis_draws_lines_over_the_numbers_in_the_names(single):
    numbers = {4: 0.9, 25: 0.97, 9: 0.95}
    found = [
        trial("any", "0", fraction, condition=f"grid {n}") if single else trial(f"grid {n}", "0", fraction)
        for n, fraction in numbers.items()
    ]
    for name in ("other", "equation 10"):  # no number, and a single one
        found += [trial("any" if single else name, "0", 0.5, condition=name if single else "")]
    (axis,) = pages.study_figure(replace(STUDY, axis="number of sensors"), pd.DataFrame(found)).axes
    (line,) = axis.containers
    assert line[0].get_xdata().tolist() == [4, 9, 25]
    assert line[0].get_ydata().tolist() == pytest.approx([90, 95, 97])
    assert (line.get_label(), axis.get_xlabel()) == ("grid", "number of sensors")


def test_tables_of_several_runs_become_one(tmp_path):
    pages = [Page("", {}, pd.DataFrame([{"course": "hold, 1 s", "alarms": n}])) for n in range(2)]
    rows = [trial("a", str(n), None, run=f"run{n}", page=page) for n, page in enumerate([*pages, Page("")])]
    path, trials = tmp_path / "study_edges", pd.DataFrame(rows)
    assert publish_measured(STUDY, trials[1:], path) == [], "one table needs no other"
    assert publish_measured(STUDY, trials, path) == [path.with_suffix(".csv")]
    lines = ["variant,seed,run,course,alarms", 'a,0,run0,"hold, 1 s",0', 'a,1,run1,"hold, 1 s",1']
    assert path.with_suffix(".csv").read_text().splitlines() == lines


def test_a_study_without_runs_writes_the_rows_of_all_conditions(tmp_path):
    pages = [Page("said", {}, pd.DataFrame([{"set": name, "value": n}])) for n, name in enumerate("ab")]
    paths = publish_measured(replace(STUDY, rows=None), pd.DataFrame({"page": pages}), tmp_path / "edges")
    assert [path.name for path in paths] == ["edges.md", "edges.csv"]
    assert paths[1].read_text() == "set,value\na,0\nb,1\n"
    assert "| b | 1 |" in paths[0].read_text()
    assert "\nsaid\nsaid\n" in paths[0].read_text()


def reported(name, accuracy, simulator="fem", **more):
    return trial(name, "0", accuracy, row=name, simulator=simulator, **more)


def test_the_reports_number_stands_where_it_has_one():
    reference = {("temporal_graph", "fem", "overall"): 0.732}
    metrics = [*METRICS[:2], "unseen_layout/overall/accuracy", "device_shift/overall/accuracy"]
    runs = [reported("temporal_graph", 0.8, cannot=["unseen_layout"]), reported("gru", 0.9)]
    first = ["temporal_graph", "80.0 (73.2)", "80.0", "cannot", ""]
    assert table(runs, metrics, reference)[1:] == [first, ["gru", "90.0", "90.0", "", ""]]


def test_the_margin_is_also_one_over_gestures():
    """By hand: half of 100 gestures have one of four labels wrong."""
    half, right = np.repeat(np.array([0, 1], dtype=np.uint8), 50), np.zeros(100, dtype=np.uint8)
    # a standard deviation of 0.125 sqrt(100 / 99) over gestures, by sqrt(100); 1.984 of them
    for codes, accuracy, text in ((half, 0.875, "87.5 ± 2.5"), (right, 1.0, "100.0 ± 0.0")):
        trials = [reported("rules", accuracy, outcomes=codes.tobytes())]
        assert table(trials, METRICS[:1])[1] == ["rules", text]


def test_the_csv_has_the_reference_and_another_file_may_be_chosen(tmp_path):
    path = tmp_path / "report.csv"
    path.write_text("row,simulator,label,value\ngru,fem,overall,0.5\n")
    study = replace(STUDY, reference=str(path), statements=())
    trials = pd.DataFrame([reported("gru", 0.9), reported("rules", 0.8)])
    pages.publish_study(study, "t", trials, tmp_path / "s")
    assert pd.read_csv(tmp_path / "s.csv", keep_default_na=False).reference.tolist() == ["0.5", ""]
    with pytest.raises(InputError, match=r"study\.reference=nowhere"):
        read_reference("nowhere")


NAMES = ("big", "dynamic", "press", "dangerous")
HALF, MORE, MOST = (dict.fromkeys(NAMES, fraction) for fraction in (0.5, 0.625, 0.9))
STREAMED = WindowReport(
    bins=[Bin("0-0.2", 40, HALF, MORE), Bin("whole", 160, MOST, HALF)],
    gates={"threshold": torch.tensor([[90, 10], [20, 180]])},
    threshold=0.31,
    alarms={"none": Alarms(0.5, 3, 8, 7, 9, 1), "threshold": Alarms(0.5, 0, 8, 6, 9, 0)},
    hours=0.6,
    lengths={2.0: 0.8125, 6.0: "made for 30"},
    point=OperatingPoint(0.5, 0.02, 64, 1, 0),
)


def test_the_files_have_what_was_found(tmp_path):
    frame = streams_frame(STREAMED)
    about = frame.attrs["about"]
    assert about.startswith("gate none: 6.0 (1.2")
    assert "7 of 8 dangerous touches and 1 of 9 safe ones raised the alarm" in about
    page, table = pages.publish_page(Streams().page(frame, "rules"), "rules fem 0", tmp_path / "stream_rules")
    text = page.read_text()
    rows = ["press | 0.5000 | 0.9000", " | 40 | 160", "threshold | 180", "overall | 0.8125 | made for 30"]
    assert all(f"| {row} |" in text for row in rows)
    assert text.startswith("# rules fem 0\n\ngate none")
    values = pd.read_csv(table, dtype=str, keep_default_na=False).set_index(["measure", "name", "at"]).value
    assert values["accuracy", "press", "whole"] == "0.9000"
    assert values["idle said touched", "threshold", ""] == "10"
    assert values["alarms false", "none", ""] == "3"
    assert values["window, s", "overall", "6"] == "made for 30"
    assert {*tmp_path.iterdir()} == {page, table}


def outcomes(called, dangerous):
    """Return the outcomes of a run that calls each gesture dangerous or not, and is right about the rest."""
    labels = torch.zeros(len(dangerous), len(TOUCH))
    position = TOUCH.names.index("dangerous")
    labels[:, position] = torch.tensor(dangerous)
    said = labels.clone()
    said[:, position] = torch.tensor(called)
    return encode(said, labels, TOUCH)


def test_the_two_kinds_of_errors_are_shares_of_safe_and_of_dangerous_gestures():
    dangerous = [0.0] * 8 + [1.0] * 4
    first = outcomes([1.0] * 4 + [0.0] * 4 + [1.0] * 4, dangerous)  # half of the safe ones
    second = outcomes([1.0] * 4 + [0.0] * 5 + [1.0] * 3, dangerous)  # and one of four dangerous ones
    (found,) = pages.confusion_rows({"gru": np.array([first, second])}).to_dict("records")
    assert float(found["safe_called_dangerous"]) == 0.5
    assert float(found["dangerous_called_safe"]) == 0.125
    assert float(found["difference"]) == 0.375
    # By hand: over runs 0.5 and 0.25; over 8 safe gestures, of which 4 are wrong, and over 4 dangerous ones,
    # of which one is wrong in half of the runs.
    runs, safe, missed = 0.25**2 / 2 / 2, 0.25 * 8 / 7 / 8, 3 / 64 * 4 / 3 / 4
    assert float(found["error"]) == pytest.approx(math.sqrt(runs + safe + missed), abs=1e-4)
    # Student's quantiles of two runs, of eight and of four gestures.
    margin = math.sqrt(12.706**2 * runs + 2.3646**2 * safe + 3.1824**2 * missed)
    assert float(found["margin"]) == pytest.approx(margin, abs=1e-4)
