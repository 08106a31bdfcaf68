"""The threshold of the alarm: the false alarms that it allows, ties, storage, and what it promises."""

import json
import math
from dataclasses import astuple, replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.special import expit, logit
from scipy.stats import beta, binom
from sklearn.linear_model import LogisticRegression

from skin.core.rng import Stream, generator
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.evaluation import alarm, guarantee, touch_scores
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold, threshold_gestures
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.guarantee import allowed_misses, anytime_bound, counted, threshold_for_misses
from skin.evaluation.metrics import compute_metrics
from skin.evaluation.operating_point import DangerScore, OperatingPoint, Reached, parse_operating_point
from skin.evaluation.report import evaluate
from skin.evaluation.settings import Evaluation, check_evaluation
from skin.live.engine import Detection, Engine
from skin.runs.build import build_device
from skin.touch.labels import TOUCH, TOUCH_OR_NOT, Task
from skin.touch.movie import balanced
from skin.wire.channels import UnitConversion

SETTINGS = Evaluation(devices=0, layouts=0, false_alarm_rate=0.1, safe_gestures=64)
POINT = OperatingPoint(0.25, 0.02, 2048, 40, 3)
GESTURES = Task(("stroke", "dangerous", "slap"), "exclusive")
SMALL = ["simulator=naive", "layout=grid", "layout.rows=3", "layout.columns=3", "device.tare=true"]
CONTACT = 0.5  # N


def choose(learner, device, settings, live=None):
    return choose_alarm_threshold(AlarmSource("new", settings, learner, device=device), live, anew=True)


class Peak:
    """Says how likely danger is by the largest reading alone; it has learnt nothing."""

    def __init__(self, task=TOUCH):
        self.task = task

    def probabilities(self, touches):
        strongest = touches.readings.flatten(1).amax(1)
        return (strongest / 20).clamp(0, 1)[:, None].repeat(1, len(self.task))


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "layout=grid", "device.test_gestures=64"))


@pytest.mark.parametrize(
    ("count", "target", "allowed"),
    [(1999, 0.02, 39), (2000, 0.02, 39), (99, 0.02, 1), (49, 0.02, 0), (48, 0.02, 0), (99, 0.29, 28)],
)
def test_as_many_safe_gestures_raise_the_alarm_as_are_allowed(count, target, allowed):
    """k = floor(target (n + 1)) - 1; 0.29 * 100 is 28.999999999999996 in floating point."""
    generator = torch.Generator().manual_seed(0)
    scores = torch.linspace(0.1, 0.9, count)[torch.randperm(count, generator=generator)]
    threshold = alarm._lowest_threshold(scores, target)
    assert int((scores > threshold).sum()) == allowed
    assert allowed / count <= target


def test_the_last_digit_of_a_score_decides_nothing():
    """Scores of another processor differ in the last digit; the same gestures raise the alarm."""
    scores = torch.rand(3000, generator=torch.Generator().manual_seed(0)).round(decimals=3)
    threshold = alarm._lowest_threshold(scores, 0.05)
    up, down = (torch.nextafter(scores, torch.tensor(end)) for end in (2.0, -1.0))
    for other in (up, down):
        assert torch.equal(other > threshold, scores > threshold)
        assert int((scores > alarm._lowest_threshold(other, 0.05)).sum()) == int((scores > threshold).sum())


def test_reached_rates_are_counted_their_range_is_exact_and_accuracy_is_at_one_half():
    probabilities = torch.tensor([[0.0] * 4] * 6)
    probabilities[:, 3] = torch.tensor([0.9, 0.25, 0.3, 0.1, 0.2, 0.26])
    labels = torch.zeros(6, 4)
    labels[:2, 3] = 1
    reached = POINT.reached(probabilities, labels, TOUCH)
    assert reached == Reached(dangerous=2, found=1, safe=4, raised=2)
    assert (reached.recall, reached.false_alarm_rate) == (0.5, 0.5)
    found = compute_metrics(probabilities, labels, TOUCH, POINT)
    assert (found["dangerous/alarm_recall"], found["dangerous/false_alarm_rate"]) == (0.5, 0.5)
    assert found["dangerous/accuracy"] == pytest.approx(5 / 6)
    # None of ten: the upper end p has (1 - p)^10 = 0.025.
    assert Reached(0, 0, 10, 0).range == pytest.approx((0, 1 - 0.025**0.1))


