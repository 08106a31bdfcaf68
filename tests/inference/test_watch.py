"""The watch: false reports, and how soon sensors that have changed are found.

``WATCH_STREAMS=200 python -m pytest tests/inference/test_watch.py -m slow -s`` prints the figures.
"""

import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import binomtest

from skin import FingertipPrior, Grid, Noise, Posterior, Sheet, Solid
from skin.inference.candidates import CandidateReadings, disc_readings
from skin.inference.likelihood import Observation
from skin.inference.mechanics import Mechanics
from skin.inference.watch import THRESHOLD, Prediction, RankTests, Thickness, Watch

BODY = Sheet((0.16, 0.16), (16, 16), [{"material": "EcoFlex 00-30", "thickness": 0.03}])
SENSORS = Grid(5, 5, (0.01, 0.01), depth=0.0295).sensors(BODY)
PRIOR = FingertipPrior()
DEVICE = Noise(0.05, gain=0.02, position=0.001)  # calibrated
TOUCH = Noise(0.05, frames=50, gain=0.02, offset=0.005, position=0.001)  # half a second at 100 Hz
STREAMS = int(os.environ.get("WATCH_STREAMS", "4"))
FAULTS = {
    "gain": lambda readings, rng: 0.7 * readings,
    "dead": lambda readings, rng: 0.007 * rng.standard_normal(),
    "offset": lambda readings, rng: readings + 0.5,
    "frozen": lambda readings, rng: 0.1,
}


@cache
def simulator():
    return Solid(BODY, SENSORS)


@cache
def candidates():
    return CandidateReadings(simulator(), BODY, PRIOR)


def watch():
    return Watch(candidates(), PRIOR, DEVICE)


def draw_touches(count, rng, near=None, force=15.0):
    """Return true readings (count, 25), N: one fingertip, in 15 % two, in 10 % a hand of nine."""
    touches = []
    for kind in rng.random(count):
        number = 9 if kind < 0.1 else 2 if kind < 0.25 else 1
        places = rng.uniform(0, 0.16, (number, 2))
        if number == 9:
            places = places[:1] + rng.uniform(-0.04, 0.04, (9, 2))
        elif near is not None:
            places[0] = near + rng.uniform(-0.02, 0.02, 2)
        discs = np.column_stack([places.clip(0, 0.16), rng.uniform(*PRIOR.radii, number)])
        forces = force * np.exp(0.5 * rng.standard_normal(number)) / max(1, number / 3)
        touches.append(forces @ disc_readings(simulator(), BODY, discs, PRIOR.rim))
    return np.array(touches)


def measure_stream(touches, rng, change=None, sensor=0, begins=0):
    """Yield the readings of touches on a device whose gains differ, and whose baseline leaves some drift."""
    gains, drift = 1 + DEVICE.gain * rng.standard_normal(25), np.zeros(25)
    for number, touch in enumerate(touches):
        drift = 0.9 * drift + TOUCH.offset * np.sqrt(1 - 0.9**2) * rng.standard_normal(25)
        readings = gains * touch + drift + TOUCH.frame / TOUCH.frames**0.5 * rng.standard_normal(25)
        if change is not None and number >= begins:
            readings[sensor] = change(readings[sensor], rng)
        yield Observation.of(readings, np.ones(25, bool), np.zeros(25, bool), TOUCH)


def detect(fault, near, seed, before=100, after=60):
    """Return after how many touches a fault is reported, or None, and whether the sensor is named alone."""
    rng, sensor, tested = np.random.default_rng(seed), [12, 6, 0, 2, 17, 10, 23, 8][seed % 8], watch()
    place = SENSORS.positions[sensor, :2] if near else None
    touches = np.concatenate([draw_touches(before, rng), draw_touches(after, rng, place)])
    for number, touch in enumerate(measure_stream(touches, rng, FAULTS[fault], sensor, before)):
        tested.add(touch)
        if tested.changed:
            return number - before + 1, tested.changed == (sensor,)
    return None, False


@pytest.mark.parametrize("alike", [False, True], ids=["independent", "equal"])
def test_a_rank_test_rarely_multiplies_its_capital(alike):
    """By Ville's inequality in at most 2 %; sensors of a touch may be independent or equal."""
    rng, tests, highest = np.random.default_rng(0), RankTests(300), np.ones(300)
    for _ in range(300):
        # Equal but for which of them have a score.
        scores = np.full(300, rng.random()) if alike else rng.random(300)
        tests.add(scores, rng.random(300) < 0.1)
        highest = np.maximum(highest, tests.capital)
    assert (highest >= THRESHOLD).mean() <= 1 / THRESHOLD
    assert tests.capital.mean() <= 2


def test_the_sensor_whose_scores_rise_is_reported_and_no_other():
    rng, tested = np.random.default_rng(0), watch()
    for number in range(160):
        scores = rng.exponential(size=25)
        scores[7] += 5 * (number >= 100)
        tested.judge(Prediction(np.full(25, 3.0), scores, np.zeros(25), np.ones(25, bool)))
        if tested.changed:
            break
    assert 100 <= number < 120
    assert tested.changed == (7,)


