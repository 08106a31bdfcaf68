"""Recording goes wrong: the person reads one sentence, and nothing that was recorded is lost."""

import os
import re
import resource
import shutil
import signal
import socket
from contextlib import contextmanager
from itertools import count
from threading import Event, Thread

import numpy as np
import pytest

from skin.device.files import read_recording
from skin.record.session import locked, read_session
from skin.wire.protocol import Header, encode_header, encode_line

SKIN = ["layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive", "touch.window=0.5"]
FREE = [*SKIN, "record.free=true", "device.tare=1", "device.backoff=[0.05,0.1]"]
PACE = 0.001  # s of the wall for 10 ms of the device


@contextmanager
def skin(*lives):
    """Serve a skin at 100 Hz, in N, to one reader after the other; give its address.

    A life is what the skin is like in a connection: ``frames`` after which it falls silent without closing,
    its ``sensors``, ``period`` of its clock, its ``id``, and number of the frame before which it sends its
    ``header``. The last one is that of all further connections.
    """
    server, stop, peers = socket.create_server(("127.0.0.1", 0)), Event(), []

    def serve():
        rng = np.random.default_rng(0)
        for number in count():
            try:
                peers.append(server.accept()[0])
                if stop.is_set():
                    return
                usual = {"frames": 10**9, "sensors": 4, "period": 10_000, "id": "arm-L", "header": 0}
                life = usual | lives[min(number, len(lives) - 1)]
                header = Header(n=life["sensors"], rate=100.0, unit="N", id=life["id"])
                for seq in range(life["frames"]):
                    if seq == life["header"]:
                        peers[-1].sendall(encode_header(header))
                    values = rng.normal(scale=0.02, size=life["sensors"]).round(4)
                    peers[-1].sendall(encode_line(values, seq, life["period"] * seq))
                    if stop.wait(PACE):
                        return
            except OSError:
                continue

    thread = Thread(target=serve, daemon=True)
    thread.start()
    yield f"device.port=socket://127.0.0.1:{server.getsockname()[1]}"
    stop.set()
    # It waits in accept() otherwise.
    socket.create_connection(server.getsockname()).close()
    thread.join(60)
    server.close()
    for peer in peers:
        peer.close()


@pytest.fixture
def record(run, tmp_path):
    return lambda *words, **code: run(tmp_path, "record.py", "out=s", *words, store=False, **code)


