"""Numbers and clocks followed by hand; whether the device's clock is trusted, and what changes where not."""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.resampling import FrameError
from skin.wire.clocks import FrameClock
from skin.wire.decoder import Decoder
from skin.wire.protocol import Header, encode_header, encode_line, frames_ahead

RATE = 100  # Hz
DISTRUST = "cannot be trusted"
FIRST = Header(n=4, unit="adc", bits=10, id="left")
OTHER = Header(n=5, unit="N", bits=8, id="right", rate=50)
CHANGES = "n=4 -> 5, rate=None -> 50.0, unit=adc -> N, bits=10 -> 8, id=left -> right"


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [(4, 5, 1), (4, 9, 5), (5, 5, 0), (5, 4, 0), (65535, 0, 1), (65530, 4, 10), (2**32 - 1, 1, 2), (9, 0, 0)],
)
def test_steps_across_the_wraps_of_firmware(before, after, expected):
    assert frames_ahead(before, after) == expected


@pytest.fixture
def clock():
    return FrameClock()


def place(clock, seq, ticks, missing=0):
    """Place a frame that arrives when the device sends it."""
    return clock.place(seq, ticks, ticks * clock.unit, missing)


def test_a_missing_number_is_a_gap_and_no_segment(clock):
    placed = [place(clock, seq, 1000 * seq, 0) for seq in (7, 8, 11, 12)]
    assert [(place.lost, place.after, place.segment) for place in placed] == [
        (0, "", 0), (0, "", 0), (2, "gap", 0), (0, "", 0),
    ]  # fmt: skip


def test_the_clock_wraps_after_71_6_minutes_and_time_goes_on():
    clock, period = FrameClock(), 10_000
    first = 2**32 - 3 * period
    placed = [place(clock, seq, (first + seq * period) % 2**32, 0) for seq in range(8)]
    assert [place.t for place in placed] == pytest.approx([(first + seq * period) * 1e-6 for seq in range(8)])
    assert {place.after for place in placed} == {""}


@pytest.mark.parametrize(
    ("seq", "t_us"), [(0, 0), (0, 5_000_000), (102, 4_000), (3, 900_000)], ids=["both", "seq", "time", "back"]
)
def test_going_back_is_a_new_segment(clock, seq, t_us):
    place(clock, 100, 1_000_000, 0)
    place(clock, 101, 1_010_000, 0)
    placed = place(clock, seq, t_us, 0)
    assert (placed.after, placed.segment, placed.lost, placed.t) == ("reset", 1, 0, t_us * 1e-6)
    assert place(clock, seq + 1, t_us + 1, 0).after == ""


def test_the_same_frame_once_more_is_refused(clock):
    place(clock, 1, 10, 0)
    with pytest.raises(FrameError, match="repeat"):
        place(clock, 1, 10, 0)
    assert place(clock, 2, 20, 0).after == ""


def test_without_numbers_bad_frames_are_what_is_known_to_be_missing(clock):
    assert place(clock, None, 0, 0).after == ""
    frame = place(clock, None, 1e6, 2)
    assert (frame.t, frame.segment, frame.lost, frame.after) == (1.0, 0, 2, "gap")


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


def test_a_pause_of_the_device_is_no_burst(clock):
    for number in range(400):
        before = clock.place(None, None, number / 100).t
    assert clock.place(None, None, 10.0).t == pytest.approx(10.0)
    assert before == pytest.approx(3.99, abs=0.05)


def play(decoder, clock, seconds, arrival=lambda t: t, each=1, begin=0.0, header=b"", counter=int):
    """Feed frames that carry ``clock(t)``, s; return them, with the host's time at which each was fed."""
    frames, waiting = [], header
    first = round(begin * RATE)
    for number in range(first, first + round(seconds * RATE)):
        t = number / RATE
        waiting += encode_line([5, number % 7, 7, 8], counter(number), round(1e6 * clock(t)) % 2**32)
        if (number + 1) % each == 0:
            frames += [(frame, arrival(t)) for frame in decoder.feed(waiting, arrival(t))]
            waiting = b""
    return frames


@pytest.mark.parametrize(
    "clock",
    [
        lambda t: min(t, 4.0) + 1e-4 * max(0.0, t - 4.0),  # creeps by 1 us a frame
        lambda t: min(t, 4.0),  # stands still
        lambda t: t / 30,
        lambda t: 1e-6 * RATE * t,  # counts frames
        lambda t: 3 * t,
        lambda t: float(int(t)),  # whole seconds
        lambda t: int(4 * t) / 4,  # the time of each packet
    ],
)
@pytest.mark.parametrize("each", [1, 25, 100])
def test_the_host_rules_where_the_clock_disagrees(decoder, clock, each):
    frames = play(decoder, clock, 16, each=each)
    assert DISTRUST in decoder.stats.clock
    assert decoder.stats.resets == 1
    late = [frame for frame, arrived in frames if arrived > 10]
    assert len({frame.segment for frame in late}) == 1
    # Frames of a burst are spread.
    assert np.diff([frame.t for frame in late]) == pytest.approx(1 / RATE, abs=0.2 / RATE)


