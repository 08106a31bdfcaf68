"""The C file of a model and the sketches of the documentation, compiled with a compiler of this machine."""

import shutil
import subprocess
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from skin.core.files import ROOT
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource
from skin.evaluation.operating_point import DangerScore, OperatingPoint
from skin.live.engine import DebounceSettings
from skin.live.engine_builder import engine_settings
from skin.robot.board import STEP, write_header
from skin.runs.build import TorchModel, build_data, build_device, build_learner
from skin.touch.labels import TOUCH, Task
from skin.wire.channels import NewtonFrame
from skin.wire.decoder import Decoder
from skin.wire.protocol import Header
from tests.live.test_safety import RATE, SENSORS, force

SKETCHES = ROOT / "docs" / "firmware"
MAIN = Path(__file__).with_name("board.c")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-fsanitize=address,undefined"]
SMALL = ["layout=grid", "layout.rows=3", "layout.columns=3", "simulator=naive", "data.gestures=400"]
SCORE, ABOVE = DangerScore(0.1, 3.0, -4.0), 0.5


def compiled(folder, *flags, source=MAIN, compiler="cc"):
    if shutil.which(compiler) is None:
        pytest.skip(f"needs a C compiler, {compiler}: apt-get install gcc g++")
    program = folder / f"{source.stem}-{len(flags)}"
    words = [compiler, *flags, f"-I{folder}", str(source), "-lm", "-o", str(program)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert not done.returncode, done.stderr
    return program


def asked(program, mode, values):
    done = subprocess.run([program, mode], input=values.tobytes(), capture_output=True, timeout=300)
    assert not done.returncode, done.stderr
    return np.frombuffer(done.stdout, np.float32)


@pytest.fixture(scope="module", params=["rules", "features"])
def board(request, configured, tmp_path_factory):
    rounds = ["learner.rounds=15"] if request.param == "features" else []
    config = configured(f"experiment={request.param}", *SMALL, *rounds)
    device, learner = build_device(config), build_learner(config)
    data = build_data(config, device)
    learner.fit(data)
    model = TorchModel(device, learner, data.example, touch=0.3)
    point = OperatingPoint(ABOVE, score=SCORE)
    model.alarm = AlarmSource(request.param, exported=point, points={"100": point})
    folder, usual = tmp_path_factory.mktemp(request.param), DebounceSettings()
    conditions = [model.live_conditions(RATE, usual.alarm, False)]
    write_header(model, conditions, usual.label, usual.calm, folder / "model.h", print)
    return model, folder, compiled(folder, *STRICT)


def test_a_thousand_touches(board):
    model, _, program = board
    touches = model.device.reference.fresh_touches(1000)
    valid, steps = touches.valid.numpy(), (touches.readings.double().numpy() / STEP).round()
    noise = np.random.default_rng(0).normal(scale=1e-6, size=(3, *steps.shape))
    expected = np.array([model.probabilities(STEP * steps + each, valid) for each in (0, *noise)], float)
    column = model.labels.index("dangerous")
    largest = STEP * np.where(valid, steps, 0).max(axis=(1, 2))
    expected[..., column] = SCORE.probability(expected[..., column], largest)
    # Where Python's own rounding decides at a node of a tree, there is no answer to compare with.
    steady = np.ptp(expected, axis=0).max(axis=1) <= 1e-5
    assert steady.mean() >= 0.98
    written = asked(program, "windows", np.where(valid, steps, -(2**15)).astype(np.int16)).reshape(1000, -1)
    assert np.abs(written - expected[0])[steady].max() <= 1e-5


@pytest.mark.parametrize(
    "touches",
    [
        [(8, 18, 4, 16.0), (8, 18, 5, -0.8)],  # longer than any touch of the training; it lifts beside it
        [(7.8, 7.9, 4, 6.0), (9, 10, 2, 2.0), (10.5, 10.7, 0, 9.0)],
        [(6, 6.01, 4, 9.0), (9, 13, 3, 1.0), (11, 13, 5, 8.0), (11, 13, 4, 8.0)],
        [(6, 7, 4, -3.0), (9, 11, 4, 5.0), (9.5, 9.6, 4, -9.0)],  # below rest
        [(6 + second, 20, 4, -0.25) for second in range(6)] + [(13, 15, 4, 6.0)],  # the skin sinks
        [(6, 6.4, sensor, 5.0) for sensor in range(SENSORS)] + [(8, 8.5, 1, 4.0), (8.6, 9, 1, 4.5)],
        [],
    ],
)
def test_states_and_alarms_are_those_of_the_live_view(board, touches):
    model, _, program = board
    values = np.float32(STEP * np.round(force(20, *touches) / STEP))
    answers = asked(program, "frames", values).reshape(-1, 3 + SENSORS)[1:]
    newtons, tare = values - answers[0, 3:], 3 * RATE
    engine = engine_settings(model, DebounceSettings(above=ABOVE), danger=SCORE)
    engine.reset(noise=np.diff(newtons[:tare], axis=0).std(axis=0) / np.sqrt(2))
    times, none = (1 + np.arange(len(values))) / RATE, np.zeros(SENSORS, int)
    given = zip(times, newtons, strict=True)
    stream = [NewtonFrame(t, row, none, Frame(None, t, t, row, none == 0)) for t, row in given]
    engine.remember(stream[:tare])
    verdicts = engine.push(stream[tare:])
    states = [[said.state == "touch", said.dangerous, said.contact is not None] for said in verdicts]
    assert np.column_stack([answers[:, 0] == 2, answers[:, 1:3] > 0]).tolist() == states
    unknown = {said.state for said, state in zip(verdicts, answers[:, 0], strict=True) if state == 3}
    assert unknown == ({"unknown"} if touches and touches[0][3] < 0 else set())
    values[-100:-90, 1] = np.nan  # a tap that a sensor does not tell
    lost = asked(program, "frames", values).reshape(-1, 3 + SENSORS)[-18:, 0]
    assert set(lost) <= {2, 3}
    assert asked(program, "frames", values * np.float32("nan"))[-3 - SENSORS] == 3  # broken from the start
    assert bool(touches) == answers[:, 1].any()


def test_the_self_test_fails_with_another_number(board, tmp_path):
    _, folder, program = board
    assert subprocess.run([program]).returncode == 0
    text = (folder / "model.h").read_text()
    (tmp_path / "model.h").write_text(text.replace("define SKIN_LOUDNESS 3.", "define SKIN_LOUDNESS 2."))
    assert subprocess.run([compiled(tmp_path, "-std=c99")]).returncode == 10


# Pins of an Uno: the converter takes 100 us, and what it reads at a time is given. The clock wraps early.
STAND_IN = """
#include <stdint.h>
#include <stdio.h>
enum { A0, A1, A2, A3, A4, A5, A6, A7, A8, OUTPUT, LOW = 0, HIGH = 1 };
static uint32_t clock_us = 4294000000u;
static uint32_t passed() { return clock_us - 4294000000u; }
static uint32_t micros() { return clock_us += 4; }
static int analogRead(uint8_t pin) { clock_us += 100; return READING; }
static int lamp;
static inline void pinMode(int, int) {}
static inline void digitalWrite(int, int level) { lamp = level; }
struct {
  void begin(uint32_t) {}
  void print(const char *text) { fputs(text, stdout); }
  void println(const char *text) { printf("%s %d\\n", text, lamp); }
} Serial;
"""
# The fifth pin is pressed at 8 s, the wire of the third breaks at 14 s, something lies on the first at 16 s.
PRESSED = "(pin == 2 && passed() > 14000000 ? 0 : \\\n 100 + passed() / 10000 * (pin + 7) % 5 % 2"
PRESSED += " + (pin == 4 && passed() / 1000000 == 8 ? 400 : 0) + (!pin && passed() > 16000000 ? 50 : 0))"
# Constants stay in flash, as on an Uno.
FLASH = """
#define PROGMEM
#define pgm_read_float(at) (*(const float *)(at))
#define pgm_read_byte(at) (*(const uint8_t *)(at))
#define pgm_read_word(at) (*(const uint16_t *)(at))
#define pgm_read_dword(at) (*(const uint32_t *)(at))
"""


def printed(folder, sketch, reading, end, *flags):
    """Return the lines that a sketch prints until a condition holds, with the readings of its pins."""
    (folder / "Arduino.h").write_text(f"#define READING {reading}\n{STAND_IN}")
    assert len(sketch.splitlines()) < 60
    main = folder / "main.cpp"
    main.write_text(f"{sketch}\nint main() {{ setup(); while ({end}) loop(); }}\n")
    program = compiled(folder, "-Wall", *flags, source=main, compiler="g++")
    return subprocess.run([program], capture_output=True, text=True, timeout=60).stdout.splitlines(True)


def test_the_sketch_prints_state_and_alarm(board, tmp_path):
    _, folder, _ = board
    (tmp_path / "model.h").write_text((folder / "model.h").read_text())
    (tmp_path / "avr").mkdir()
    (tmp_path / "avr" / "pgmspace.h").write_text(FLASH)
    sketch = (SKETCHES / "alarm" / "alarm.ino").read_text().replace("A4, A5}", "A4, A5, A6, A7, A8}")
    strict = "-Wextra", "-Werror", "-D__AVR__"
    said = [line.rstrip() for line in printed(tmp_path, sketch, PRESSED, "passed() < 18000000u", *strict)]
    assert said[0] == "# self-test passed: do not touch the skin 1"
    assert [said[1], said[-81], said[-41]] == ["no touch,- 0", "no touch,- 0", "unknown,-,unknown 1"]
    assert said[-1] == "touch,-,unknown 1"
    alarms = [number for number, line in enumerate(said) if line == "touch,ALARM 1"]
    assert 8 <= 3 + alarms[0] / 20 <= 8.2
    assert len(alarms) == alarms[-1] - alarms[0] + 1
    assert 11 <= 3 + alarms[-1] / 20 <= 11.5
    assert len(said) == 2 + 20 * (18 - 3)


def test_every_frame_of_the_sketch_of_a_skin_is_read(tmp_path):
    sketch = (SKETCHES / "skin" / "skin.ino").read_text()
    lines = printed(tmp_path, sketch, "100 * pin + clock_us / 10000 % 97", "seq < 1200", "-Wno-format")
    decoder = Decoder()
    frames = decoder.feed("".join(lines).encode())
    assert (decoder.sensors, [frame.seq for frame in frames]) == (6, list(range(1200)))
    assert decoder.frame_format.check == "crc16"
    assert decoder.header == Header(1, 6, 100.0, "adc", 10)
    assert decoder.stats.bad.total() + decoder.stats.lost + decoder.stats.resets == 0
    values = np.stack([frame.values for frame in frames])
    assert values[:, 5] - values[:, 0] == pytest.approx(500, abs=97)
    assert np.diff([frame.t for frame in frames]) == pytest.approx(0.01, abs=2e-4)
    # The header comes each second.
    positions = [position for position, line in enumerate(lines) if line.startswith("# skin ")]
    assert positions[0] == 0
    assert max(np.diff([*positions, len(lines)])) <= 102


@pytest.mark.parametrize(
    ("rates", "changed", "message"),
    [
        ([RATE], {"learner": SimpleNamespace(parameters=430_000)}, r"430000 par.* \(1720 kB\).*format=onnx"),
        ([RATE], {"task": Task((*TOUCH.names, "slide_x", "slide_y"), direction=True)}, "without a direction"),
        ([RATE], {"task": Task(("big",))}, "with dangerous"),
        ([30.0], {}, r"one rate, a multiple of 20 Hz .* got 30.0: as in export.rates=\[100\]"),
        ([RATE, 50.0], {}, "got 100, 50.0"),
    ],
)
def test_what_cannot_be_written_is_refused_in_a_sentence(board, tmp_path, rates, changed, message):
    model = copy(board[0])
    vars(model).update(changed)
    conditions = [replace(board[0].live_conditions(1.0, 0.1, False), rate=rate) for rate in rates]
    with pytest.raises(InputError, match=message):
        write_header(model, conditions, 0.15, 2.0, tmp_path / "model.h", print)
    assert not list(tmp_path.iterdir())
