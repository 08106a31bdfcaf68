"""The guide from a board to the live view, as a person at a terminal goes through it."""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from select import select
from time import monotonic, sleep

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.calibration.known_loads import KnownLoad, base_readings
from skin.device.calibration import read_calibration
from skin.runs.build import build_skin
from tests.wire.conftest import Plug

GAINS = np.linspace(0.7, 1.3, 9)
COUNT = 0.02  # N
NAIVE = """\
# @package _global_
defaults:
  - override /simulator: naive
body:
  _target_: skin.body.sheet.Sheet
  _convert_: all
  size: [0.16, 0.16]
  cells: [32, 32]
  layers:
    - {material: Dragon Skin 10 Medium, thickness: 0.010}
    - {material: EcoFlex 00-30, thickness: 0.005}
layout:
  path: my-skin/sensors.csv
"""


class Board:
    """Nine sensors that print ``millis,s1..s9`` at a port; its time stands still while nobody reads."""

    def __init__(self):
        self.plug, self.loads, self.now, self.sent = Plug(), [], 0.0, monotonic()
        self._noise = np.random.default_rng(0)

    def line(self, number):
        before, self.sent = self.sent, monotonic()
        self.now += min(self.sent - before, 0.1)
        load = next((load for begin, end, load in self.loads if begin < self.now < end), np.zeros(9))
        counts = 200 + (GAINS * load + self._noise.normal(0, 0.02, 9)) / COUNT
        return ",".join(map(str, [int(1e3 * self.now), *counts.round().astype(int)])).encode() + b"\r\n"

    def put(self, loads, seconds, pause):
        """Put loads down one after the other, from three seconds on; return when the last is lifted."""
        begins = self.now + 3 + (seconds + pause) * np.arange(len(loads))
        self.loads = [(begin, begin + seconds, load) for begin, load in zip(begins, loads, strict=True)]
        return begins[-1] + seconds + pause


@pytest.fixture
def board():
    made = Board()
    with made.plug.streaming(made.line, 0.01):
        yield made


class Terminal:
    """A person who reads and types."""

    def __init__(self, process, file):
        self.process, self.file, self._read = process, file, ""

    def until(self, pattern):
        while not (found := re.search(pattern, self._read)):
            assert select([self.file], [], [], 300)[0], f"waited in vain for {pattern} after {self._read}"
            self._read += os.read(self.file, 4096).decode()
        self._read = self._read[found.end() :]
        return found

    def types(self, *lines):
        os.write(self.file, "".join(f"{line}\n" for line in lines).encode())


@contextmanager
def terminal(folder, *words):
    file, inside = os.openpty()
    command = [sys.executable, "-m", "skin", "setup", *words]
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), inside)
    with subprocess.Popen(command, cwd=folder, start_new_session=True, **streams) as process:
        os.close(inside)
        try:
            yield Terminal(process, file)
        finally:
            with suppress(ProcessLookupError):  # it has ended
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    os.close(file)


def asked(run, monkeypatch, folder, *answers, program="false", words=()):
    given = iter(answers)

    def typed(question):
        for answer in given:
            return answer
        raise EOFError

    with monkeypatch.context() as patch:
        patch.setattr("builtins.input", typed)
        patch.setattr("sys.executable", shutil.which(program))
        return run(folder, "setup", "device.port=/dev/null", "out=mine", *words, store=False).stderr


def test_bad_answers_are_asked_again_and_nothing_is_half_written(run, monkeypatch, tmp_path):
    said = asked(run, monkeypatch, tmp_path, "speak", "skin", "", "160", "160 -1", "120 120", "a 5")
    assert re.findall(r"(\d) of 7: (\w+)", said) == [("1", "board"), ("1", "board"), ("3", "skin")]
    assert "there is no step speak\n" in said
    assert said.count("give 2 numbers above 0, as in 160 160\n") == 2
    assert "give 2 numbers above 0, as in 10 5\n" in said
    assert said.endswith("\nto continue: skin setup device.port=/dev/null out=mine\n")
    assert not list(tmp_path.iterdir())


