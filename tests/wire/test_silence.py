"""A device that lost its power never says that it is gone: a socket without data is opened again."""

from itertools import count, islice
from time import monotonic

import numpy as np
import pytest

from skin.errors import InputError
from skin.wire.decoder import Decoder
from skin.wire.protocol import encode_line
from skin.wire.reader import WireFeed
from skin.wire.skin import open_skin
from tests.wire.memory import Sent

LAYOUT = range(4)
PATIENT = 60.0  # s: machines are busy at times
HASTY = {"reconnect": True, "silence": 0.3, "backoff": (0.01, 0.04)}
LINK = "socket://127.0.0.1:1"


def lines(*numbers, values=(500, 501, 502, 503)):
    return b"".join(encode_line(values, number, number * 10_000) for number in numbers)


def polled(pieces, silence, step=0.1):
    """Poll a feed every ``step`` s; return its frames and when it was found silent."""
    feed, times = WireFeed(lambda: Sent(*pieces, end=False, pause=0), Decoder(4), None, silence), count()
    frames = []
    for _ in range(len(pieces) + 20):
        now = step * next(times)
        try:
            frames += feed.poll(lambda now=now: now)
        except TimeoutError:
            return frames, now
    return frames, np.inf


@pytest.mark.parametrize(
    ("pieces", "silence", "found"),
    [
        ([lines(*range(3))], 0.5, 0.5),  # from the last byte on
        ([], 0.5, 0.5),  # from the opening on
        ([lines(0, 1, 2), b"", b"", b"", lines(3), b"", b"", b""], 0.5, 0.9),
        ([piece for n in range(12) for piece in (lines(n), b"", b"", b"")], 0.5, np.inf),  # seldom
        ([lines(*range(3))], np.inf, np.inf),
    ],
)
def test_silence_counts_from_the_last_byte(pieces, silence, found):
    frames, when = polled(pieces, silence)
    last = max((n for n, piece in enumerate(pieces) if piece), default=0)
    assert when == pytest.approx(found if len(pieces) < 40 else 0.1 * last + silence)
    assert len(frames) == sum(piece.count(b"\n") for piece in pieces)


@pytest.mark.parametrize(
    ("address", "settings", "silence"),
    [
        (LINK, {}, 0.3),
        (LINK, {"silence": 0}, np.inf),
        (LINK, {"silence": None}, np.inf),
        (LINK, {"reconnect": False}, np.inf),
        ("/dev/ttyACM0", {}, np.inf),  # the system tells of a serial port that is gone
    ],
)
def test_silence_is_borne_where_that_is_asked_for(address, settings, silence):
    with open_skin(address, LAYOUT, opener=lambda: Sent(end=False), **HASTY | settings) as skin:
        assert skin._feed._silence == silence


def test_a_peer_that_accepts_and_never_sends_is_tried_less_and_less_often():
    """Iterating does not give up although the timeout passes: the skin comes back again and again."""
    streams, times = [Sent(end=False) for _ in range(5)] + [Sent(lines(*range(4)), end=False)], []

    def opener():
        times.append(monotonic())
        return streams[len(times) - 1]

    settings = HASTY | {"silence": 0.02, "backoff": (0.01, 10.0), "timeout": 0.1}
    with open_skin(LINK, LAYOUT, opener=opener, **settings) as skin:
        assert [frame.seq for frame in islice(skin, 4)] == [0, 1, 2, 3]
        assert skin.stats.reconnects == 5
    assert all(stream.closed for stream in streams)
    # 0.02 s of silence, and 0.01, 0.02 ... 0.16 s between two attempts
    assert times[-1] - times[-2] >= 0.17


@pytest.mark.parametrize("silence", [-1, float("nan"), float("inf")])
def test_a_silence_that_is_no_time_is_refused(silence):
    with pytest.raises(InputError, match=r"device\.silence=.* must be .*: as in device.silence=5"):
        open_skin("socket://127.0.0.1:1", silence=silence)
