"""Streams of boards that restart, freeze, break or come in bursts: no dangerous touch is hidden or late."""

import re
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from skin import InputError
from skin.live.engine import DebounceSettings, Detection, Engine
from skin.live.engine_builder import SelfTest
from skin.live.loop import STALE, Display, LiveLoop
from skin.touch.labels import TOUCH
from skin.wire.channels import RawRange, UnitConversion
from skin.wire.decoder import Decoder
from skin.wire.emulator import Emulator, EmulatorSettings
from skin.wire.protocol import Header, encode_header, encode_line
from skin.wire.reader import Port, SkinDisconnected, SkinTimeout
from skin.wire.skin import SerialSource
from skin.wire.tare import Tare
from tests.live.memory_view import MemoryView
from tests.made_up import naive_skin

RATE, SENSORS = 100, 9
HEADER = encode_header(Header(n=SENSORS, rate=RATE, unit="N"))
COUNTS = encode_header(Header(n=SENSORS, rate=RATE, unit="adc", bits=10))
SCALE = 0.02  # N per count


def loud(readings, valid):
    """Return probabilities: a touch is dangerous where a reading exceeds 4 N."""
    return np.repeat((readings.max(axis=(1, 2)) > 4)[:, None], 4, axis=1).astype(float)


def settings():
    presses = 5.0 * np.eye(SENSORS)
    return Engine(loud, TOUCH, SENSORS, 30, 10.0, Detection(0.3), DebounceSettings(), presses)


def force(seconds, *touches):
    """Return readings (F, S), N, with noise; touches are (begin s, end s, sensor, N)."""
    values = np.random.default_rng(0).normal(scale=0.02, size=(round(seconds * RATE), SENSORS))
    for begin, end, sensor, newtons in touches:
        values[round(begin * RATE) : round(end * RATE), sensor] += newtons
    return values


def counted(row):
    """Return the counts of readings, N, by a converter of 10 bits."""
    return np.clip(np.round(200 + row / SCALE), 0, 1023).astype(int)


def lines(values, restart=None, header=HEADER, encode=lambda row: row.round(4)):
    """Yield the bytes of each frame; the device restarts every ``restart`` s, with its counter and clock."""
    every = len(values) if restart is None else round(restart * RATE)
    for number, row in enumerate(values):
        first = number % every
        data = b"" if first else header
        yield data + encode_line(encode(row), first, 10_000 * first)


def arriving(stream, each=1):
    """Yield (s, bytes) of the bytes of frames, some at a time; a number is a pause, s."""
    now, waiting, number = 0.0, b"", 0
    for data in stream:
        if isinstance(data, float):
            now += data
            continue
        number, waiting, now = number + 1, waiting + data, now + 1 / RATE
        if number % each == 0:
            yield now, waiting
            waiting = b""


def watch(stream, each=1, engine=None, verify=None, inwards=False, **port):
    """Return the live view of the bytes of frames."""
    return MemoryView(arriving(stream, each), engine or settings(), verify, inwards, **port)


@pytest.mark.parametrize("broken", ["nothing", "saturated", "dead", "frozen", "touched"])
def test_what_channels_along_the_surface_do_changes_no_verdict(broken):
    """A normal channel at its limit and one that dies count as on a skin without the other channels."""
    values = force(12, (6, 7, 4, 6.0), (9, 10, 8, 6.0))
    values[:, 2], values[300:, 7] = 50.0, -4.0
    along = np.random.default_rng(1).normal(scale=0.02, size=(len(values), SENSORS, 2))
    along[600:700, 4] += [1.0, -2.0]
    along = {
        "nothing": along,
        "saturated": along + 50.0,
        "dead": along * 0 - 4.0,
        "frozen": np.where(np.arange(len(values))[:, None, None] > 500, 1.0, along),
        "touched": along + 3 * np.sin(np.arange(len(values)))[:, None, None],
    }[broken]
    every = np.concatenate([along, values[..., None]], axis=2).reshape(len(values), -1)
    alone = watch(lines(values, header=COUNTS, encode=counted), scale=SCALE)
    header = encode_header(Header(n=3 * SENSORS, rate=RATE, unit="adc", bits=10))
    seen = watch(lines(every, header=header, encode=counted), inwards=True, scale=SCALE)
    assert seen.said == alone.said
    assert 6 <= seen.first(3) <= 6.5 + LATE
    assert list(map(vars, seen.looks)) == list(map(vars, alone.looks))
    tangential = seen.display.contacts.tangential
    assert broken != "nothing" or np.abs(tangential).max() < 0.2


