"""A learner that knows the answer, and one that never does, on windows of streams."""

from dataclasses import replace

import pytest
import torch
from scipy.stats import poisson

from skin.errors import InputError
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.settings import StreamSettings
from skin.evaluation.streams import Alarms, bin_by_fraction, count_alarms, evaluate_windows
from skin.runs.build import build_device
from skin.touch.labels import TOUCH, TOUCH_OR_NOT

COURSE = StreamSettings(hours=0.05, gap=[2.0, 10.0], stride=0.3, windows=(2.0, 6.0))
POINT = OperatingPoint(0.5, 0.02, 64, 1, 0)
ONLY_ALARMS = replace(COURSE, windows=())


class Knows:
    """Answers with the labels, but for windows of a length that it refuses."""

    def __init__(self, task, refuses=None):
        self.task, self.refuses, self.asked = task, refuses, []

    def probabilities(self, touches):
        self.asked.append(touches)
        if touches.readings.shape[1] == self.refuses:
            raise InputError("another window")
        return 0.1 + 0.8 * touches.labels[:, : len(self.task)]


class AlwaysDangerous(Knows):
    """Calls everything dangerous."""

    def probabilities(self, touches):
        return torch.full((len(touches), len(self.task)), 0.9)


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "data.gestures=200", "device.test_gestures=150"))


@pytest.fixture(scope="module")
def streamed(device):
    return device.replace(stream=True)


@pytest.fixture(scope="module")
def knew(streamed):
    return evaluate_windows(Knows(TOUCH_OR_NOT), streamed, ONLY_ALARMS, POINT)


@pytest.fixture(scope="module")
def whole(device):
    learner = Knows(TOUCH, refuses=60)
    return learner, evaluate_windows(learner, device, COURSE, POINT)


def test_who_knows_the_labels_is_right_about_everything(knew):
    found = knew
    assert [set(one.accuracy.values()) for one in found.bins] == [{1.0}] * len(found.bins)
    assert found.gates["learned"][[0, 1], [1, 0]].tolist() == [0, 0]
    for alarms in found.alarms.values():
        assert (alarms.false, alarms.raised) == (0, 0)
    none, learned = found.alarms["none"], found.alarms["learned"]
    assert none == learned
    assert none.found == none.dangerous > 5
    assert found.alarms["threshold"].found <= none.found
    assert all(0 <= value <= 1 for name, value in found.metrics().items() if "accuracy" in name)


def test_every_test_window_with_touch_is_in_one_bin(streamed, knew):
    found = knew
    recording = streamed.recording("test")
    fraction, labels = recording.parameters["share"], recording.touches.labels
    assert sum(one.count for one in found.bins) == int(labels[:, 4].sum())
    assert {one.name: one.count for one in found.bins}["whole"] == int((fraction == 1).sum())
    parts = {one.name: one for one in found.bins}
    seen = labels[(fraction > 0.2) & (fraction <= 0.4), 2].mean().item()
    assert parts["0.2-0.4"].majority["press"] == pytest.approx(max(seen, 1 - seen))


def test_gates_keep_false_alarms_from_one_who_always_cries(streamed):
    found = evaluate_windows(AlwaysDangerous(TOUCH_OR_NOT), streamed, ONLY_ALARMS, POINT)
    none, threshold = found.alarms["none"], found.alarms["threshold"]
    assert none.false > 10
    assert threshold.false < none.false / 5
    assert none.found == none.dangerous
    assert none.raised == none.safe
    assert found.gates["threshold"].sum() == 150


def test_the_stream_is_as_long_as_asked_and_seen_at_every_stride(whole):
    learner, found = whole
    windows = (1800 - 30) // 3 + 1
    assert len(learner.asked[1]) == windows
    shown = learner.asked[1].labels[:, 4] > 0.5
    assert list(found.alarms) == ["none", "threshold"]
    assert found.alarms["none"].idle_hours == pytest.approx(float((~shown).sum()) * 3 / 36000)


def test_other_lengths_are_the_same_touches_begun_elsewhere(device, whole):
    learner, found = whole
    short, long = learner.asked[2:]
    assert [one.readings.shape[1] for one in (short, long)] == [20, 60]
    assert torch.equal(short.labels, device.touches("test").labels)
    assert torch.equal(long.labels, short.labels)
    # Unpadded touches begin at once, whatever the window.
    assert (short.readings - long.readings[:, :20]).abs().max() < 0.6
    assert found.lengths == {2.0: 1.0, 6.0: "another window"}
    assert "window/6/overall/accuracy" not in found.metrics()


def test_bins_by_hand():
    fraction = torch.tensor([0.0, 0.2, 0.25, 1.0, 1.0])
    labels = torch.tensor([[0, 0, 0, 0, 0], *[[1, 0, 1, 0, 1]] * 3, [0, 0, 1, 1, 1]]).float()
    probabilities = torch.tensor([[0.9, 0.9, 0.1, 0.1]] * 5)
    found = bin_by_fraction(probabilities, labels, fraction, TOUCH)
    assert [(one.name, one.count) for one in found] == [("0-0.2", 1), ("0.2-0.4", 1), ("whole", 2)]
    assert found[2].accuracy == {"big": 0.5, "dynamic": 0.0, "press": 0.0, "dangerous": 0.5}
    assert found[2].majority == {"big": 0.5, "dynamic": 1.0, "press": 1.0, "dangerous": 0.5}


@pytest.mark.parametrize("wrong", [{"hours": 0}, {"stride": 0}, {"gap": [5, 2]}, {"gap": [0, 2]}])
def test_courses_that_lead_nowhere(wrong):
    with pytest.raises(InputError, match=r"measure\."):
        StreamSettings(**wrong)


def count(alarm, gesture, dangerous=(True, False, True, True)):
    said = torch.tensor([one == "!" for one in alarm])
    shown = torch.tensor([int(one) if one.isdigit() else -1 for one in gesture])
    return count_alarms(said, shown, torch.tensor(dangerous), 0.5)


def test_an_alarm_that_lasts_is_one_and_one_that_outlasts_its_touch_is_false():
    found = count("!!..!.!!!!..!", "...........2.")
    assert (found.false, found.idle_hours) == (4, 6.0)
    found = count(".!!!!..", ".000...")
    assert (found.false, found.found) == (1, 1)
    assert count(".!!!...", ".000...").false == 0


def test_touches_that_raised_an_alarm_are_counted_once_and_unseen_ones_not():
    found = count("..!..!.......", ".000.111.222.")
    assert (found.dangerous, found.found, found.safe, found.raised) == (2, 1, 1, 1)
    assert found.false == 0
    found = count("....", "....")
    assert (found.dangerous, found.safe, found.false) == (0, 0, 0)


@pytest.mark.parametrize("false", [0, 1, 7, 40])
def test_the_range_holds_the_rates_under_which_the_count_is_no_surprise(false):
    found = Alarms(2.0, false, 0, 0, 0, 0)
    low, high = found.range
    assert found.per_hour == false / 2
    assert poisson.cdf(false, high * 2) == pytest.approx(0.025)
    assert low == 0 if not false else poisson.sf(false - 1, low * 2) == pytest.approx(0.025)
