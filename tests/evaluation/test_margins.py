"""Verdicts by the distance from a threshold and by strength, against touches whose answers are known."""

import pytest
import torch

from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.margins import ALARM_NAME, find_spans, measure_margins
from skin.evaluation.operating_point import OperatingPoint
from skin.touch.labels import TOUCH

POINT = OperatingPoint(0.5, 0.02, 64, 1, 0)


class Sure:
    """Says what the labels say, but for some."""

    def __init__(self, but: torch.Tensor) -> None:
        self.but = but

    def probabilities(self, touches: Touches) -> torch.Tensor:
        """Return probabilities near 0 and 1."""
        assert touches.labels is not None
        return ((touches.labels > 0.5) != self.but).float() * 0.8 + 0.1


def test_spans_hold_what_is_said_and_what_is_wrong():
    fractions = torch.tensor([0.0, 0.97, 1.0, 1.01, 1.02, 3.0])
    said = torch.tensor([True, False, True, True, False, True])
    found = find_spans(said, fractions)
    assert [(one.low, one.high, one.count, one.said, one.wrong) for one in found] == [
        (0, 0.5, 1, 1, 1),
        (0.95, 1, 2, 1, 1),  # a measure that only reaches its threshold does not pass it
        (1, 1.05, 2, 1, 1),
        (2, float("inf"), 1, 1, 0),
    ]
    assert found[1].mean == pytest.approx(0.985)


def test_ranges_are_exact():
    """None of ten: the upper end p has (1 - p)^10 = 0.025."""
    (one,) = find_spans(torch.zeros(10, dtype=torch.bool), torch.zeros(10))
    assert one.range == pytest.approx((0, 1 - 0.025**0.1))


@pytest.fixture(scope="module")
def device(configured) -> AbstractDevice:
    from skin.runs.build import build_device

    return build_device(configured("simulator=naive", "layout=grid", "device.test_gestures=64"))


def test_the_labels_are_what_the_measures_say(device):
    """A learner that says the labels is wrong in no span; every label changes where its measure passes 1."""
    found = measure_margins(Sure(torch.zeros(200, 4, dtype=torch.bool)), device, 200, POINT)
    assert set(found.spans) == {*TOUCH.names, ALARM_NAME}
    for each in found.spans.values():
        assert sum(one.count for one in each) == 200
        assert [one.said for one in each] == [0 if one.high <= 1 else one.count for one in each]
        assert all(one.low < one.mean <= one.high or one.mean == one.low == 0 for one in each)
    assert sum(one.count for one in found.faint) == 200
    assert not any(value for one in found.faint for value in one.wrong.values())


def test_errors_are_found_where_they_are(device):
    but = torch.zeros(200, 4, dtype=torch.bool)
    but[:7, 1] = True
    found = measure_margins(Sure(but), device, 200, POINT)
    assert sum(one.wrong for one in found.spans["dynamic"]) == 7
    assert sum(one.wrong["dynamic"] for one in found.faint) == 7
    assert sum(one.wrong for one in found.spans["big"]) == 0


def test_only_simulated_touches_are_known(made_up_device):
    with pytest.raises(InputError, match="device=simulated"):
        measure_margins(Sure(torch.zeros(40, 4, dtype=torch.bool)), made_up_device, 40, POINT)


def test_the_alarm_is_raised_at_the_operating_point_and_the_label_at_one_half(device):
    """Whoever says 0.9 at most raises no alarm above 0.95."""
    shy = OperatingPoint(0.95, 0.02, 64, 1, 0)
    found = measure_margins(Sure(torch.zeros(200, 4, dtype=torch.bool)), device, 200, shy)
    assert sum(one.said for one in found.spans[ALARM_NAME]) == 0
    assert sum(one.said for one in found.spans["dangerous"]) == 100
    assert (found.reached.recall, found.reached.false_alarm_rate, found.reached.safe) == (0, 0, 100)