def test_rates_of_no_gesture_are_undefined_and_printed_so():
    safe = POINT.reached(torch.zeros(3, 4), torch.zeros(3, 4), TOUCH)
    dangerous = POINT.reached(torch.ones(3, 4), torch.ones(3, 4), TOUCH)
    assert all(map(math.isnan, (safe.recall, dangerous.false_alarm_rate, dangerous.range[0])))
    found = compute_metrics(torch.ones(3, 4), torch.ones(3, 4), TOUCH, POINT)
    assert math.isnan(found["dangerous/balanced_accuracy"])
    assert (found["dangerous/accuracy"], found["dangerous/alarm_recall"]) == (1, 1)
    assert safe.sentence().endswith("dangerous gestures found: -")
    assert dangerous.sentence() == "false alarms: - (no safe gesture); dangerous gestures found: 100.0 % of 3"


def test_a_shut_gate_and_an_exclusive_task_are_counted_right():
    labels = torch.tensor([[0, 0, 0, 1.0, 1], [0, 0, 0, 0, 1], [0, 0, 0, 0, 0]])
    assert POINT.reached(torch.ones(3, 5), labels, TOUCH_OR_NOT) == Reached(1, 1, 1, 1)
    probabilities = torch.tensor([[0.1, 0.6, 0.3], [0.7, 0.3, 0.0], [0.1, 0.1, 0.8]])
    found = compute_metrics(probabilities, torch.eye(3)[[1, 0, 2]], GESTURES, POINT)
    rates = {"dangerous/alarm_recall": 1.0, "dangerous/false_alarm_rate": 0.5}
    assert found == {"overall/accuracy": 1.0} | rates


def test_fresh_gestures_belong_to_no_split_and_enough_are_safe(device):
    splits = [device.touches(split) for split in ("train", "validation", "holdout", "test")]
    known = {row.item() for touches in splits for row in touches.readings.flatten(1).sum(1)}
    fresh = threshold_gestures(device, SETTINGS)
    assert len(fresh) == 128
    assert int((fresh.labels[:, 3] < 0.5).sum()) == 64
    assert not known & {row.item() for row in fresh.readings.flatten(1).sum(1)}
    assert torch.equal(threshold_gestures(device.replace(), SETTINGS).readings, fresh.readings)
    other = device.replace(data_seed=1)
    assert not torch.equal(threshold_gestures(other, SETTINGS).readings, fresh.readings)


def test_the_chosen_point_has_the_wanted_rate_on_its_gestures(device):
    point = choose(Peak(), device, SETTINGS)
    fresh = threshold_gestures(device, SETTINGS)
    reached = point.reached(Peak().probabilities(fresh), fresh.labels, TOUCH)
    assert (point.safe, point.raised, point.target, point.seed) == (64, 5, 0.1, 0)
    assert (reached.safe, reached.raised) == (64, 5)
    assert (point.dangerous, point.found) == (reached.dangerous, reached.found) == (64, reached.found)
    assert f"finds {100 * reached.recall:.1f} % of 64 dangerous ones" in point.sentence()
    assert choose(Peak(), device, replace(SETTINGS, false_alarm_rate=0.5)).threshold < point.threshold


def test_a_device_without_fresh_gestures_gives_its_validation_split_and_says_so(made_up_device):
    point = choose(Peak(), made_up_device, SETTINGS)
    labels = made_up_device.touches("validation").labels
    assert point.safe == int((labels[:, 3] < 0.5).sum())
    assert point.seed is None
    assert f"chosen on {point.safe} safe validation gestures" in point.warning()
    assert "2000 are needed" in point.warning()


def test_a_task_without_dangerous_has_no_operating_point(made_up_device):
    made_up_device.task = Task(("big", "dynamic", "press", "hard"))
    assert choose(Peak(), made_up_device, SETTINGS) is None
    found = evaluate(Peak(), made_up_device, SETTINGS, None)
    assert found.reached is None
    assert not [name for name in found.metrics if "alarm" in name]