@pytest.fixture(scope="module")
def once(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("once")
    with skin({}) as port:
        run(folder, "record.py", "out=s", *FREE, port, "seconds=6", store=False)
    return folder


@pytest.fixture
def recorded(once, tmp_path):
    """Return the path of a session of a few gestures, with nothing made of it."""
    return shutil.copytree(once / "s", tmp_path / "s")


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def interruptions(folder):
    rows = [row for table in read_session(folder).tables for row in table.to_pylist()]
    return [row["after"] for row in rows if row["after"]]


def refused(done, reason):
    """Check that a command ended with 2 and one sentence; what it asks of the person stands before."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert re.search(reason, done.stderr.splitlines()[-1]), done.stderr


@pytest.mark.slow("records until a file is full, and again")
def test_a_full_disk_is_one_sentence_and_there_is_room_again(record, begin, tmp_path):
    path = tmp_path / "s"
    with skin({}) as port:
        with begin(tmp_path, "record.py", "out=s", *FREE, port, "seconds=60") as full:
            next(line for line in full.lines(errors=True) if line.startswith("gesture 2"))
            resource.prlimit(full.pid, resource.RLIMIT_FSIZE, (2001, resource.RLIM_INFINITY))
            reason = r"^cannot write s/\S+: File too large: .*; the gestures before are kept$"
            refused(full.completed(), reason)
        done, before = len(read_session(path).gestures), content(path)
        assert done >= 2
        assert len(before) == done + 1
        assert not (tmp_path / "s.parquet").exists()
        again = record(*FREE, port, "seconds=3")
    assert f"s has {done} gestures: going on" in again.stderr
    assert before.items() <= content(path).items()
    assert len(read_recording(tmp_path / "s.parquet")) > done


def test_a_session_that_is_being_recorded_is_left_alone(record, tmp_path):
    with locked(tmp_path / "s"), skin({}) as port:
        reason = r"^s is being recorded by another process: end that, or give another"
        refused(record(*FREE, port, code=2), reason)
    assert not (tmp_path / "s").exists()


def test_another_window_is_refused_in_finishing_and_going_on(record, recorded):
    before, change = content(recorded), "touch.window=0.7"
    reason = "windows of 5 frames at 10 Hz, the configuration has 7 at 10 Hz: give touch.window=0.5 "
    refused(record(*SKIN, change, "record.finish=true", code=2), reason)
    with skin({}) as port:
        refused(record(*FREE, change, port, "device.tare=2", "seconds=6", code=2), reason)
    assert content(recorded) == before
    assert not recorded.with_name("s.parquet").exists()


def test_another_device_is_refused_however_late_its_header_comes(record, recorded):
    before = content(recorded)
    with skin({"id": "arm-R", "header": 500}) as port:
        done = record(*FREE, port, "device.scale=1", "seconds=30", code=2)
    refused(done, "from the device arm-L, this is arm-R")
    assert content(recorded) == before


def test_another_device_at_the_port_is_not_recorded(record, tmp_path):
    with skin({"frames": 400}, {"id": "arm-R", "header": 100}) as port:
        done = record(*FREE, port, "seconds=30", "device.timeout=1", "device.silence=0.3")
    assert "another device" in done.stderr
    assert not interruptions(tmp_path / "s")


def test_a_damaged_file_is_named_and_the_others_become_a_recording(record, recorded):
    whole = len(read_session(recorded).gestures)
    data = (recorded / "gesture_00001.parquet").read_bytes()
    (recorded / "gesture_00001.parquet").write_bytes(data[:500] + b"\xff\xff" + data[502:])
    done = record(*SKIN, "record.finish=true")
    assert (done.returncode, done.stdout) == (0, f"s.parquet: {whole - 1} gestures\n"), done.stderr
    assert done.stderr.splitlines() == ["s: damaged files are left out: gesture_00001.parquet"]
    readings = read_recording(recorded.with_name("s.parquet")).touches.readings
    (recorded / "gesture_00001.parquet").write_bytes(data)
    assert record(*SKIN, "record.finish=true").stderr == ""
    again = read_recording(recorded.with_name("s.parquet")).touches.readings
    assert again[[0, *range(2, whole)]].equal(readings)


def test_a_session_becomes_a_table(run, recorded, tmp_path):
    done = run(tmp_path, "convert", "from=s", "out=t.csv", store=False)
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert (done.returncode, done.stdout) == (0, f"t.csv: {len(lines) - 1} frames\n"), done.stderr
    done = run(tmp_path, "convert", "from=s", "out=t.xlsx", store=False, code=2)
    refused(done, r"out=t\.xlsx must be a \.csv file: add out=x\.csv")


def test_a_half_open_socket_is_opened_anew(record, tmp_path):
    with skin({"frames": 400}, {}) as port:
        done = record(*FREE, port, "seconds=8", "device.silence=0.5")
    assert "the skin was unplugged (nothing received for 0.5 s); trying again" in done.stderr
    assert interruptions(tmp_path / "s") == ["reconnect"]
    assert len(read_session(tmp_path / "s").gestures) == len(read_recording(tmp_path / "s.parquet")) >= 8


@pytest.mark.parametrize(
    ("lives", "reason"),
    [
        ([{"frames": 0}], r"^socket://\S+: 0 of 1 frames arrived within 1 s: port open, nothing received"),
        ([{"frames": 400}, {"sensors": 3}], "sends 3 values per frame, the layout has 4 sensors"),
    ],
)
def test_what_cannot_be_recorded_is_one_sentence(record, tmp_path, lives, reason):
    with skin(*lives) as port:
        refused(record(*FREE, port, "seconds=30", "device.timeout=1", "device.silence=0.3", code=2), reason)
    assert not (tmp_path / "s.parquet").exists()
    assert not (tmp_path / "s").exists() or read_session(tmp_path / "s").tables


SLOW_PACE = 0.006  # s of the wall for 10 ms of the device, whose clock is not trusted at twice the speed


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
            if stop.wait(SLOW_PACE):
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
