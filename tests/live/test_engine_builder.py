"""The live view of an exported model: in a process of its own, without torch."""

import json
import re
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import count
from time import monotonic, sleep

import numpy as np
import pytest

from skin import InputError, open_skin
from skin.core.files import ROOT
from skin.device.resampling import Frame
from skin.evaluation.operating_point import OperatingPoint
from skin.learning.network import Network
from skin.live.engine import DebounceSettings
from skin.live.engine_builder import LiveSettings, measured_rate, watch_exported
from skin.runs.onnx_writer import write_model
from skin.wire.channels import unit_conversion
from skin.wire.protocol import Header, encode_header, encode_line
from tests.wire.memory import Sent

pytest.importorskip("onnxruntime")
RATE = 100.0  # Hz, of the device
PATIENCE = 300  # s
EXAMPLE = ROOT / "docs" / "examples" / "onnx_only.py"
LIVE = LiveSettings(0, 4.0, None, 0.2, None, None, None, False, True, DebounceSettings())
WATCH = """
import sys
from skin.__main__ import main
try:
    main(["live", *sys.argv[1:]])
finally:
    print("torch" in sys.modules, "mlflow" in sys.modules, file=sys.stderr)
"""


@pytest.fixture(scope="module")
def trained(configured):
    """Return a small untrained network with six sensors, whose alarm is above 0.25, and some touches."""
    from skin.runs.build import TorchModel, build_data, build_device, build_learner

    sizes = ["layout=grid", "layout.rows=2", "layout.columns=3", "data.gestures=100"]
    config = configured("simulator=naive", *sizes, "representation=readings", "model=mlp", "fusion=early")
    device, learner = build_device(config), build_learner(config)
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    known = data.touches("train")
    point = OperatingPoint(0.25, 0.02, 5000, 100, 0)
    return TorchModel(device, learner, data.example, point, 0.3), known


@pytest.fixture(scope="module")
def model(trained, tmp_path_factory):
    """Return the file of the network."""
    of, known = trained
    path = tmp_path_factory.mktemp("model") / "skin.onnx"
    write_model(of.learner.pipeline(of.sites), of.describe(), known, path)
    return path


@pytest.fixture
def sending(played):
    """Return a function that gives the address of a board that sends ``line(number)`` every ``pause`` s."""

    def begin(line, pause):
        def say(reader, stop):
            for number in count():
                reader.sendall(line(number))
                if stop.wait(pause):
                    return

        return played(say)

    return begin


@pytest.fixture
def skin(request, sending):
    """Return the address of a skin of six sensors that is touched for one of five seconds, without end."""
    rng, touched_from = np.random.default_rng(0), getattr(request, "param", 4.0)

    def line(number):
        header = b"" if number else encode_header(Header(n=6, rate=RATE, unit="N"))
        values = rng.normal(3.0 * (number / RATE % 5.0 > touched_from), 0.02, size=6).round(4)
        return header + encode_line(values, number, round(1e6 * number / RATE))

    return sending(line, 1 / RATE)


@pytest.mark.slow("starts a process that imports anew")
def test_it_runs_without_torch_and_writes_json_lines(model, skin, tmp_path):
    words = [f"run={model}", "device=serial", f"device.port={skin}", "device.tare=1", "live.verdicts=stdout"]
    words += ["seconds=15", "live.log=alarms.jsonl", "live.selftest=false"]  # untrained
    line, settings = [sys.executable, "-c", WATCH, *words], {"PYTHONPATH": str(ROOT), "PATH": ""}
    done = subprocess.run(line, cwd=tmp_path, env=settings, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "False False"
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["number"] for line in lines] == list(range(lines[0]["number"], lines[-1]["number"] + 1))
    said = [line for line in lines if not line["stale"]]
    assert {line["touched"] for line in said} == {False, True}
    assert set(said[-1]["probabilities"]) == {"big", "dynamic", "press", "dangerous"}
    logged = [json.loads(line)["event"] for line in (tmp_path / "alarms.jsonl").read_text().splitlines()]
    assert (logged[0], "alarm" in logged, logged[-1]) == ("started", True, "ended")


def test_only_a_skin_at_a_port_is_watched(model):
    with pytest.raises(InputError, match="add device=serial"), ExitStack() as opened:
        watch_exported(str(model), {"seed": 0}, print, opened)


