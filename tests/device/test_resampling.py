"""The sliding window against what a plain loop over the frames finds."""

import numpy as np
import pytest

from skin.device.resampling import Frame, Window, check_rate
from skin.errors import InputError

SENSORS = 5


def frame(t, values, valid=None, **more):
    values = np.asarray(values, dtype=float)
    valid = np.ones(len(values), bool) if valid is None else np.asarray(valid)
    return Frame(None, t, t, values, valid, **more)


def stream(rate, count, seed=0):
    values = np.random.default_rng(seed).random((count, SENSORS))
    return [frame(number / rate, row) for number, row in enumerate(values)]


def fed(intervals, frames, sensors=SENSORS):
    """Return the window of a model at 10 Hz behind frames."""
    window = Window(intervals, 10.0, sensors)
    for one in frames:
        window.add(one)
    return window


def by_loop(frames, intervals, rate, period):
    """Return maxima over intervals that end half a period after the last frame, frame by frame."""
    end = frames[-1].t + period / 2
    readings = np.full((intervals, SENSORS), -np.inf)
    for one in frames:
        back = int((end - one.t) * rate)
        if back < intervals:
            position = intervals - 1 - back
            readings[position] = np.maximum(readings[position], one.values)
    return readings


@pytest.mark.parametrize("rate", [9.7, 10.0])
def test_near_the_models_rate_the_window_is_the_last_frames(rate):
    """A clock that is wrong by a few per cent is no slower stream."""
    window, frames = Window(8, 10.0, SENSORS), stream(rate, 40)
    for number, one in enumerate(frames):
        window.add(one)
        seen = window.read()
        assert (seen is None) == (number < 7)
        if seen:
            expected = np.stack([each.values for each in frames[number - 7 : number + 1]])
            np.testing.assert_array_equal(seen.values, expected)


@pytest.mark.parametrize("rate", [25.0, 100.0, 130.7, 1000.0])
def test_a_faster_stream_is_reduced_by_the_maximum(rate):
    window, frames = Window(6, 10.0, SENSORS), stream(rate, int(1.5 * rate))
    read = 0
    for number, one in enumerate(frames):
        window.add(one)
        if number % 7 == 0 and (seen := window.read()):
            expected = by_loop(frames[: number + 1], 6, 10.0, 1 / rate)
            np.testing.assert_array_equal(seen.values, expected)
            assert seen.valid.all()
            assert not seen.gap
            read += 1
    assert read > 3


def test_it_slides_at_every_frame_and_forgets_nothing_it_needs():
    window = fed(3, stream(100.0, 5000))
    window.add(frame(50.0, np.full(SENSORS, 9.0)))
    assert (window.read().values[-1] == 9).all()
    assert window.period == pytest.approx(0.01)


def test_a_slower_stream_is_refused_with_both_rates():
    window = fed(6, stream(5.0, 20))
    with pytest.raises(InputError, match=r"sends 5 frames a second, the model needs 10: .*touch.rate=5"):
        window.read()
    check_rate(9.9, 10.0)


def test_a_gap_is_flagged_and_not_filled():
    frames = stream(100.0, 200)
    window = fed(6, frames[:150])
    window.add(frames[175]._replace(lost=25, after="gap"))
    seen = window.read()
    assert seen.gap
    # From 1.50 to 1.74 s nothing came: one interval of the last six is without any frame.
    assert seen.valid.all(axis=1).tolist() == [True, True, True, True, False, True]
    assert not seen.values[~seen.valid].any()
    for one in frames[176:]:
        window.add(one)
    for number in range(200, 260):
        window.add(frame(number / 100, np.ones(SENSORS)))
    assert not window.read().gap


def test_a_restart_begins_another_window():
    window = fed(6, stream(100.0, 100))
    assert window.read() is not None
    for number, one in enumerate(stream(100.0, 70)):
        window.add(one._replace(segment=1))
        assert (window.read() is None) == (number < 59)


def test_a_pause_of_a_device_that_does_not_count_is_no_slow_stream():
    window = fed(4, stream(10.0, 20))
    for number in range(5):
        window.add(frame(8 + 0.1 * number, np.ones(SENSORS)))
    assert window.read().gap is False
    window.add(frame(8.8, np.ones(SENSORS)))
    assert window.read().gap


def test_a_dead_channel_is_masked_and_a_saturated_one_says_at_least_its_limit():
    window = Window(4, 10.0, 3)
    for number in range(12):
        # the first is dead all the time, the second saturates in frame 10, the third says nonsense then
        at_limit = number == 10
        saturated = np.array([False, at_limit, False])
        values = [7.0, 10.0 if at_limit else 2.0, 99.0 if at_limit else 2.0]
        window.add(frame(number / 10, values, [False, True, not at_limit], saturated=saturated))
    seen = window.read()
    assert not seen.valid[:, 0].any()
    assert seen.values[:, 1].tolist() == [2, 2, 10, 2]
    assert seen.valid[:, 1].all()
    assert seen.saturated[:, 1].tolist() == [False, False, True, False]
    assert (seen.valid[:, 2].tolist(), seen.values[2, 2]) == ([True, True, False, True], 0)


@pytest.mark.parametrize("rate", [9.8, 10.0, 33.3, 100.0, 130.7])
def test_a_recorded_window_is_the_live_one_at_its_last_frame(rate):
    """With jitter, gaps, dead and saturated channels: bit for bit."""
    draw, window, count = np.random.default_rng(3), Window(8, 10.0, SENSORS), int(4 * rate)
    times = np.arange(count) / rate + draw.uniform(-0.1, 0.1, count) / rate
    kept = draw.random(count) > 0.1
    kept[: int(2 * rate)] = True
    live, begin, compared = None, None, 0
    for number in np.flatnonzero(kept):
        t = times[number]
        if begin is not None and t >= begin + 0.8 - 1e-7:
            recorded = window.since(begin)
            for one, other in zip(recorded, live, strict=True):
                np.testing.assert_array_equal(one, other)
            begin, compared = None, compared + 1
        values, probability = draw.random(SENSORS), draw.random(SENSORS)
        valid, saturated = probability > 0.1, probability > 0.9
        window.add(frame(t, values, valid, lost=0 if kept[number - 1] else 1, saturated=saturated))
        live = window.read()
        if begin is None and t > 1.5:
            begin = t
    assert compared >= 2