def test_a_step_that_fails_is_offered_again_and_the_guide_goes_on_where_it_was(run, monkeypatch, tmp_path):
    steps = lambda said: re.findall(r"of 7: (\w+)", said)  # noqa: E731
    assert steps(asked(run, monkeypatch, tmp_path, "")) == ["board", "board"]
    assert steps(asked(run, monkeypatch, tmp_path, "", "", program="true")) == ["board", "values", "skin"]
    assert steps(asked(run, monkeypatch, tmp_path)) == ["skin"]
    asked(run, monkeypatch, tmp_path, "", program="true", words=["step=board"])
    assert steps(asked(run, monkeypatch, tmp_path)) == ["values"]
    assert steps(asked(run, monkeypatch, tmp_path, "q", words=["step=check"])) == ["check"]


def test_its_commands_are_those_of_a_skin_as_described(run, monkeypatch, tmp_path):
    described = "200 100", "8 4", "560 70", "8 6", "2 4", "40 30"
    answers = "", *described, "", "", "1.5 15", "", "0.4 6", ""
    said = asked(run, monkeypatch, tmp_path, *answers, program="true", words=["step=skin"])
    board = "device.port=/dev/null device.adapter=mine/board.yaml"
    skin, load = "--config-dir mine body=mine", f"{board} device.calibration=mine/calibration.yaml"
    assert re.findall(r"^\$ skin (.*)$", said, re.M) == [
        f"design {skin} out=mine | tee mine/skin.txt",
        f"record {skin} {board} device.scale=1 device.labels=none record.free=true out=mine/loads"
        " | tee mine/weigh.txt",
        f"calibrate {skin} session=mine/loads weight=1.5 base=0.015 out=mine/calibration.yaml"
        " | tee mine/calibrate.txt",
        f"check {skin} {load} weight=0.4 base=0.006 | tee mine/check.txt",
        f"live {skin} run=any_skin device=serial {load} web=true",
    ]
    shown = OmegaConf.create(run(tmp_path, "design", *skin.split(), "--cfg", "job", store=False).stdout)
    body = instantiate(shown.body)
    assert (body.size, body.cells, shown.simulator._target_[-5:]) == ((0.2, 0.1), (40, 20), "Solid")
    layers = [(layer.thickness, layer.material.young) for layer in body.layers]
    assert layers == [(0.008, 560e3), (0.004, 70e3)]
    monkeypatch.chdir(tmp_path)
    sensors = instantiate(shown.layout).sensors(body)
    assert sensors.footprint == (0.008, 0.006)
    assert sensors.positions[[0, 7]].tolist() == [[0.04, 0.035, 0.004], [0.16, 0.065, 0.004]]


@pytest.mark.slow("runs commands in processes of their own, and waits for nine loads")
def test_a_board_of_nine_sensors_is_read_mapped_and_calibrated(board, tmp_path, configured):
    model = build_skin(configured("simulator=naive", "layout=grid", "layout.rows=3", "layout.columns=3"))
    simulator, folder = model.simulator(model.body, model.sensors), tmp_path / "my-skin"
    loads = base_readings(simulator, model.body, model.sensors, KnownLoad(2.0, 0.02))[0]
    (folder / "body").mkdir(parents=True)
    (folder / "body" / "mine.yaml").write_text(NAIVE)
    rows = [f"{x:.6f},{y:.6f}" for x, y in model.sensors.positions[:, :2]]
    (folder / "sensors.csv").write_text("\n".join(["x_m,y_m", *rows, ""]))
    with terminal(tmp_path, f"device.port={board.plug.port}") as person:
        person.until("1 of 7: board")
        person.types("")
        person.until("# 9 values")
        person.until("2 of 7: values")
        person.types("skin", "", "")
        person.until("not felt between sensors 0, 1, 3, 4;")
        person.until("4 of 7: weigh")
        person.types("")
        person.until("keep off")
        end = board.put(loads, 1.6, 1.6)
        while board.now < end:
            sleep(0.1)
        os.killpg(person.process.pid, signal.SIGINT)  # as Ctrl-C at a terminal
        person.until("5 of 7: calibrate")
        person.types("", "2 20")
        person.until("placements 9, weight 2, base 0.02")
        person.until("6 of 7: check")
        person.types("q")
        person.until("to continue: skin setup device.port=")
        assert person.process.wait(60) == 0
    gains = read_calibration(folder / "calibration.yaml").values()["gain"]
    assert gains / gains.mean() == pytest.approx(GAINS, rel=0.1)