@pytest.mark.parametrize(
    ("rates", "threshold"), [(None, 0.25), ({"20": 0.3, "100": 0.35, "500": 0.4}, 0.35)], ids=["one", "rates"]
)
def test_the_settings_of_the_file_and_of_the_command(trained, skin, tmp_path, rates, threshold):
    """The threshold is the one for the rate of the device, which sends 100 frames a second."""
    of, touches = trained
    write_model(of.learner.pipeline(of.sites), of.describe(rates), touches, path := tmp_path / "skin.onnx")
    said, other = [], replace(LIVE, touch=0.5, patience=DebounceSettings(above=0.75))
    with ExitStack() as opened:
        device = {"port": skin, "labels": "announced"}
        setup = watch_exported(str(path), device, said.append, opened)
        assert not any("alarm above" in text for text in said)  # the views open before
        source, _, nominal, _ = setup.watch(LIVE, said.append)
        of_file = said[:]
        engine, usual = setup.watch(other, said.append)[1:3]
    assert (setup.model.title, len(setup.model.positions), setup.name) == ("untrained", 6, source.name)
    assert of_file[-1] == f"alarm above {threshold:.4f}"
    assert ("single windows" in of_file[-2]) == (threshold == 0.25)
    assert said[-1] == "alarm above 0.75"
    assert (engine.detection.threshold, usual.detection.threshold) == (0.5, 0.3)
    assert nominal.presses.shape == (6, 6)
    assert (nominal.presses.argmax(axis=1) == np.arange(6)).all()


@pytest.mark.parametrize("at_once", [1, 25])
def test_the_rate_of_a_device_is_that_of_its_arrivals_until_its_clock_is_known(at_once):
    """A clock in ms without a header counts as one in us at first: 100 Hz would be 100,000 Hz."""

    class Board(Sent):
        def read(self):
            sleep(at_once / RATE)
            first, self.number = self.number, self.number + at_once
            rows = (f"{n},{1000 + 10 * n},{'100,101,99,' * 2}99\r\n" for n in range(first, self.number))
            return "".join(rows).encode()

    Board.number = 0
    with open_skin("memory", range(7), opener=Board) as skin:
        assert measured_rate(skin) == pytest.approx(RATE, rel=0.3)


@pytest.mark.parametrize("skin", [5.0], ids=["untouched"], indirect=True)
def test_frames_that_waited_while_the_threshold_was_chosen_give_the_baseline_alone(model, skin):
    """The first verdicts would tell of touches of some seconds ago, and those of now would be late."""
    with ExitStack() as opened:
        setup = watch_exported(str(model), {"port": skin}, print, opened)
        sleep(3.0)
        setup.port.skin.stats.dropped = 12635  # by a queue that nobody read meanwhile
        source, begun = setup.watch(LIVE, print)[0], monotonic()
        assert source.skin.stats.dropped == 0
        while source.tare.conversion is None:
            (frame,) = source.skin.read(1)
            source.tare.add(frame)
        assert frame.t_host > begun - 0.5
        assert monotonic() - begun < 0.5


PROMISE = {"rate": 0.001, "touches": 3000, "misses": 0, "conditions": "mild", "patience": 0.1}
"""A guarantee as in the metadata of a file, but for the rate of the devices."""


@pytest.mark.parametrize(
    ("device_rate", "other", "reason"),
    [
        (100.0, {}, ""),
        (200.0, {}, "the device sends 100 frames a second, and not 200"),
        (100.0, {"patience": DebounceSettings(alarm=0.05)}, "live.patience.alarm is 0.05 s, and not 0.1"),
        (100.0, {"touch": 0.5}, "live.touch or live.drift is another"),
        (100.0, {}, "a range ends below 1.1 x the limit"),
    ],
    ids=["same", "rate", "patience", "touch", "range"],
)
def test_a_guarantee_of_a_file_holds_or_has_lapsed(trained, skin, tmp_path, device_rate, other, reason):
    of, touches = trained
    promise = {"100": PROMISE | {"device_rate": device_rate}}
    described = replace(of.describe({"100": 0.35}), guarantees=promise)
    assert described.limits == {"pressure": 90.5e3, "tap_pressure": 90.5e3}
    write_model(of.learner.pipeline(of.sites), described, touches, tmp_path / "skin.onnx")
    said, notes, conversion = [], [], unit_conversion(6, None, 1.0, None, None)
    with ExitStack() as opened:
        device = {"port": skin, "limits": [None, 1.0 if "range" in reason else 99.0]}
        setup = watch_exported(str(tmp_path / "skin.onnx"), device, said.append, opened)
        source, engine, nominal = setup.watch(replace(LIVE, **other), said.append)[:3]
        setup.check(source, engine, nominal, False, said.append, notes.append, conversion)
    assert np.all(engine.short) == ("range" in reason)
    lapse = f"; lapsed, as {reason}" if reason.startswith(("the", "live.patience")) else ""
    assert any(text.endswith(f"at most 0.1 % missed, 95 %, 3,000 touches, mild{lapse}") for text in said)
    rest = np.zeros(6), np.ones(6, dtype=bool)
    stream = [conversion.convert(Frame(None, t, t, *rest)) for t in np.arange(0.0, 1.0, 0.01).tolist()]
    note = next(note for note in engine.push(stream[:50])[-1].notes if note.code.startswith("guarantee"))
    # Nothing has confirmed the scale of this device.
    assert note.code == ("guarantee_lapsed" if reason else "guarantee_unverified")
    assert reason in note.text
    engine.changed = (2,)
    assert "guarantee_lapsed" in [note.code for note in engine.push(stream[50:])[-1].notes]


