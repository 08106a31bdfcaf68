"""Numbers and clocks followed by hand."""

import numpy as np
import pytest

from skin.device.resampling import FrameError
from skin.wire.clocks import FrameClock, HostClock, SequenceTracker
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


def test_a_missing_number_is_a_gap_and_no_segment():
    order = SequenceTracker()
    placed = [order.place(seq, 1000 * seq, 0) for seq in (7, 8, 11, 12)]
    assert [(place.lost, place.after, place.segment) for place in placed] == [
        (0, "", 0), (0, "", 0), (2, "gap", 0), (0, "", 0),
    ]  # fmt: skip


def test_the_clock_wraps_after_71_6_minutes_and_time_goes_on():
    order, period = SequenceTracker(), 10_000
    first = 2**32 - 3 * period
    placed = [order.place(seq, (first + seq * period) % 2**32, 0) for seq in range(8)]
    assert [place.t for place in placed] == pytest.approx([(first + seq * period) * 1e-6 for seq in range(8)])
    assert {place.after for place in placed} == {""}


@pytest.mark.parametrize(
    ("seq", "t_us"), [(0, 0), (0, 5_000_000), (102, 4_000), (3, 900_000)], ids=["both", "seq", "time", "back"]
)
def test_going_back_is_a_new_segment(seq, t_us):
    order = SequenceTracker()
    order.place(100, 1_000_000, 0)
    order.place(101, 1_010_000, 0)
    placed = order.place(seq, t_us, 0)
    assert (placed.after, placed.segment, placed.lost, placed.t) == ("reset", 1, 0, t_us * 1e-6)
    assert order.place(seq + 1, t_us + 1, 0).after == ""


def test_the_same_frame_once_more_is_refused():
    order = SequenceTracker()
    order.place(1, 10, 0)
    with pytest.raises(FrameError, match="repeat"):
        order.place(1, 10, 0)
    assert order.place(2, 20, 0).after == ""


def test_without_numbers_bad_frames_are_what_is_known_to_be_missing():
    order = SequenceTracker()
    assert order.place(None, 0, 0).after == ""
    assert order.place(None, 1e6, 2) == (1.0, 0, 2, "gap")


def test_the_hosts_clock_sees_through_delays_and_a_slow_resonator():
    clock, worst = HostClock(), 0.0
    latest = float("-inf")
    for number in range(4000):
        true = 100 + number * 0.01
        told = (true - 100) * 0.995  # slow by 0.5 %
        delay = 0.001 + 0.015 * (number * 7919 % 16) / 16
        mapped = clock(told, true + delay)
        worst = max(worst, abs(mapped - true - 0.001))
        assert latest <= mapped <= true + delay + 1e-9
        latest = mapped
    assert worst < 0.021


@pytest.mark.parametrize("burst", [0.01, 0.25, 1.0])
@pytest.mark.parametrize("rate", [None, 100.0])
def test_the_number_of_frames_tells_their_time_where_the_device_tells_none(burst, rate):
    clock, count = FrameClock(), round(burst * 100)
    times = [
        [clock(5 + arrival * burst, 1, rate) for _ in range(count)] for arrival in range(round(12 / burst))
    ]
    late = np.diff(np.concatenate(times)[600:])
    assert (late >= 0).all()
    assert np.median(late) == pytest.approx(0.01, rel=0.05)
    # Nothing is measured after it arrived.
    assert all(row[-1] <= 5 + number * burst for number, row in enumerate(times))


def test_a_pause_of_the_device_is_no_burst():
    clock = FrameClock()
    for number in range(400):
        before = clock(number / 100, 1, None)
    assert clock(10.0, 1, None) == 10.0
    assert before == pytest.approx(3.99, abs=0.05)
