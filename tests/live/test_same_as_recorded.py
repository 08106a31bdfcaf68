"""The live view and a recording of the same stream give the same answers, bit for bit."""

import socket
from threading import Event, Thread

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.device.files import read_recording
from skin.live.engine import Detection, Engine
from skin.live.loop import Display, DisplayInfo, LiveLoop
from skin.record.recorder import convert_session, record_session
from skin.record.serial import Serial
from skin.runs.build import build_data, build_device, build_learner
from skin.runs.torch_model import window_classifier
from skin.touch.labels import TOUCH
from skin.wire.clocks import ClockWatch
from skin.wire.protocol import (
    Announcement,
    Header,
    encode_announcement,
    encode_comment,
    encode_frame,
    encode_header,
    encode_line,
)

SHEET = Sheet((0.16, 0.16), (32, 32), [{"material": "EcoFlex 00-30", "thickness": 0.005}])
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
        gesture, place = divmod(number - IDLE, LENGTH + 30)
        if number >= IDLE and place == 0 and gesture < GESTURES:
            data += encode_announcement(
                Announcement(gesture, number, LENGTH, dict.fromkeys(TOUCH.names, gesture % 2))
            )
        if number not in lost:
            data += encode_line(row.tolist(), number, number * 1_000_000 // RATE)
        if data:
            yield number, data


class Listener:
    """A socket that a skin is read from; sends a piece, and the next one when it is let."""

    def __init__(self, stream, wait):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = f"socket://127.0.0.1:{self.server.getsockname()[1]}"
        self.thread = Thread(target=self._run, args=(stream, wait), daemon=True)
        self.thread.start()

    def _run(self, stream, wait):
        client, _ = self.server.accept()
        with client:
            for number, data in stream:
                client.sendall(data)
                wait(number)

    def close(self):
        self.thread.join(20)
        self.server.close()


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


def serial(port, **settings):
    limits = [None, LIMIT]
    return Serial(
        body=SHEET, layout=LAYOUT, port=port, gestures=GESTURES, scale=SCALE, limits=limits, **settings
    )


def watched(learner, device):
    """Run the live view on a device until its peer leaves; return time -> (window, verdict)."""
    skin, _ = device.wire.open()
    positions = torch.from_numpy(device.sensors.positions).float()
    asked, found = Asked(learner), {}
    engine = Engine(
        window_classifier(asked, positions, 10.0), TOUCH, len(positions), 30, 10.0, Detection(0.3)
    )
    info = DisplayInfo("rules", str(device.port), positions.numpy(), device.size, 4.0)
    return skin, engine, asked, info, found


def live(learner, stream):
    """Return what the live view said at each frame, by its number."""
    turn = Event()

    def wait(number):
        assert turn.wait(20), "the live view fell silent"
        turn.clear()

    listener = Listener(stream, wait)
    device = serial(listener.port)
    skin, engine, asked, info, found = watched(learner, device)

    class Taking(Display):
        def set_verdict(self, verdict, trouble="", alarm=False, now=None):
            super().set_verdict(verdict, trouble, alarm, now)
            if verdict is not None:
                found[round(verdict.t * RATE)] = asked.windows[-1], verdict

    class Turning(LiveLoop):
        def take(self, frames, now):
            super().take(frames, now)
            turn.set()

        def _wait(self, reason):
            super()._wait(reason)
            turn.set()

    with skin:
        Turning(skin, device.wire.tare(skin), engine, Taking(info)).run()
    listener.close()
    return found


def recorded(learner, stream, path):
    """Return the recording of the same stream, and what the learner says of it."""
    listener = Listener(stream, lambda number: None)
    device = serial(listener.port, timeout=5.0)
    record_session(device, path, None, False, lambda text: None)
    listener.close()
    touches = read_recording(convert_session(device, path)[0]).touches
    return touches, learner.probabilities(touches)


def test_live_and_recorded_are_the_same_to_the_last_bit(learner, tmp_path, monkeypatch):
    monkeypatch.setattr(ClockWatch, "_SPAN", np.inf)  # the stream comes as fast as it is read
    said = live(learner, pieces())
    touches, chances = recorded(learner, pieces(), tmp_path / "s")
    assert len(touches) == GESTURES
    for gesture in range(GESTURES):
        last = IDLE + gesture * (LENGTH + 30) + LENGTH - 1
        window, verdict = said[last]
        assert torch.equal(window.readings[0], touches.readings[gesture])
        assert torch.equal(window.valid[0], touches.valid[gesture])
        assert list(verdict.chances.values()) == chances[gesture].tolist()
        # The sensor at its limit is valid and says its limit; the dead one is not.
        limit = (LIMIT - 200) * SCALE
        assert touches.readings[gesture, :, gesture].max() == pytest.approx(limit, abs=5 * SCALE)
        assert touches.saturated[gesture, :, gesture].any()
        assert touches.valid[gesture][touches.saturated[gesture]].all()
        # That the sensor is dead shows after five seconds.
        assert gesture == 0 or not touches.valid[gesture, :, DEAD].any()


def test_the_header_counts_whenever_it_comes(tmp_path):
    """At most 1023: with the header after frame 5 as with the header before frame 0."""
    found = []
    for late in (0, 5, 40):
        listener = Listener(_adc(late), lambda number: None)
        device = Serial(body=SHEET, layout=LAYOUT, port=listener.port, scale=SCALE, gestures=1, timeout=5.0)
        with device.wire.open()[0] as skin:
            frames = skin.read(200, 10)
        listener.close()
        found.append([frame.saturated.tolist() for frame in frames[50:]])
        assert all(frame.valid.all() for frame in frames)
    assert found[0] == found[1] == found[2]
    assert np.array(found[0])[:, 2].sum() == 30


def _adc(late, binary=False):
    values = 500 + np.random.default_rng(0).integers(-3, 4, (200, 6))
    values[100:130, 2] = 1023
    for number, row in enumerate(values):
        header = encode_header(Header(n=6, unit="adc", bits=10)) if number == late else b""
        if binary:
            header = encode_comment(encode_header(Header(n=6, unit="adc", bits=10), "none").strip())
            header = header if number == late else b""
            yield number, header + encode_frame(row, number, number * 20_000)
        else:
            yield number, header + encode_line(row.tolist(), number, number * 20_000)


def test_given_limits_win_over_the_header_and_binary_streams_carry_one():
    for limits, count in ((None, 30), ([None, 2000.0], 0)):
        listener = Listener(_adc(3, binary=True), lambda number: None)
        settings = {"scale": SCALE, "gestures": 1, "timeout": 5.0, "limits": limits}
        device = Serial(body=SHEET, layout=LAYOUT, port=listener.port, **settings)
        with device.wire.open()[0] as skin:
            frames = skin.read(200, 10)
            assert skin.header.bits == 10
            assert skin.stats.bad_frames == 0
        listener.close()
        assert sum(frame.saturated[2] for frame in frames) == count
