"""A study's tables say what was found, in files and on a narrow terminal."""

import csv
import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from studies.findings import Finding, Outcome
from studies.study import Paired, Statement, Variant
from studies.study_table import as_csv, measured, page, show, variants


def run(accuracy):
    labels = ("overall", "big", "dynamic", "press", "dangerous")
    metrics = {f"same/{label}/accuracy": accuracy for label in labels}
    metrics |= {
        "same/dangerous/alarm_recall": 0.25,
        "same/dangerous/false_alarm_rate": 0.02,
        "seconds_per_epoch": 1.5,
        "parameters": 105621.0,
    }
    return SimpleNamespace(data=SimpleNamespace(metrics=metrics), info=SimpleNamespace(run_id="abc"))


FOUND = [
    Finding(
        Variant("weight=exp", {}, {"0": None, "1": None}), {"0": run(0.8), "1": run(0.9)}, {"self": "0.31"}
    ),
    Finding(Variant("weight=none", {}, {"0": None, "1": None}), {"1": run(0.7)}),
    Finding(Variant("weight=stiffness", {}, {"0": None}), {}),
]
SAID = Statement("x", "3.2.2", "one [sic] beats the other", {}, "same/overall/accuracy", "greater")
OUTCOMES = [Outcome(SAID, {"weight=none": Paired(12.345, 0.678, 3)}, "agree")]


def test_a_line_per_variant_with_mean_and_deviation():
    head, first, second, third = variants(FOUND)
    # of 0.8 and 0.9: mean 0.85, sample deviation 0.1 / sqrt 2
    assert dict(zip(head, first, strict=True)) | {"big": "", "dynamic": "", "press": "", "dangerous": ""} == {
        "variant": "weight=exp",
        "overall": "85.0 ± 7.1",
        "big": "",
        "dynamic": "",
        "press": "",
        "dangerous": "",
        "recall": "25.0 ± 0.0",
        "false alarms": "2.0 ± 0.0",
        "s/epoch": "1.50",
        "parameters": "105621",
        "self": "0.31",
    }
    assert second[:2] == ["weight=none (1 failed)", "70.0"]
    assert third[:2] == ["weight=stiffness (1 failed)", "failed"]


@pytest.mark.parametrize(
    ("fields", "compared", "text"),
    [
        ({}, {"a": Paired(12.345, 0.678, 3)}, "+12.3 ± 0.7 points"),
        (
            {},
            {"a": Paired(-1.0, 0.5, 3), "b": Paired(2.0, 0.5, 3)},
            "-1.0 ± 0.5 points (a); +2.0 ± 0.5 points (b)",
        ),
        ({}, {"a": Paired(1.0, float("inf"), 1)}, "+1.0 points"),
        ({}, {"a": None}, "no paired runs"),
        ({"metric": "seconds_per_epoch", "claim": "less"}, {"a": Paired(-0.12, 0.01, 3)}, "-0.12 ± 0.01 s"),
        ({"metric": "seconds_per_epoch", "claim": "ratio"}, {"a": Paired(4.44, 0.1, 3)}, "4.4 ± 0.1 times"),
    ],
)
def test_what_was_measured_has_its_unit(fields, compared, text):
    said = Statement(**{"id": "x", "section": "", "says": "", "one": {}, **vars(SAID), **fields})
    assert measured(Outcome(said, compared, "undecided")) == text


def test_a_page_holds_both_tables():
    lines = page("study", FOUND, OUTCOMES).splitlines()
    assert lines[0] == "# study"
    assert "| 3.2.2 | one [sic] beats the other | +12.3 ± 0.7 points | agree |" in lines
    assert len([line for line in lines if line.startswith("| weight=")]) == 3


def test_csv_has_a_line_per_run():
    read = list(csv.DictReader(io.StringIO(as_csv(FOUND))))
    assert [(line["variant"], line["seed"], line["same/overall/accuracy"]) for line in read] == [
        ("weight=exp", "0", "0.8"),
        ("weight=exp", "1", "0.9"),
        ("weight=none", "1", "0.7"),
    ]


def test_a_narrow_terminal_cuts_no_number_short():
    console = Console(width=40, file=io.StringIO())
    show("study", FOUND, OUTCOMES, console)
    text = console.file.getvalue()
    assert all(
        part in text for part in ("85.0 ± 7.1", "105621", "weight=stiffness (1 failed)", "[sic]", "agree")
    )
    assert "…" not in text