def test_a_threshold_that_nothing_passes_or_that_hides_dangerous_touches_is_told():
    """The latter only where the live view chose it: a window may show less than a touch."""
    assert not POINT.silent
    assert POINT.warning() is None
    assert "no alarm will be raised" in replace(POINT, threshold=1.000001).warning()
    point = replace(POINT, rate=100.0, dangerous=400, found=300)
    assert point.warning() is None
    hiding = replace(point, found=299)
    assert "finds 74.8 % of 400 dangerous ones: it hides dangerous touches" in hiding.warning()
    assert replace(hiding, rate=None).warning() is None


def test_what_is_stored_reads_back_to_the_last_digit():
    point = replace(POINT, threshold=alarm._lowest_threshold(torch.linspace(0.1, 0.7, 500), 0.02))
    assert parse_operating_point(point.text()) == point
    assert parse_operating_point("null") is None


@pytest.mark.parametrize(
    "text",
    [
        "", "{}", "[]", "0.5", "[" * 5000,
        *(json.dumps(json.loads(POINT.text()) | change) for change in (
            {"threshold": None}, {"threshold": math.nan}, {"threshold": math.inf}, {"threshold": -1},
            {"target": 2}, {"safe": "many"}, {"raised": 9999}, {"found": 1}, {"label": "big"}, {"seed": {}})),
    ],
)  # fmt: skip
def test_a_damaged_one_is_refused(text):
    with pytest.raises(InputError, match="cannot be read"):
        parse_operating_point(text)


@pytest.mark.parametrize(
    ("name", "value", "better"),
    [
        *(("false_alarm_rate", value, 0.02) for value in (0.0, 1.0)),
        *(("miss_rate", value, 0.001) for value in (0.0, 0.5)),
        ("safe_gestures", 0, 2000),
    ],
)
def test_what_cannot_be_chosen_is_refused(name, value, better):
    with pytest.raises(InputError, match=f"{name}={better}"):
        check_evaluation(replace(SETTINGS, **{name: value}))


class Largest:
    """The probability of every label grows with the largest reading of the window."""

    def probabilities(self, touches):
        peak = touches.readings.flatten(1).amax(1)
        return torch.sigmoid(peak - 5)[:, None].expand(-1, 4)


@pytest.fixture(scope="module")
def drawn(configured):
    return build_device(configured(*SMALL, "device.randomise=true", "device.noise=0.1"))


def watching(rate, **changes):
    return LiveConditions(rate, CONTACT, 2.0, **{"patience": 0.1, "column": 3, **changes})


def engine_windows(readings, valid, ends, rate):
    """Return the windows and contacts of the engine at the decisions of one touch (F, S)."""
    windows, sensors = [], readings.shape[1]

    def classify(values, known):
        windows.extend(values)
        return np.zeros((len(values), 4))

    engine = Engine(classify, TOUCH, sensors, 30, 10.0, Detection(CONTACT, drift=0.0))
    conversion = UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, bool))
    # The first decision comes at a tick of the engine.
    times = 100.0 + (np.arange(len(readings)) - ends[0]) / rate
    frames = [Frame(n, t, t, row, valid) for n, (t, row) in enumerate(zip(times, readings, strict=True))]
    verdicts = engine.push([conversion.convert(frame) for frame in frames])
    position = {round(verdict.t * rate): number for number, verdict in enumerate(verdicts)}
    chosen = [position[round(times[end] * rate)] for end in ends]
    return np.stack([windows[n] for n in chosen]), [verdicts[n].contact is not None for n in chosen]


def decide(drawn, learner, rate, **changes):
    labels = balanced(64, generator(Stream.TEST, 8))
    return touch_scores.decide_touches(learner, drawn, watching(rate, **changes), labels, 9).scores(None)