class Paced:
    """A skin whose clock goes on while it is read."""

    away, channels = False, ()

    def __init__(self, stream):
        self.now, self._stream, self.decoder = 0.0, list(arriving(stream)), Decoder(SENSORS)
        self.stats = self.decoder.stats

    def read(self, count, timeout):
        end = self.now + timeout
        while self._stream and self._stream[0][0] <= end:
            self.now, data = self._stream.pop(0)
            if frames := self.decoder.feed(data, self.now):
                return frames
        if not self._stream:
            raise SkinDisconnected("the stream has ended")
        self.now = end
        raise SkinTimeout("0 of 1 frames arrived within 0.3 s: the device stopped sending")


LATE = 0.02  # s: a frame, and the interval between decisions is in the limits


def test_a_channel_at_its_limit_is_not_tared():
    """All at the limit: there is no baseline. One: its place is unknown, and a press on others is found."""
    full = np.full((600, SENSORS), 1023.0)
    seen = watch(lines(full, header=COUNTS, encode=lambda row: row.astype(int)), scale=SCALE)
    reasons = {reason for _, _, reason, _ in seen.said}
    assert "no baseline: all channels at the limit or without a value" in reasons
    assert seen.states(0, 6) == {"unknown"}
    values = force(12, (6, 7, 4, 6.0))
    values[:, 2] = 50.0
    seen = watch(lines(values, header=COUNTS, encode=counted), scale=SCALE)
    assert seen.states(4, 5.9) == {"unknown"}
    assert {verdict.unknown for at, verdict, _, _ in seen.said if verdict and at > 4} == {(2,)}
    assert "channel 2 at the limit" in seen.loop.line
    assert 6 <= seen.first(3) <= 6.5 + LATE


def test_bursts_without_a_clock_are_decided_like_single_frames():
    """A radio bridge: only values, in bursts. The delay of delivery is all that is added."""
    rows = force(8, (6, 7, 4, 6.0))
    stream = [(",".join(f"{value:.4f}" for value in row) + "\n").encode() for row in rows]
    for burst in (0.25, 0.5, 1.0):
        seen = watch(stream, each=round(burst * RATE), scale=1.0)
        assert 6 <= seen.first(3) <= 6 + burst + 0.1 + 0.25
        assert "no touch" in seen.states(4, 6)
        assert not seen.kept(3, 6)


def test_silence_is_unknown_after_a_second_and_a_half():
    """In the loop as it runs; frames stop at 4 s."""
    skin, said = Paced([*lines(force(4)), 3.0, *lines(force(1))]), []
    tare = Tare(SerialSource(Port(), SENSORS, 10.0).convert, 2.0, 10.0, lambda: skin.decoder.header)
    display = Display("loud", "memory", np.zeros((SENSORS, 3)), (0.1, 0.1), 4.0)
    display.observers.append(lambda assessment, now, event: said.append((now, assessment)))
    LiveLoop(skin, tare, settings(), display, clock=lambda: skin.now).run()
    silent = [(now, one.verdict) for now, one in said if "stopped sending" in one.reason]
    assert {verdict for _, verdict in silent} == {None}
    assert 5.5 <= silent[0][0] <= 5.9
    assert silent[-1][0] > 6.5


def test_what_came_before_a_silence_is_no_verdict_of_now():
    """A press of the last two frames, which nothing has decided: its alarm is kept, and is stale."""
    seen = watch([*lines(force(4.03, (4.01, 4.03, 4, 6.0))), STALE + 1, *lines(force(6, (0, 1, 4, 6.0)))])
    assert all(t - verdict.t_host < STALE for t, verdict, _, _ in seen.said if verdict)
    told = [(verdict, on) for _, verdict, reason, on in seen.said if "1.5 s old" in reason]
    assert told == [(None, True)]
    assert seen.states(4.8, 6.5) == {"unknown"}
    assert seen.kept(6.6, 7.5)


@pytest.mark.parametrize("slow", [0.0, 1.0])  # s that a decision takes
def test_an_alarm_of_frames_that_came_late_is_shown_as_long_as_others(slow):
    """The touch was over before anybody could see it."""
    values = force(14, (5, 5.5, 4, 6.0))
    stream = [(data, n / RATE) for n, data in enumerate(lines(values))]
    late = ((max(t, 8.5) if t > 4.9 else t, data) for data, t in stream)
    seen = MemoryView(late, settings(), clock=count(0.0, slow).__next__)
    assert seen.first(4) == 8.5 + slow
    assert seen.kept(8.5, 10.45 + slow)
    during = [look for look in seen.looks if 8.6 < look.t < 10.4]
    assert {look.danger for look in during} == {True}
    assert "safe" not in {word for look in during for word in look.words}
    assert not seen.kept(10.6 + slow, 14)


