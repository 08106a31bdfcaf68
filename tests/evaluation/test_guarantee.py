"""What an alarm promises: bounds against exact answers, coverage by draws, and what cannot be promised."""

import math
from functools import partial

import numpy as np
import pytest
from scipy.stats import beta, binom

from skin.core.rng import Stream, generator
from skin.errors import InputError
from skin.evaluation import guarantee, touch_scores
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.guarantee import anytime_bound, threshold_for_misses
from skin.runs.build import build_device
from skin.touch.movie import balanced
from tests.evaluation.test_operating_point import Largest


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