@pytest.mark.parametrize("rate", [20.0, 100.0, 500.0])
def test_the_windows_are_those_that_the_engine_decides_on(drawn, rate):
    """Independent code: frame by frame there, all touches at once here."""
    drawn = drawn.replace(padded=False)
    labels = balanced(16, generator(Stream.TEST, 3))
    movie = drawn.sampler.sample(16, generator(Stream.TEST, 4), labels)
    same = [generator(Stream.ALARM, 5) for _ in range(2)]
    windows, valid, contact = touch_scores._decision_windows(drawn, movie, watching(rate), same[0])
    readings, _ = touch_scores._measure_touches(drawn, movie, watching(rate), same[1])
    step = max(1.0, rate / 20)
    ends = touch_scores._draw_decisions(readings.shape, round(30 * rate / 10), step, same[1])
    longest = 0
    for touch in sorted(range(16), key=lambda touch: -int(contact[touch].sum()))[::3]:
        given = readings[touch].double().numpy(), valid[touch].numpy(), ends[touch].numpy()
        found, felt = engine_windows(*given, rate)
        assert felt == contact[touch].tolist()
        shown = contact[touch].numpy()
        np.testing.assert_allclose(found[shown], windows[touch][shown].numpy(), atol=1e-5)
        longest = max(longest, int(shown.sum()))
    assert longest > 35  # presses of two seconds are among them


@pytest.mark.parametrize("rate", [10.0, 20.0, 100.0])
def test_the_share_of_new_safe_touches_is_the_one_that_was_asked_for(drawn, rate):
    point = choose(Largest(), drawn, replace(SETTINGS, safe_gestures=400), watching(rate))
    assert (point.safe, point.dangerous, point.rate) == (400, 400, rate)
    assert point.raised <= 40
    labels = balanced(1600, generator(Stream.TEST, 8))
    safe = labels[~labels[:, 3]]
    decisions = touch_scores.decide_touches(Largest(), drawn, watching(rate), safe, 99)
    fraction = float(point.alarm(decisions.scores(point.score)).float().mean())
    # Both are counted: three standard deviations of 400 and 800 touches.
    assert fraction == pytest.approx(0.1, abs=3 * (0.09 / 400 + 0.09 / 800) ** 0.5)


def test_the_misses_of_touches_that_count_are_those_that_were_asked_for(drawn):
    """The true rate of a threshold on the n-th lowest of N scores is a beta variable."""
    point = choose(Largest(), drawn, replace(SETTINGS, miss_rate=0.05), watching(20.0))
    promise = point.guarantee
    assert (promise.touches, promise.misses) == (point.dangerous, point.dangerous - point.found)
    assert promise.misses == allowed_misses(promise.touches, 0.05) > 0
    said = f"on a sensor: at most 5 % missed, 95 %, {promise.touches} touches, this device, 20 Hz"
    assert said in point.sentence()
    assert f"{100 * point.raised / 64:.1f} % of 64 safe touches raise it" in point.sentence()
    labels = balanced(1600, generator(Stream.TEST, 8))
    others = touch_scores.decide_touches(Largest(), drawn, watching(20.0), labels[labels[:, 3]], 99)
    missed = ~point.alarm(others.scores(point.score))[counted(others.peak, others.sensed)]
    true = beta(promise.misses + 1, promise.touches - promise.misses)
    spread = (true.var() + true.mean() / len(missed)) ** 0.5
    assert float(missed.float().mean()) == pytest.approx(true.mean(), abs=3 * spread)


class Onset(Largest):
    """Looks at the change from one interval to the next."""

    def probabilities(self, touches):
        change = touches.readings[:, -1].amax(1) - touches.readings[:, -2].amax(1)
        return torch.sigmoid(change)[:, None].expand(-1, 4)


def test_no_score_of_a_part_of_the_decisions_is_higher_and_the_alarms_are_the_same(drawn):
    labels = balanced(64, generator(Stream.TEST, 8))
    decide = partial(touch_scores.decide_touches, Onset(), drawn, watching(100.0), labels, 9)
    every, part = (decide(enough=enough).scores(None) for enough in (None, (None, -1.0)))
    level = float(every.median())
    enough = decide(enough=(None, level)).scores(None)
    assert (part <= enough).all()
    assert (enough <= every).all()
    assert ((enough > level) == (every > level)).all()
    assert (part < enough).any()