def test_a_touch_is_never_shown_as_no_touch():
    """Not even before it has lasted long enough for its labels."""
    seen = watch(lines(force(12, (6, 8, 4, 2.0))))
    touching = [verdict.state for _, verdict, _, _ in seen.said if verdict and verdict.contact is not None]
    assert set(touching) == {"touch"}


@pytest.mark.parametrize(("fault", "late"), [("stuck", 5.5), ("dead", 0.5)])
def test_a_channel_of_an_emulated_skin_that_fails_at_rest_or_later_is_unknown_and_named(fault, late):
    """From 8 s on; touches begin at 14 s."""
    written = []
    port = SimpleNamespace(write=lambda data: written.append(data) or len(data), connected=lambda: True)
    emulator = Emulator(
        naive_skin(), port, EmulatorSettings(speed=200.0, idle=14.0, since=8.0, **{fault: [4]})
    )
    emulator.run(19.0)
    frames = re.findall(rb"(?m)^\d.*\n", b"".join(written))
    seen = watch(frames, scale=emulator.converter.scale)
    assert seen.states(4, 8) == {"no touch"}
    assert seen.states(8 + late, 14) == {"unknown"}
    assert "no touch" not in seen.states(14, 19)
    assert "sensor 4 stuck" in seen.loop.line


COUNTED = RawRange(0.0, 1023.0, True, (None, 1023.0))
RESTS = np.full(SENSORS, 200.0)


def conversion(scale=SCALE, broken=0):
    """Return a conversion of counts whose first sensors are broken."""
    return UnitConversion(np.broadcast_to(scale, SENSORS), RESTS, np.arange(SENSORS) < broken)


def selftest(used=None, converted=None, device=COUNTED, nominal=None, presses=None, **limits):
    """Run the settings of a live view against simulated presses; return what is reported."""
    nominal, said = nominal or settings(), []
    presses = 4.0 * np.eye(SENSORS) if presses is None else presses
    test = SelfTest(presses, used or nominal, nominal, **limits)
    test.run(converted or conversion(), device, said.append)
    return said


def detecting(**changes):
    return replace(settings(), detection=replace(settings().detection, **changes))


def patient(engine=None, **changes):
    engine = engine or settings()
    return replace(engine, patience=replace(engine.patience, **changes))


def test_nominal_settings_pass():
    nominal = r"self-test: 14 of 14 dangerous presses raise the alarm; only its range tests the scale"
    assert re.match(nominal, *selftest())
    assert "its scale is not checked" in selftest(device=RawRange())[0]
    selftest(patient(above=0.9999999))
    # Its place is shown as unknown.
    one = UnitConversion(np.full(SENSORS, SCALE), RESTS, np.arange(SENSORS) == 4)
    assert "14 with nominal settings; not on sensor 4" in selftest(converted=one)[0]


DEVICE = r"device\.limits, device\.scale or device\.calibration is most likely"
FEW = np.diag(np.where(np.arange(SENSORS) < SENSORS // 3, 4.0, 1e-3))
ONE = np.where(np.arange(SENSORS) == 3, 1e-9, SCALE)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"used": detecting(threshold=1000.0)}, r"live\.touch is most likely wrong.*live\.selftest=false"),
        ({"used": detecting(drift=1e9 / 600)}, r"live\.drift is most likely wrong.*live\.selftest=false"),
        ({"presses": FEW}, "even with nominal settings: train another run"),
        *(({"converted": conversion(scale), "slowly": 1}, DEVICE) for scale in (1e-9, 1e-300, 1e9, 2e-8)),
        ({"converted": conversion(ONE)}, "sensor 3 cannot raise it"),
        ({"converted": conversion(broken=3)}, r"9 of 14 .* 3 of 9 sensors have no valid reading .*: they"),
        ({"nominal": detecting(threshold=1e308)}, "the contact threshold of the model"),
    ],
)
def test_what_blinds_is_refused_and_named(changes, named):
    with pytest.raises(InputError, match=named):
        selftest(**changes)


def soft(readings, valid):
    """As a network, which is nearly certain of strong touches, and less so of those just above the limit."""
    danger = 1 / (1 + np.exp(-8 * (readings.max(axis=(1, 2)) - 4.0)))
    return np.repeat(danger[:, None], 4, axis=1)


def test_a_threshold_that_only_strong_touches_exceed_is_named():
    nominal = replace(settings(), classify=soft)
    for above in (0.1, 0.99):
        selftest(patient(nominal, above=above), nominal=nominal)
    with pytest.raises(InputError, match=r"0 of 14 .* 14 with .* live\.patience\.above=0\.9999 is most"):
        selftest(patient(nominal, above=0.9999), nominal=nominal)