def test_what_stays_below_three_deviations_need_not_be_exchangeable():
    tested = watch()
    for number in range(400):
        more = np.full(25, 6.0 * number / 400)
        tested.judge(Prediction(np.zeros(25), np.zeros(25), more, np.ones(25, bool)))
    assert tested.capital.max() <= 1


def test_a_touch_counts_once_when_it_has_ended():
    tested, moment, all_valid = watch(), Noise(0.05, frames=10), np.ones(25, bool)
    (touch,), judged = draw_touches(1, np.random.default_rng(3)), []
    tested.add = judged.append
    one = np.zeros(25)
    one[3] = 0.5  # an offset alone is no touch
    for readings in (one, touch, 3 * touch, one, one, touch):
        tested.look(readings, all_valid, moment)
    (seen,) = judged
    assert seen.readings == pytest.approx(2 * touch, rel=1e-5)
    assert (seen.noise.frames, seen.noise.offset) == (10, 0.005)


@pytest.mark.slow("hours of touches: 15 ms for each")
def test_few_streams_give_a_false_report():
    """Of 20 minutes, 400 touches each, with drift and hands."""
    false = 0
    for seed in range(STREAMS):
        rng, tested = np.random.default_rng([seed, 1]), watch()
        for touch in measure_stream(draw_touches(400, rng), rng):
            tested.add(touch)
        false += bool(tested.changed)
    low, high = binomtest(false, STREAMS).proportion_ci(method="wilson")
    print(f"\nfalse reports: {false} of {STREAMS} streams, {100 * low:.1f} to {100 * high:.1f} %")
    assert false <= max(1, 0.02 * STREAMS)


@pytest.mark.slow("thousands of touches: 15 ms for each")
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("near", [True, False], ids=["on_the_sensor", "anywhere"])
def test_faults_are_found_within_sixty_touches(fault, near):
    count = max(1, STREAMS // 5)
    times = [detect(fault, near, seed) for seed in range(count)]
    found = sorted(touches for touches, _ in times if touches is not None)
    low, high = binomtest(len(found), count).proportion_ci(method="wilson")
    place = "on the sensor" if near else "anywhere"
    print(
        f"\n{fault}, touches {place}: {len(found)} of {count} within 60 touches ({100 * low:.0f} to "
        f"{100 * high:.0f} %), after {found}; {sum(alone for _, alone in times)} name it alone"
    )
    # A gain, or a sensor that is dead, is felt only where it is touched.
    assert len(found) >= 0.5 * count or not (near or fault == "offset")


@pytest.mark.parametrize("true", [0.8, 1.0, 1.2])
def test_touches_tell_the_thickness_and_each_counts_once(true):
    noise, none = Noise(0.05, 10, thickness=(0.75, 1.3)), np.zeros(9, bool)
    body = Sheet((0.09, 0.09), (9, 9), BODY.layers)
    mechanics = Mechanics(coarse, body, Grid(3, 3, (0.01, 0.01), depth=0.0295).sensors(body), noise)
    prior, rng = FingertipPrior(large=0), np.random.default_rng(0)
    posterior = Posterior(coarse(body, mechanics.sensors), noise, body, prior, contacts=1)
    learned, described = Thickness(mechanics, posterior), posterior.candidates
    discs = np.column_stack([rng.uniform(0.02, 0.07, (30, 2)), rng.uniform(*prior.radii, 30)])
    readings = 10 * mechanics.thicker(true, prior).at(discs)[:, 0, 0] + 0.016 * rng.standard_normal((30, 9))
    for touch in readings[:19]:
        for part, number in ((0.5, 1), (1, 1), (2, None), (0.0, 0), (0.0, 0)):
            learned.look(Observation.of(part * touch, ~none, none, noise), number)
    assert (learned.touches, learned.doubt) == (19, None)  # too few to say so
    for touch in readings[19:]:
        learned.add(Observation.of(touch, ~none, none, noise))
    assert learned.factor == pytest.approx(true, abs=0.05)
    assert learned.noise.relative < 0.05 < noise.relative
    assert (learned.doubt is None) == (true == 1)
    assert posterior.noise is learned.noise
    error = posterior.candidates.at(discs)[:, 0, 0] - mechanics.thicker(true, prior).at(discs)[:, 0, 0]
    assert np.abs(error).max() < 0.25 * np.abs(described.at(discs)[:, 0, 0]).max()
    known = Thickness(replace(mechanics, noise=DEVICE), posterior)  # without a range
    known.add(Observation.of(touch, ~none, none, noise))
    assert (known.touches, posterior.noise) == (0, learned.noise)


def coarse(body, sensors):
    return Solid(body, sensors, divisions=4, refinement=1)
