"""Every column is what it says: the same device, unseen devices, unseen layouts, the budget's last tenth."""

import io
from dataclasses import replace
from types import SimpleNamespace

import pandas as pd
import pytest
import torch
from rich.console import Console

from skin.errors import InputError
from skin.evaluation import report
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.report import ALARM_NAME, evaluate
from skin.evaluation.report import print_report as show
from skin.evaluation.settings import Evaluation
from skin.runs.build import build_device
from skin.touch.labels import TOUCH

SETTINGS = Evaluation(devices=2, layouts=2, false_alarm_rate=0.02)
POINT = OperatingPoint(0.5, 0.02, 64, 1, 0)


class Knows:
    """Answers with the labels, and remembers what it was asked about; refuses other layouts if told so."""

    def __init__(self, home=None):
        self.home, self.asked = home, []

    def probabilities(self, touches):
        if self.home is not None and not torch.equal(touches.positions, self.home):
            raise InputError("another layout")
        self.asked.append(touches)
        return touches.labels * 0.8 + 0.1


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "data.gestures=80", "device.test_gestures=48"))


@pytest.fixture(scope="module")
def tried(device):
    learner = Knows()
    return evaluate(learner, device, SETTINGS, POINT), learner.asked


def test_the_columns_are_shown_while_they_are_evaluated(device, monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr("skin.evaluation.report.CONSOLE", Console(file=file, force_terminal=True, width=80))
    evaluate(Knows(), device, SETTINGS, POINT)
    assert "device_shift" in file.getvalue()


def test_who_knows_the_labels_is_right_everywhere(tried):
    found = tried[0].metrics
    assert [len(touches) for touches in tried[1]] == [48, 8, 24, 24, 24, 24]
    assert tried[0].confusion.sum(dim=(1, 2)).tolist() == [48] * 4
    assert tried[0].confusion[:, 0, 1].tolist() == [0] * 4
    for column in ("same", "holdout", "device_shift", "unseen_layout"):
        assert found[f"{column}/overall/accuracy"] == 1
        assert found[f"{column}/dangerous/alarm_recall"] == 1
        assert found[f"{column}/dangerous/false_alarm_rate"] == 0


def test_unseen_devices_share_the_gestures_each_in_its_own_way(device, tried):
    same, _, first, second, *_ = tried[1]
    for number, other in enumerate((first, second)):
        assert torch.equal(other.positions, same.positions)
        assert torch.equal(other.labels, same.labels[number::2])
        own = device.replace(seed=1 + number).touches("test")
        assert torch.equal(other.readings, own.readings[number::2])
        assert not torch.equal(other.readings, same.readings[number::2])


def test_unseen_layouts_lean_as_the_known_one_does(configured):
    """As a layout of that seed and tilt does, and unlike one whose sensors face the surface."""
    solid = "simulator=solid", "simulator.divisions=1", "body.cells=[8,8]", "data.gestures=10"
    scattered = "layout=scattered", "layout.rows=3", "layout.columns=4", "device.test_gestures=16"
    known = build_device(configured(*solid, *scattered, "layout.tilt=0.5"))
    settings = replace(SETTINGS, layouts=1)
    (unseen,) = report.touch_sets(known, settings)["unseen_layout"]
    for tilt, same in ((0.5, True), (0.0, False)):
        other = configured(*solid, *scattered, f"layout.tilt={tilt}", "layout.seed=101")
        touches = build_device(other).touches("test")
        assert torch.equal(touches.positions, unseen.positions)
        assert torch.equal(touches.readings, unseen.readings) == same


def test_an_unseen_layout_has_as_many_sensors_elsewhere(tried):
    same, _, _, _, first, second = tried[1]
    assert first.positions.shape == second.positions.shape == same.positions.shape
    moved = (first.positions - same.positions).norm(dim=1)
    assert moved.max() > 1e-3
    assert not torch.equal(first.positions, second.positions)


def test_who_cannot_take_another_layout_says_so(device):
    found = evaluate(Knows(device.touches("test").positions), device, SETTINGS, POINT)
    assert found.unavailable == {"unseen_layout": "another layout"}
    assert not [name for name in found.metrics if name.startswith("unseen_layout")]
    assert found.metrics["device_shift/overall/accuracy"] == 1


def test_predictions_tell_of_every_test_gesture(device, tried):
    table = tried[0].predictions
    test = device.recording("test")
    assert table.num_rows == 48
    for i, name in enumerate(TOUCH.names):
        assert table[name].to_pylist() == test.touches.labels[:, i].int().tolist()
        probabilities = test.touches.labels[:, i] * 0.8 + 0.1
        assert table[f"p_{name}"].to_pylist() == pytest.approx(probabilities.tolist())
    assert table["speed"].to_pylist() == test.parameters["speed"].tolist()


def test_what_is_not_defined_has_a_reason_and_is_shown_as_a_dash(made_up_device, tmp_path):
    class AllDangerous(type(made_up_device)):
        def touches(self, split, epoch=0):
            touches = super().touches(split, epoch)
            touches.labels[:, 3] = 1
            return touches

    found = evaluate(Knows(), AllDangerous(), SETTINGS, POINT)
    assert "same/dangerous/false_alarm_rate" in found.unavailable
    assert "dangerous/accuracy" not in "".join(found.unavailable)
    seen = io.StringIO()
    show(found, "title", Console(file=seen, width=100))
    line = next(line for line in seen.getvalue().splitlines() if "dangerous/false_alarm_rate" in line)
    assert "100.0" not in line
    assert line.count(" - ") == 2
    assert "same/dangerous/false_alarm_rate: not defined" in seen.getvalue()
    page = report.evaluation_markdown(found, TOUCH, "title", "about")
    assert "| dangerous/false_alarm_rate | - | - |" in page


def test_labels_that_nobody_knows_have_a_sentence_instead_of_figures(made_up_device, monkeypatch):
    touches = made_up_device.touches("test")
    labels = touches.labels.clone()
    labels[:, [0, 3]] = torch.nan
    monkeypatch.setattr(made_up_device, "touches", lambda *_: replace(touches, labels=labels))
    constant = SimpleNamespace(probabilities=lambda touches: torch.full((len(touches), 4), 0.9))
    found = evaluate(constant, made_up_device, SETTINGS, POINT)
    assert not [name for name in found.metrics if name.split("/")[1] in ("big", "dangerous")]
    assert {"same/press/accuracy", "same/overall/accuracy"} <= set(found.metrics)
    assert found.unavailable["labels"] == "the touches of the test tell nothing of big, dangerous"
    assert "/big" not in "".join(found.unavailable)
    assert found.reached is None


class Sure:
    """Says what the labels say, but for some."""

    def __init__(self, but):
        self.but = but

    def probabilities(self, touches):
        return ((touches.labels > 0.5) != self.but).float() * 0.8 + 0.1


def test_spans_hold_what_is_said_and_what_is_wrong():
    fractions = torch.tensor([0.0, 0.97, 1.0, 1.01, 1.02, 3.0])
    said = torch.tensor([True, False, True, True, False, True])
    found = pd.DataFrame(report.span_rows("big", said, fractions))
    assert found[["low", "high", "touches", "said", "wrong"]].to_numpy().tolist() == [
        ["0", "0.5", 1, "1", 1],
        ["0.95", "1", 2, "1", 1],  # a measure that only reaches its threshold does not pass it
        ["1", "1.05", 2, "1", 1],
        ["2", "inf", 1, "1", 0],
    ]
    assert found["mean"][1] == pytest.approx(0.985)


@pytest.fixture(scope="module")
def grid_device(configured):
    return build_device(configured("simulator=naive", "layout=grid", "device.test_gestures=64"))


def measured(grid_device, but, point=POINT):
    frame, reached = report.measure_margins(Sure(but), grid_device, 200, point)
    frame = frame.assign(low=frame.low.astype(float), high=frame.high.astype(float))
    assert (frame.groupby(["label", "by"]).touches.sum() == 200).all()
    spans = frame[frame.by == "threshold"]
    return spans.assign(said=spans.said.astype(int)), frame[frame.by == "reading"], reached


def test_the_labels_are_what_the_measures_say(grid_device):
    """A learner that says the labels is wrong in no span; every label changes where its measure passes 1."""
    spans, faint, _ = measured(grid_device, torch.zeros(200, 4, dtype=torch.bool))
    assert set(spans.label) == {*TOUCH.names, ALARM_NAME}
    assert (spans.said == spans.touches.where(spans.high > 1, 0)).all()
    assert (((spans.low < spans["mean"]) | (spans.low == 0)) & (spans["mean"] <= spans.high)).all()
    assert spans.wrong.sum() == faint.wrong.sum() == 0


def test_errors_are_found_where_they_are(grid_device):
    but = torch.zeros(200, 4, dtype=torch.bool)
    but[:7, 1] = True
    spans, faint, _ = measured(grid_device, but)
    assert [part.groupby("label").wrong.sum()["dynamic"] for part in (spans, faint)] == [7, 7]
    assert spans.groupby("label").wrong.sum()["big"] == 0


def test_the_alarm_is_raised_at_the_operating_point_and_the_label_at_one_half(grid_device):
    """Whoever says 0.9 at most raises no alarm above 0.95."""
    shy = OperatingPoint(0.95, 0.02, 64, 1, 0)
    spans, _, reached = measured(grid_device, torch.zeros(200, 4, dtype=torch.bool), shy)
    said = spans.groupby("label").said.sum()
    assert (said[ALARM_NAME], said["dangerous"]) == (0, 100)
    assert (reached.recall, reached.false_alarm_rate, reached.safe) == (0, 0, 100)
