"""The live view and a recording of the same stream give the same answers, bit for bit."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from skin import Grid, read_recording
from skin.device.touches import Touches
from skin.live.engine import Detection, Engine
from skin.live.loop import Display, LiveLoop
from skin.record.serial import Serial, convert_session, record_session
from skin.runs.build import TorchModel, build_data, build_device, build_learner
from skin.touch.labels import TOUCH
from skin.wire.clocks import FrameClock
from skin.wire.decoder import Decoder
from skin.wire.protocol import Announcement, Header, encode_announcement, encode_header, encode_line
from skin.wire.reader import WireFeed
from skin.wire.tare import Tare
from tests.made_up import SHEET
from tests.wire.memory import Sent

LAYOUT = Grid(2, 3)
# A window ends with a frame at a tick, so that it is decided on.
RATE, LENGTH, IDLE, GESTURES = 50, 150, 151, 3
SCALE, LIMIT = 0.01, 700  # N per count; 612 counts are at rest
DEAD = 4


def counts():
    """Return counts (F, 6) of an untouched skin with four presses that drive two sensors to their limit."""
    draw = np.random.default_rng(5)
    values = 200 + draw.integers(-3, 4, (IDLE + GESTURES * (LENGTH + 30) + 60, 6))
    for number in range(GESTURES):
        begin = IDLE + number * (LENGTH + 30) + 40
        press = np.zeros(60)
        press[:50] = np.interp(np.arange(50), [0, 10, 40, 49], [0, 1, 1, 0])
        values[begin : begin + 60, number] += (800 * press).astype(int)
        values[begin : begin + 60, 5] += (200 * press).astype(int)
    values[:, DEAD] = 77
    return np.minimum(values, LIMIT)


def pieces(late=0):
    """Yield the bytes of each frame that arrives; the header comes after ``late`` frames."""
    lost = {IDLE + 50, IDLE + 51, IDLE + 300, *range(IDLE + 460, IDLE + 475)}
    for number, row in enumerate(counts()):
        data = b""
        if number == late:
            data += encode_header(Header(n=6, rate=RATE, unit="adc"))
        gesture, position = divmod(number - IDLE, LENGTH + 30)
        if number >= IDLE and position == 0 and gesture < GESTURES:
            labels = dict.fromkeys(TOUCH.names, gesture % 2)
            data += encode_announcement(Announcement(gesture, number, LENGTH, labels))
        if number not in lost:
            data += encode_line(row.tolist(), number, number * 1_000_000 // RATE)
        if data:
            yield number, data


class Asked:
    """A learner that keeps what it was asked."""

    def __init__(self, learner):
        self.learner, self.windows = learner, []

    def probabilities(self, touches):
        self.windows.append(touches)
        return self.learner.probabilities(touches)


@pytest.fixture(scope="module")
def learner(configured):
    """Return rules that were fitted to a skin with as many sensors."""
    settings = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=3", "data.gestures=400"]
    config = configured("experiment=rules", *settings)
    found = build_learner(config)
    found.fit(build_data(config, build_device(config)))
    return found


def serial(**settings):
    settings = {"limits": [None, LIMIT], "gestures": GESTURES} | settings
    return Serial(body=SHEET, layout=LAYOUT, port="memory", scale=SCALE, timeout=5.0, **settings)


@pytest.fixture
def sent(monkeypatch):
    """Return a function that lets ports read pieces (number, bytes)."""

    def send(stream):
        pieces = [data for _, data in stream]
        monkeypatch.setattr("skin.wire.skin.PortStream", lambda *port: Sent(*pieces))

    monkeypatch.setattr(FrameClock, "judge", lambda *given: False)  # the stream comes as fast as it is read
    return send


def live(learner, stream):
    """Return the window and the verdict of the live view at each frame, by its number."""
    device, asked, found = serial(), Asked(learner), {}
    positions = torch.from_numpy(device.sensors.positions).float()
    example = Touches(torch.zeros(1, 30, 6), torch.ones(1, 30, 6) > 0, positions, None, 10.0)
    engine = Engine(TorchModel(device, asked, example).probabilities, TOUCH, 6, 30, 10.0, Detection(0.3))

    class Taking(Display):
        def set_verdict(self, verdict, *others):
            super().set_verdict(verdict, *others)
            if verdict is not None:
                found[round(verdict.t * RATE)] = asked.windows[-1], verdict

    decoder = Decoder(6)
    feed = WireFeed(lambda: None, decoder, (None, LIMIT))
    skin = SimpleNamespace(stats=decoder.stats, header=None, channels=())
    display = Taking("rules", "memory", positions.numpy(), device.size, 4.0)
    loop = LiveLoop(skin, Tare(device.wire.convert, 2.0, 10.0), engine, display)
    for number, data in stream:
        if frames := feed.decode(data, number / RATE):
            loop.take(frames, number / RATE)
    return found


def recorded(learner, path):
    """Return the recording of the stream that is sent, and what the learner says of it."""
    device = serial()
    record_session(device, path, None, False, lambda text: None)
    touches = read_recording(convert_session(device, path)[0]).touches
    return touches, learner.probabilities(touches)


def test_live_and_recorded_are_the_same_to_the_last_bit(learner, tmp_path, sent):
    said = live(learner, pieces())
    sent(pieces())
    touches, probabilities = recorded(learner, tmp_path / "s")
    assert len(touches) == GESTURES
    for gesture in range(GESTURES):
        last = IDLE + gesture * (LENGTH + 30) + LENGTH - 1
        window, verdict = said[last]
        assert torch.equal(window.readings[0], touches.readings[gesture])
        assert torch.equal(window.valid[0], touches.valid[gesture])
        assert list(verdict.probabilities.values()) == probabilities[gesture].tolist()
        # The sensor at its limit is valid and says its limit; the dead one is not.
        limit = (LIMIT - 200) * SCALE
        assert touches.readings[gesture, :, gesture].max() == pytest.approx(limit, abs=5 * SCALE)
        assert touches.saturated[gesture, :, gesture].any()
        assert touches.valid[gesture][touches.saturated[gesture]].all()
        # That the sensor is dead shows after five seconds.
        assert gesture == 0 or not touches.valid[gesture, :, DEAD].any()


def test_the_header_counts_whenever_it_comes_and_given_limits_win_over_it(sent):
    """At most 1023: with the header after frame 5 as with the header before frame 0."""
    for late, limits, expected in ((0, None, 30), (5, None, 30), (40, None, 30), (3, [None, 2000.0], 0)):
        sent(_adc(late))
        with serial(limits=limits, gestures=1).wire.open() as skin:
            frames = skin.read(200, 10)
            assert (skin.header.bits, skin.stats.bad_frames) == (10, 0)
        saturated = np.array([frame.saturated for frame in frames[50:]]).sum(axis=0)
        assert saturated.tolist() == [0, 0, expected, 0, 0, 0]
        assert all(frame.valid.all() for frame in frames)


def _adc(late):
    values = 500 + np.random.default_rng(0).integers(-3, 4, (200, 6))
    values[100:130, 2] = 1023
    for number, row in enumerate(values):
        header = encode_header(Header(n=6, unit="adc", bits=10)) if number == late else b""
        yield number, header + encode_line(row.tolist(), number, number * 20_000)
