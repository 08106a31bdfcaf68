"""Streams: a learner that knows the answer, one that never does, and touched or not against brute force."""

from dataclasses import replace

import pytest
import torch
from scipy.stats import poisson
from sklearn.metrics import balanced_accuracy_score

from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation import streams
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.settings import StreamSettings
from skin.evaluation.streams import Alarms, ContactThreshold, rise
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
    return streams.evaluate_windows(Knows(TOUCH_OR_NOT), streamed, ONLY_ALARMS, POINT)


@pytest.fixture(scope="module")
def whole(device):
    learner = Knows(TOUCH, refuses=60)
    return learner, streams.evaluate_windows(learner, device, COURSE, POINT)


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
    found = streams.evaluate_windows(AlwaysDangerous(TOUCH_OR_NOT), streamed, ONLY_ALARMS, POINT)
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
    found = streams.bin_by_fraction(probabilities, labels, fraction, TOUCH)
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
    return streams.count_alarms(said, shown, torch.tensor(dangerous), 0.5)


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


def touches(readings, valid=None):
    valid = torch.ones_like(readings, dtype=torch.bool) if valid is None else valid
    return Touches(readings, valid, torch.zeros(readings.shape[2], 3), None, 10.0)


@pytest.fixture
def noisy():
    return 0.05 * torch.randn(40, 30, 5, generator=torch.Generator().manual_seed(0))


def test_the_rise_is_the_largest_reading_above_what_the_untouched_skin_reads(noisy):
    idle = torch.tensor([3.0, -2.0, 0.5, 10.0, 0.0])
    found = rise(touches(noisy + idle), idle)
    for window, value in zip(noisy, found, strict=True):
        assert value.item() == pytest.approx(max(max(row) for row in window.tolist()), abs=1e-5)


def test_a_sensor_that_means_nothing_does_not_rise(noisy):
    broken = noisy.clone()
    broken[:, 10, 4] = 50
    valid = torch.ones_like(broken, dtype=torch.bool)
    valid[:, :, 4] = False
    torch.testing.assert_close(rise(touches(broken, valid)), rise(touches(noisy[..., :4])))


@pytest.mark.parametrize("seed", range(4))
def test_no_threshold_tells_better_than_the_tuned_one(seed):
    generator = torch.Generator().manual_seed(seed)
    touched = torch.rand(80, generator=generator) < 0.8
    rises = (torch.rand(80, generator=generator) + 0.6 * touched).round(decimals=2)  # with ties
    tuned = ContactThreshold.tuned(rises, touched)
    best = max(balanced_accuracy_score(touched, rises >= cut) for cut in rises.tolist())
    assert balanced_accuracy_score(touched, rises >= tuned.minimum) == pytest.approx(best)


def test_windows_that_are_all_alike_tune_nothing():
    with pytest.raises(InputError, match=r"data.gestures"):
        ContactThreshold.tuned(torch.rand(5), torch.ones(5, dtype=torch.bool))


def test_only_a_task_with_a_gate_has_a_learned_one(noisy):
    assert list(streams.gates(ContactThreshold(0.3), TOUCH)) == ["none", "threshold"]
    noisy[3, 5, 1] += 2
    found = streams.gates(ContactThreshold(0.5), TOUCH_OR_NOT)
    probabilities = torch.zeros(40, 5)
    probabilities[7, 4] = 0.6
    open_at = lambda gate: gate(touches(noisy), probabilities).nonzero().flatten().tolist()  # noqa: E731
    said = {name: open_at(gate) for name, gate in found.items()}
    assert said == {"none": list(range(40)), "threshold": [3], "learned": [7]}