@pytest.mark.parametrize("each", [1, 25, 100])
@pytest.mark.parametrize(
    "arrival",
    [
        lambda t: t,
        lambda t: t / 1.9,
        lambda t: t / 0.55,
        lambda t: max(t, 9.0) if t > 3 else t,  # the bridge was silent for six seconds
    ],
)
def test_the_clock_is_trusted_where_it_agrees(decoder, arrival, each):
    frames = play(decoder, lambda t: t, 16, arrival, each)
    assert DISTRUST not in decoder.stats.clock
    assert (frames[-1][0].segment, frames[-1][0].t) == (0, pytest.approx(16, abs=0.02))


def test_a_suspended_host_is_no_fault_of_the_clock(decoder):
    """It was away for a minute: first the old frames of the buffer come, then those of now."""
    play(decoder, lambda t: t, 5)
    play(decoder, lambda t: t, 0.8, lambda t: 65.0, 80, begin=5)
    frames = play(decoder, lambda t: t, 5, begin=65)
    assert DISTRUST not in decoder.stats.clock
    assert frames[-1][0].t == pytest.approx(70, abs=0.02)


def test_a_replay_states_its_speed():
    header = encode_header(Header(n=4, rate=RATE, speed=8.0))
    for told, trusted in ((header, True), (b"", False)):
        decoder = Decoder(4)
        play(decoder, lambda t: t, 40, lambda t: t / 8, header=told)
        assert (DISTRUST not in decoder.stats.clock) is trusted


def test_a_header_that_changes_ends_the_reading(decoder):
    """On an open connection the device was flashed or exchanged: its frames do not count any more."""
    assert play(decoder, lambda t: t, 3, header=encode_header(FIRST))
    assert play(decoder, lambda t: t, 3, begin=3, header=encode_header(OTHER)) == []
    assert CHANGES in decoder.stats.trouble
    assert decoder.error() is None
    play(decoder, lambda t: t, 4, begin=6, header=encode_header(OTHER))
    assert CHANGES in str(decoder.error())


def test_a_header_that_was_damaged_once_costs_frames_until_the_next(decoder):
    play(decoder, lambda t: t, 3, header=encode_header(FIRST))
    assert play(decoder, lambda t: t, 3, begin=3, header=encode_header(replace(FIRST, bits=8))) == []
    assert len(play(decoder, lambda t: t, 9, begin=6, header=encode_header(FIRST))) == 900
    assert decoder.error() is None
    assert decoder.header == FIRST


def test_the_unit_of_a_clock_follows_from_the_host(clock):
    placed = [clock.place(n, 10 * n, n / 100) for n in range(200)]
    assert [position.after for position in placed].count("reset") == 1
    assert (clock.unit, clock.confirmed) == (1e-3, True)
    assert np.diff([position.t for position in placed[-5:]]) == pytest.approx(0.01)


def test_where_the_unit_of_the_user_contradicts_the_hosts_clock_that_rules():
    clock, stopped = FrameClock(1e-6, fixed=True), []
    for n in range(400):
        clock.place(n, 10 * n, 0.01 * n)
        clock.judge(0.01 * n)
        stopped.append(clock.trusted)
    assert clock.unit == 1e-6
    assert stopped[0]
    assert not stopped[-1]


@pytest.mark.parametrize("modulus", [16, 37, 100, 256, 1000, 4096])
@pytest.mark.parametrize("clocked", [True, False])
def test_a_counter_wraps_at_any_modulus_and_losses_are_counted(clock, modulus, clocked):
    sent = [n for n in range(5 * modulus) if n % 91 != 17]
    placed = [clock.place(n % modulus, 10_000 * n if clocked else None, n / 100) for n in sent]
    resets = sum(position.after == "reset" for position in placed)
    if clocked:
        lost = sum(position.lost for position in placed)
        assert (resets, lost) == (0, sent[-1] + 1 - sent[0] - len(sent))
    else:
        assert (resets > 1) == (modulus == 37)  # firmware counts in no such number
    assert clock.modulus == (modulus if clocked or modulus != 37 else None)


def test_a_restart_is_no_wrap(clock):
    for n in range(300):
        clock.place(n, 10_000.0 * n, n / 100)
    assert clock.place(0, 10_000.0 * 400, 4.0).after == "reset"  # the counter after a pause
    assert clock.place(1, 0.0, 4.1).after == "reset"  # the clock
