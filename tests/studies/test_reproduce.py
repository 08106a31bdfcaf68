"""The page of the statements is that of the committed statements and results."""

from dataclasses import replace

import pytest

from experiments.studies.comparison import conclude
from experiments.studies.reproduce import every_study, methods_figure, published_trials, reproduce_page
from experiments.studies.study import Statement
from skin.core.files import ROOT


def test_the_committed_page_is_what_the_committed_files_say():
    """``python -m experiments.studies.reproduce`` writes it."""
    assert (ROOT / "docs" / "reproduce.md").read_text() == reproduce_page()


def test_the_figure_has_every_method_with_the_published_values():
    accuracy, recall = methods_figure().axes
    names = [text.get_text() for text in accuracy.get_yticklabels()]
    ends = {
        name: bar.lines[2][0].get_segments()[0][:, 0].tolist()
        for name, bar in zip(names, accuracy.containers, strict=True)
    }
    assert len(names) == len(recall.containers) == 8
    # 86.2 ± 0.9 in docs/results.md; the binomial interval is rather wide
    assert ends["temporal_graph (report)"] == pytest.approx([86.2 - 1.3, 86.2 + 1.3], abs=0.2)
    assert all(end <= 100 for pair in ends.values() for end in pair)


def test_every_statement_is_on_the_page():
    text = (ROOT / "docs" / "reproduce.md").read_text()
    for command, study in dict(every_study()).values():
        if study.statements:
            assert f"`{command}`" in text
            for statement in () if published_trials(study.name).empty else study.statements:
                assert f"| {statement.says}" in text


def test_a_margin_over_gestures_counts():
    trials = published_trials("sensors")
    one, other = ({"name": name, "condition": "above a sensor"} for name in ("placed 16", "grid 25"))
    statement = Statement("a", "b", one, "same/overall/accuracy", others=[other])
    (narrow,) = conclude(statement, trials).compared.values()
    # just beyond the margin over trainings
    statement = replace(statement, minimum=narrow.mean + 1.01 * narrow.margin)
    sure, wide = conclude(statement, trials), conclude(replace(statement, over_gestures=0.2), trials)
    (margin,) = wide.compared.values()
    assert (sure.verdict, wide.verdict) == ("disagree", "undecided")
    assert margin.margin == pytest.approx((narrow.margin**2 + 0.2**2) ** 0.5)
    assert margin.mean == narrow.mean


def test_devices_of_one_training_are_the_sample():
    assert {*published_trials("dead").seed} == {"1", "2", "3", "4", "5"}
    assert {*published_trials("layouts").seed} == {"0", "1", "2"}
    assert published_trials("nothing").empty
