"""Whether the device's clock is trusted, and what changes where the host's rules."""

import numpy as np
import pytest

from skin.wire.decoder import Decoder
from skin.wire.protocol import Header, encode_header, encode_line

RATE = 100  # Hz
DISTRUST = "cannot be trusted"


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
def test_the_host_rules_where_the_clock_disagrees(clock, each):
    decoder = Decoder(4)
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
def test_the_clock_is_trusted_where_it_agrees(arrival, each):
    decoder = Decoder(4)
    frames = play(decoder, lambda t: t, 16, arrival, each)
    assert DISTRUST not in decoder.stats.clock
    assert (frames[-1][0].segment, frames[-1][0].t) == (0, pytest.approx(16, abs=0.02))


def test_a_suspended_host_is_no_fault_of_the_clock():
    """It was away for a minute: first the old frames of the buffer come, then those of now."""
    decoder = Decoder(4)
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


def test_a_device_that_restarts_is_compared_anew():
    decoder = Decoder(4)
    play(decoder, lambda t: t % 1.5, 20, counter=lambda number: number % 150)
    assert DISTRUST not in decoder.stats.clock
    assert decoder.stats.resets == 13


def test_a_counter_that_stands_still_restarts_nothing():
    decoder = Decoder(4)
    frames = play(decoder, lambda t: t, 5, counter=lambda number: min(number, 200))
    assert (len(frames), decoder.stats.resets, decoder.stats.lost) == (500, 0, 0)


CHANGES = [
    (Header(n=4, unit="N", bits=10, id="left"), "unit=adc -> N"),
    (Header(n=4, unit="adc", bits=8, id="left"), "bits=10 -> 8"),
    (Header(n=4, unit="adc", bits=10, id="right"), "id=left -> right"),
    (Header(n=5, unit="adc", bits=10, id="left"), "n=4 -> 5"),
    (Header(n=4, unit="adc", bits=10, id="left", rate=50), "rate=None -> 50.0"),
]
FIRST = Header(n=4, unit="adc", bits=10, id="left")


@pytest.mark.parametrize(("header", "change"), CHANGES)
def test_a_header_that_changes_ends_the_reading(header, change):
    """On an open connection the device was flashed or exchanged: its frames do not count any more."""
    decoder = Decoder(4)
    assert play(decoder, lambda t: t, 3, header=encode_header(FIRST))
    assert play(decoder, lambda t: t, 3, begin=3, header=encode_header(header)) == []
    assert change in decoder.stats.trouble
    assert decoder.error() is None
    play(decoder, lambda t: t, 4, begin=6, header=encode_header(header))
    assert change in str(decoder.error())


def test_a_header_that_was_damaged_once_costs_frames_until_the_next():
    decoder = Decoder(4)
    play(decoder, lambda t: t, 3, header=encode_header(FIRST))
    assert play(decoder, lambda t: t, 3, begin=3, header=encode_header(CHANGES[1][0])) == []
    assert len(play(decoder, lambda t: t, 9, begin=6, header=encode_header(FIRST))) == 900
    assert decoder.error() is None
    assert decoder.header == FIRST