def test_touches_are_tared_as_in_the_live_view(drawn):
    """Offsets held the contact long after a touch: what was left of it in the window looked like a tap."""
    offset = [decide(drawn.replace(offset=newtons, tare=False), Largest(), 100.0) for newtons in (0.0, 0.5)]
    assert torch.allclose(*offset, atol=1e-4)


def test_one_decision_raises_more_alarms_than_two_and_a_slow_device_needs_one(drawn):
    two, one = (decide(drawn, Onset(), 100.0, patience=patience) for patience in (0.1, 0))
    assert (one >= two).all()
    assert (one > two).any()
    assert [watching(1).decisions(rate) for rate in (5.0, 10.0, 20.0, 100.0, 500.0)] == [1, 1, 2, 2, 2]


def test_a_device_of_the_model_gives_its_frames(drawn):
    """The simulator sends the frames of the model; a real one of that rate reads at any phase."""
    aligned, real = (decide(drawn, Largest(), 10.0, aligned=aligned) for aligned in (True, False))
    assert aligned.mean() > real.mean()


def test_the_score_is_the_logistic_regression_of_odds_and_level():
    draw = np.random.default_rng(0)
    dangerous = draw.random(600) < 0.5
    probability = expit(draw.normal(np.where(dangerous, 1.0, -1.0), 1.5))
    reading = np.exp(draw.normal(np.where(dangerous, 1.2, 0.9), 0.2))
    score = DangerScore.fit(probability, reading, dangerous)
    inputs = np.stack([logit(probability), np.log(reading)], axis=1)
    other = LogisticRegression(C=100.0, tol=1e-8).fit(inputs, dangerous)
    assert astuple(score) == pytest.approx((*other.coef_[0], other.intercept_[0]), rel=1e-3)
    expected = other.predict_proba(inputs)[:, 1]
    np.testing.assert_allclose(score.probability(probability, reading), expected, atol=1e-3)


def test_a_larger_reading_never_lowers_the_score_and_nan_stays():
    draw = np.random.default_rng(1)
    dangerous = draw.random(200) < 0.5
    score = DangerScore.fit(np.where(dangerous, 0.9, 0.1), np.where(dangerous, 1.0, 2.0), dangerous)
    assert score.level == 0
    assert (np.diff(DangerScore(1.0, 2.0, 0.0).probability(np.full(9, 0.5), np.arange(9.0))) > 0).all()
    assert np.isnan(score.probability(np.array([np.nan]), np.array([1.0]))).all()


@pytest.mark.parametrize(
    ("touches", "rate", "allowed"),
    [(2994, 1e-3, -1), (2995, 1e-3, 0), (20_000, 1e-3, 12), (3000, 0.005, 8), (58, 0.05, -1), (59, 0.05, 0)],
)
def test_as_many_misses_are_allowed_as_the_binomial_tail_says(touches, rate, allowed):
    assert guarantee.allowed_misses(touches, rate) == allowed
    assert binom.cdf(allowed, touches, rate) <= 0.05 < binom.cdf(allowed + 1, touches, rate)
    assert guarantee.touches_needed(rate) == math.ceil(math.log(0.05) / math.log(1 - rate))


def test_a_threshold_chosen_on_100_presses_keeps_its_promise():
    """The true rate is a beta variable, whatever the scores are; here they are drawn from a store."""
    draw = np.random.default_rng(0)
    store = np.sort(draw.normal(size=20_000)) / 20 + 0.5
    chosen = [threshold_for_misses(draw.choice(store, 100), 0.05) for _ in range(200)]
    missed = np.searchsorted(store, chosen, "right") / len(store)
    assert 184 <= (missed <= 0.05).sum() <= 196
    true = beta(guarantee.allowed_misses(100, 0.05) + 1, 99)
    assert np.mean(missed) == pytest.approx(true.mean(), abs=4 * true.std() / 200**0.5)


@pytest.mark.parametrize("rate", [0.01, 0.05, 0.2])
def test_a_bound_on_presses_is_hardly_ever_wrong_at_any_time(rate):
    """The exact probability that it ever falls below the true rate in 1500 presses."""
    alive, wrong, fewest = np.zeros(1502), 0.0, 0
    alive[0] = 1.0
    for presses in range(1, 1501):
        alive[1 : presses + 1] = alive[1 : presses + 1] * (1 - rate) + alive[:presses] * rate
        alive[0] *= 1 - rate
        while anytime_bound(fewest, presses) < rate:
            fewest += 1
        wrong += alive[:fewest].sum()
        alive[:fewest] = 0.0
    assert 0.02 < wrong < 0.05


