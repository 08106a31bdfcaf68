"""A person at the keyboard: what is asked for, what Enter, s and q do, and going on after a kill."""

import os
import re
import signal
from contextlib import contextmanager
from itertools import count

import numpy as np
import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.device.files import read_recording
from skin.record.session import read_session
from skin.wire.protocol import Header, encode_header, encode_line

SKIN = ["layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive", "touch.window=0.5"]
PACE = 0.006  # s of the wall for 10 ms of the device, whose clock is not trusted at twice the speed


@pytest.fixture
def address(played):
    """Return the address of a skin of four sensors at 100 Hz, in N; it serves one reader after the other."""

    def say(reader, stop):
        rng = np.random.default_rng(0)
        reader.sendall(encode_header(Header(n=4, rate=100.0, unit="N")))
        for number in count():
            # After the tare, every window of half a second feels something.
            values = rng.normal(scale=0.02, size=4) + 2.0 * (number > 230 and number % 40 > 20)
            reader.sendall(encode_line(values.round(4), number, 10_000 * number))
            if stop.wait(PACE):
                return

    return played(say)


class Person:
    """Somebody who reads what a command says, and types."""

    def __init__(self, process, keyboard):
        self.process, self._keyboard = process, keyboard

    def until(self, words):
        for line in self.process.lines(errors=True):
            if words in line:
                return line.strip()
        raise AssertionError(f"waited in vain for {words!r} after\n{self.process.err}")

    def types(self, line):
        os.write(self._keyboard, line.encode() + b"\n")


@pytest.fixture
def person_at(begin):
    @contextmanager
    def person_at(folder, script, *arguments):
        keyboard, terminal = os.openpty()
        try:
            with begin(folder, script, *arguments, stdin=os.ttyname(terminal)) as process:
                yield Person(process, keyboard)
        finally:
            os.close(keyboard)
            os.close(terminal)

    return person_at


def ended(person):
    code = person.process.wait()
    assert "Traceback" not in person.process.err, person.process.err
    assert "Fatal" not in person.process.err, person.process.err
    return code, person.process.out


@pytest.mark.slow("waits for prompts and recordings")
def test_recording_with_enter_s_q_and_going_on_after_a_kill(person_at, address, tmp_path):
    command = ["record.py", *SKIN, "out=s", f"device.port={address}", "device.gestures=6"]
    asked = re.compile(r"next: (big|small), (dynamic|static), (press|tap), (dangerous|safe) - press Enter")
    with person_at(tmp_path, *command) as person:
        person.until("keep off")
        first = person.until("next: ")
        assert asked.match(first)
        person.types("")
        assert person.until("now") == "now: 0.5 s"
        person.until("1 of 6 gestures")
        skipped = person.until("next: ")
        assert skipped != first
        person.types("s")
        third = person.until("next: ")
        assert third not in (first, skipped)
        # Enter pressed twice is no second gesture.
        os.write(person._keyboard, b"\n\n\n")
        person.until("2 of 6 gestures")
        person.until("next: ")
        person.process.kill()
    with person_at(tmp_path, *command) as person:
        person.until("s has 2 gestures: going on")
        assert person.until("next: ") == skipped
        person.types("")
        person.until("3 of 6 gestures")
        person.until("next: ")
        person.types("q")
        assert ended(person) == (0, "s.parquet: 3 gestures\n")
    gestures = read_session(tmp_path / "s").gestures
    assert sorted(gestures) == [0, 1, 2]
    stored = read_recording(tmp_path / "s.parquet")
    words = [re.split(r"[ ,]+", line)[1:5] for line in (first, skipped, third)]
    yes = ("big", "dynamic", "press", "dangerous")
    assert stored.touches.labels.int().tolist() == [[int(yes[n] == w[n]) for n in range(4)] for w in words]


@pytest.mark.slow("waits for prompts and recordings")
def test_ctrl_c_at_a_prompt_keeps_what_there_is(person_at, address, tmp_path):
    with person_at(tmp_path, "record.py", *SKIN, "out=s", f"device.port={address}") as person:
        person.until("next: ")
        person.types("")
        person.until("1 of 48 gestures")
        person.until("next: ")
        person.process.send_signal(signal.SIGINT)
        assert ended(person) == (0, "s.parquet: 1 gestures\n")


@pytest.mark.slow("trains a run and waits for prompts")
def test_evaluating_a_person(run, person_at, address, tmp_path):
    own = [f"tracking.uri=sqlite:///{tmp_path}/m.db", f"tracking.artifacts={tmp_path}/a"]
    small = ["data.gestures=1000", "device.test_gestures=96", "evaluation.devices=1"]
    small += ["evaluation.layouts=1", "evaluation.safe_gestures=64"]
    run(tmp_path, "train.py", "experiment=rules", *SKIN[:-1], *small)
    there = ["device=serial", f"device.port={address}", "device.labels=prompted", "device.gestures=16"]
    with person_at(tmp_path, "evaluate.py", *there, f"out={tmp_path}", *own) as person:
        for number in range(1, 4):
            person.until("next: ")
            person.types("")
            person.until(f"{number} of 16 gestures: ")
        person.until("next: ")
        person.types("q")
        code, said = ended(person)
    assert code == 0
    assert "overall/accuracy" in said
    page = next(tmp_path.glob("evaluation_serial_*.md")).read_text()
    assert "3 gestures" in page