@contextmanager
def example(model, port, *files):
    """Yield the example as a process that reads the port."""
    line = [sys.executable, "-I", EXAMPLE, model, port, *files]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as reader:
        yield reader
        reader.kill()


@pytest.mark.slow("starts a process that imports anew")
def test_the_example_without_this_package(model, begin, tmp_path):
    sizes = ["layout=grid", "layout.rows=2", "layout.columns=3"]
    with begin(tmp_path, "emulate", "simulator=naive", *sizes, "link=skin", "emulate.idle=4") as emulator:
        lines = emulator.lines()
        port, scale = tmp_path / next(lines), next(lines).partition("device.scale=")[2]
        with example(model, port, scale) as reader:
            lines = [json.loads(reader.stdout.readline()) for _ in range(100)]
    assert {line["touched"] for line in lines} == {False, True}
    assert all(0 <= line[name] <= 1 for line in lines for name in ("big", "dynamic", "press", "dangerous"))
    assert all(line["alarm"] == (line["touched"] and line["dangerous"] > 0.25) for line in lines)


ADAPTER = """
kind: text
separator: ;
decimal: ","
names: [ms, a, b, c, d, e, f, heat]
drop: [heat]
time: ms
time_unit: ms
invalid: ["off"]
"""
GAINS = """
format: 1
count: 6
scale: 0.01
polarity: -1
channels: [1, 0, 2, 3, 4, 5]
sensors: {gain: [0.05, 0.05, 0.05, 0.05, null, 0.05]}
broken: {dead: [2]}
"""


def test_the_example_reads_an_adapter_and_a_calibration(model, sending, tmp_path):
    """A touch of 10 counts is 2 N, and 0.1 N without the gains; one of the broken sensor is none."""
    (tmp_path / "board.yaml").write_text(ADAPTER)
    (tmp_path / "gains.yaml").write_text(GAINS)

    def line(number):
        if number % 20 == 7:
            return b"what is this\n"
        phase = number % 1000
        values = [500, 500, 500 - 500 * (250 <= phase < 500), 500, 500, 500 - 10 * (phase >= 500)]
        words = [50 * number, *(f"{value},0" for value in values), "21,5"]
        words[5] = "off" if number % 3 else words[5]
        return ";".join(map(str, words)).encode() + b"\r\n"

    with example(model, sending(line, 0.002), tmp_path / "gains.yaml", tmp_path / "board.yaml") as reader:
        said = [json.loads(reader.stdout.readline()) for _ in range(600)]
        # 1.2 cycles from any phase on: half a cycle and the window behind it, and a fifth; the broken sensor
        # would add a quarter.
        assert 250 < sum(one["touched"] for one in said) < 400
        assert re.match(r"[1-9] of 50 lines cannot be read: ", reader.stderr.readline())


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("kind: json", "device.adapter.kind=json: this example reads text; use skin live\n"),
        ("kind: text\nlabel: ':'", "device.adapter.label: this example reads only"),
        ("kind: text\ndecimal: ','", r"\d+ of 50 lines cannot be read: .*; give an adapter"),
    ],
)
def test_what_the_example_cannot_read_it_refuses_in_a_sentence(model, sending, tmp_path, setting, said):
    (tmp_path / "board.yaml").write_text(setting)
    port = sending(lambda number: b"%d,1,2,3,4,5,6\n" % number, 0.002)
    with example(model, port, "0.01", tmp_path / "board.yaml") as reader:
        assert re.match(said, reader.stderr.read())
        assert reader.wait() == 2