def test_presses_without_a_miss_buy_a_bound():
    """In closed form: the likelihoods of n hits, averaged from 0 to p, over that of p."""
    p, n = anytime_bound(0, 100), 100
    assert (1 - (1 - p) ** (n + 1)) / ((n + 1) * p * (1 - p) ** n) == pytest.approx(20)
    assert 85 <= guarantee.presses_needed(0.05) <= 110
    assert guarantee.presses_needed(0.05, misses=1) > guarantee.presses_needed(0.05)
    bounds = [anytime_bound(misses, 100) for misses in range(101)]
    assert bounds == sorted(bounds)
    assert bounds[-1] == 1 == anytime_bound(0, 0)
    assert beta(4, 97).ppf(0.95) < bounds[3]  # what may be read at any time costs a little


def test_too_few_touches_or_presses_are_told_how_many_are_needed():
    needed = guarantee.presses_needed(0.05)
    pressed = np.full(needed, 1.2), np.full(needed, 1.2), np.ones(needed, dtype=bool)
    assert f"{needed} of {needed}, 0 missed" in guarantee.describe_presses(*pressed, 0.05)[0]
    with pytest.raises(InputError, match=f"0 misses of {needed - 1} presses .* {needed} presses are needed"):
        guarantee.describe_presses(*(values[1:] for values in pressed), 0.05)
    match = r"2994 touches cannot show at most 0.1 % missed, .* 2995 are needed"
    with pytest.raises(InputError, match=match):
        threshold_for_misses(np.ones(2994), 0.001)
    with pytest.raises(InputError, match="4 of 300 dangerous touches on a sensor are not felt"):
        threshold_for_misses(np.repeat([0.0, 0.5], [4, 296]), 0.027)


@pytest.mark.parametrize("rate", [50.0, 60.0, 80.0, 90.0, 125.0, 250.0, 333.3, 480.0, 1000.0])
def test_a_guarantee_is_for_nearly_the_rate_of_the_device(rate):
    live = LiveConditions(rate, 0.3, 2, 0.1, 3)
    chosen = alarm._snapped(live, SimpleNamespace(model_rate=10.0)).rate
    assert not guarantee.Guarantee(0.001, 10_000, 0, "", device_rate=chosen, patience=0.1).under(live).lapsed


def test_a_touch_counts_above_the_margin_and_on_a_valid_sensor():
    peak, sensed = np.array([1.2, 1.2, 1.05, 1.2]), np.array([1.2, 0.0, 1.05, 1.01])
    assert guarantee.counted(peak, sensed).tolist() == [True, False, False, True]


def test_the_pressure_of_a_touch_is_that_over_footprints_of_valid_sensors(configured):
    """Against the dense movie, and against the measure that decides the label."""
    small = ["simulator=naive", "layout=grid", "layout.rows=3", "layout.columns=3", "device.dead=4"]
    device = build_device(configured(*small)).replace(padded=False)
    labels = balanced(16, generator(Stream.TEST, 3))
    live = LiveConditions(10.0, 0.5, 2.0, 0.0, 3, aligned=True)
    decisions = touch_scores.decide_touches(Largest(), device, live, labels, 9)
    same = generator(Stream.ALARM, 9, 2, 0)
    movie = device.sampler.sample(16, same, labels)
    _, works, _ = touch_scores._decision_windows(device, movie, live, same)
    means = movie.pressure().flatten(2).numpy() @ device.body.footprints(device.sensors).T / 90.5e3
    assert_close = partial(np.testing.assert_allclose, rtol=1e-4)
    assert_close(decisions.peak, means.max((1, 2)))
    assert_close(decisions.sensed, (means.max(1) * works.numpy()).max(1), atol=1e-4)
    assert (decisions.peak > 1).tolist() == labels[:, 3].tolist()
    assert (decisions.sensed < 0.9 * decisions.peak).any()
