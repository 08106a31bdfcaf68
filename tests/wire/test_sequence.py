"""Numbers and clocks followed by hand."""

import numpy as np
import pytest

from skin.device.resampling import FrameError
from skin.wire.clocks import FrameClock
from skin.wire.protocol import frames_ahead


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (4, 5, 1),
        (4, 9, 5),
        (5, 5, 0),
        (5, 4, 0),
        (65535, 0, 1),
        (65530, 4, 10),
        (2**32 - 1, 1, 2),
        (300, 0, 0),
    ],
)
def test_steps_across_the_wraps_of_firmware(before, after, expected):
    assert frames_ahead(before, after) == expected


def place(clock, seq, ticks, missing=0):
    """Place a frame that arrives when the device sends it."""
    return clock.place(seq, ticks, ticks * clock.unit, missing)


def test_a_missing_number_is_a_gap_and_no_segment():
    order = FrameClock()
    placed = [place(order, seq, 1000 * seq, 0) for seq in (7, 8, 11, 12)]
    assert [(place.lost, place.after, place.segment) for place in placed] == [
        (0, "", 0), (0, "", 0), (2, "gap", 0), (0, "", 0),
    ]  # fmt: skip


def test_the_clock_wraps_after_71_6_minutes_and_time_goes_on():
    order, period = FrameClock(), 10_000
    first = 2**32 - 3 * period
    placed = [place(order, seq, (first + seq * period) % 2**32, 0) for seq in range(8)]
    assert [place.t for place in placed] == pytest.approx([(first + seq * period) * 1e-6 for seq in range(8)])
    assert {place.after for place in placed} == {""}


@pytest.mark.parametrize(
    ("seq", "t_us"), [(0, 0), (0, 5_000_000), (102, 4_000), (3, 900_000)], ids=["both", "seq", "time", "back"]
)
def test_going_back_is_a_new_segment(seq, t_us):
    order = FrameClock()
    place(order, 100, 1_000_000, 0)
    place(order, 101, 1_010_000, 0)
    placed = place(order, seq, t_us, 0)
    assert (placed.after, placed.segment, placed.lost, placed.t) == ("reset", 1, 0, t_us * 1e-6)
    assert place(order, seq + 1, t_us + 1, 0).after == ""


def test_the_same_frame_once_more_is_refused():
    order = FrameClock()
    place(order, 1, 10, 0)
    with pytest.raises(FrameError, match="repeat"):
        place(order, 1, 10, 0)
    assert place(order, 2, 20, 0).after == ""


def test_without_numbers_bad_frames_are_what_is_known_to_be_missing():
    order = FrameClock()
    assert place(order, None, 0, 0).after == ""
    assert place(order, None, 1e6, 2) == (1.0, 1.0, 0, 2, "gap")


@pytest.mark.parametrize("counted", [True, False])
def test_frames_in_one_tick_are_spread_by_their_rate(counted):
    clock, period = FrameClock(1e-3), 0.4  # ms
    placed = [place(clock, n if counted else None, int(n * period)) for n in range(1000)]
    times = np.array([position.t for position in placed])
    assert {position.after for position in placed} == {""}
    assert (np.diff(times) > 0).all()
    assert (np.abs(times - 1e-3 * period * np.arange(1000)) < 1e-3).all()


def test_the_hosts_clock_sees_through_delays_and_a_slow_resonator():
    clock, worst = FrameClock(), 0.0
    latest = float("-inf")
    for number in range(4000):
        true = 100 + number * 0.01
        slow = (true - 100) * 0.995  # slow by 0.5 %
        delay = 0.001 + 0.015 * (number * 7919 % 16) / 16
        mapped = clock.place(number, 1e6 * slow, true + delay).t_host
        worst = max(worst, abs(mapped - true - 0.001))
        assert latest <= mapped <= true + delay + 1e-9
        latest = mapped
    assert worst < 0.021


@pytest.mark.parametrize("burst", [0.01, 0.25, 1.0])
@pytest.mark.parametrize("rate", [None, 100.0])
def test_the_number_of_frames_tells_their_time_where_the_device_tells_none(burst, rate):
    clock, count = FrameClock(), round(burst * 100)
    times = [
        [clock.place(None, None, 5 + arrival * burst, rate=rate).t for _ in range(count)]
        for arrival in range(round(12 / burst))
    ]
    late = np.diff(np.concatenate(times)[600:])
    assert (late >= 0).all()
    assert np.median(late) == pytest.approx(0.01, rel=0.05)
    # Nothing is measured after it arrived.
    assert all(row[-1] <= 5 + number * burst + 1e-9 for number, row in enumerate(times))


def test_a_pause_of_the_device_is_no_burst():
    clock = FrameClock()
    for number in range(400):
        before = clock.place(None, None, number / 100).t
    assert clock.place(None, None, 10.0).t == pytest.approx(10.0)
    assert before == pytest.approx(3.99, abs=0.05)
