"""Verdicts by the distance from a threshold and by strength, against touches whose answers are known."""

import pandas as pd
import pytest
import torch

from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.report import ALARM_NAME, measure_margins, span_rows
from skin.touch.labels import TOUCH

POINT = OperatingPoint(0.5, 0.02, 64, 1, 0)


class Sure:
    """Says what the labels say, but for some."""

    def __init__(self, but: torch.Tensor) -> None:
        self.but = but

    def probabilities(self, touches: Touches) -> torch.Tensor:
        assert touches.labels is not None
        return ((touches.labels > 0.5) != self.but).float() * 0.8 + 0.1


def test_spans_hold_what_is_said_and_what_is_wrong():
    fractions = torch.tensor([0.0, 0.97, 1.0, 1.01, 1.02, 3.0])
    said = torch.tensor([True, False, True, True, False, True])
    found = pd.DataFrame(span_rows("big", said, fractions))
    assert found[["low", "high", "touches", "said", "wrong"]].to_numpy().tolist() == [
        ["0", "0.5", 1, "1", 1],
        ["0.95", "1", 2, "1", 1],  # a measure that only reaches its threshold does not pass it
        ["1", "1.05", 2, "1", 1],
        ["2", "inf", 1, "1", 0],
    ]
    assert found["mean"][1] == pytest.approx(0.985)


@pytest.fixture(scope="module")
def device(configured) -> AbstractDevice:
    from skin.runs.build import build_device

    return build_device(configured("simulator=naive", "layout=grid", "device.test_gestures=64"))


def measured(device, but, point=POINT):
    frame, reached = measure_margins(Sure(but), device, 200, point)
    frame = frame.assign(low=frame.low.astype(float), high=frame.high.astype(float))
    assert (frame.groupby(["label", "by"]).touches.sum() == 200).all()
    spans = frame[frame.by == "threshold"]
    return spans.assign(said=spans.said.astype(int)), frame[frame.by == "reading"], reached


def test_the_labels_are_what_the_measures_say(device):
    """A learner that says the labels is wrong in no span; every label changes where its measure passes 1."""
    spans, faint, _ = measured(device, torch.zeros(200, 4, dtype=torch.bool))
    assert set(spans.label) == {*TOUCH.names, ALARM_NAME}
    assert (spans.said == spans.touches.where(spans.high > 1, 0)).all()
    assert (((spans.low < spans["mean"]) | (spans.low == 0)) & (spans["mean"] <= spans.high)).all()
    assert spans.wrong.sum() == faint.wrong.sum() == 0


def test_errors_are_found_where_they_are(device):
    but = torch.zeros(200, 4, dtype=torch.bool)
    but[:7, 1] = True
    spans, faint, _ = measured(device, but)
    assert [part.groupby("label").wrong.sum()["dynamic"] for part in (spans, faint)] == [7, 7]
    assert spans.groupby("label").wrong.sum()["big"] == 0


def test_the_alarm_is_raised_at_the_operating_point_and_the_label_at_one_half(device):
    """Whoever says 0.9 at most raises no alarm above 0.95."""
    shy = OperatingPoint(0.95, 0.02, 64, 1, 0)
    spans, _, reached = measured(device, torch.zeros(200, 4, dtype=torch.bool), shy)
    said = spans.groupby("label").said.sum()
    assert (said[ALARM_NAME], said["dangerous"]) == (0, 100)
    assert (reached.recall, reached.false_alarm_rate, reached.safe) == (0, 0, 100)
