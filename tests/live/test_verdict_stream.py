"""JSON lines and the log of alarms: what they say, who gets them, and a reader that is gone."""

import importlib.util
import json
import os
import subprocess
import sys
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace

import numpy as np
import pytest

from skin.core.files import ROOT
from skin.errors import InputError
from skin.live.loop import Display, watch_age
from skin.live.verdict import Verdict
from skin.live.view import HEARTBEAT, VERDICTS, write_events, write_file
from tests.wire.memory import PATIENCE, until


def display(calm=2.0):
    return Display("run", "port", np.zeros((4, 3)), (0.1, 0.1), 4.0, calm=calm)


@pytest.fixture
def shown():
    return display()


def logged(dangerous):
    certain = {"probabilities": {"dangerous": 0.9}, "labels": {"dangerous": dangerous}}
    return replace(verdict(dangerous), masked=(), **certain)


def verdict(dangerous=False, probability=0.25):
    labels = {"big": True, "dangerous": dangerous}
    probabilities = {"big": probability, "dangerous": float(dangerous)}
    return Verdict(1.5, monotonic(), probabilities, True, labels, dangerous, False, (2,), 0.4)


@contextmanager
def piped(shown):
    """Yield the reading end of the pipe to which verdicts are written."""
    reading, writing = os.pipe()
    with (
        os.fdopen(reading, "rb") as lines,
        os.fdopen(writing, "w", buffering=1) as file,
        watch_age(shown),
        write_events(shown, file, shown.close, VERDICTS),
    ):
        yield lines


def wait_for(lines, accepted):
    """Return the first message of a pipe that is accepted."""
    return next(filter(accepted, map(json.loads, lines)))


def test_a_verdict_is_a_line(shown):
    with piped(shown) as lines:
        shown.set_verdict(verdict(dangerous=True, probability=float("nan")), monotonic())
        found = wait_for(lines, lambda message: message["event"] == "verdict")
    assert found["schema"] == 1
    assert (found["alarm"], found["stale"], found["touched"], found["reason"]) == (True, False, True, "")
    assert found["labels"] == {"big": True, "dangerous": True}
    assert found["probabilities"] == {"big": None, "dangerous": 1.0}
    assert (found["device_time"], found["contact"], found["gap"], found["masked"]) == (1.5, 0.4, False, [2])
    assert found["time"].endswith("Z")


def test_a_verdict_that_is_too_old_is_stale_and_keeps_its_alarm(shown):
    """Also where the engine hangs, which would tell nothing itself."""
    with piped(shown) as lines:
        shown.set_verdict(verdict(dangerous=True), monotonic())
        began = monotonic()
        fresh = wait_for(lines, lambda message: message["event"] == "verdict")
        old = wait_for(lines, lambda message: message["stale"])
        assert 0.5 < monotonic() - began < PATIENCE
        told = [old[name] for name in ("event", "alarm", "dangerous", "state")]
        assert told == ["change", True, True, "unknown"]
        assert old["notes"] == [{"code": "stale", "text": "no decision for longer than usual", "sensors": []}]
        assert old["number"] <= fresh["number"] + 2
        assert "labels" not in old


def test_a_reason_is_sent_once_and_then_with_each_heartbeat(shown):
    with piped(shown) as lines:
        for _ in range(3):
            shown.set_verdict(None, monotonic(), "unplugged", True)
        events = [json.loads(lines.readline()) for _ in range(3)]
    told = [one["event"] for one in events if one["reason"] == "unplugged"]
    assert told == ["change", "heartbeat", "heartbeat"]
    assert all(one["alarm"] for one in events)


def test_a_reader_that_is_slow_delays_nothing_and_misses_the_oldest(shown):
    with piped(shown) as lines:
        began = monotonic()
        for _ in range(5_000):
            shown.set_verdict(verdict(), monotonic())
        assert monotonic() - began < PATIENCE
        numbers = [json.loads(lines.readline())["number"]]
        while numbers[-1] < 5_000:
            numbers.append(json.loads(lines.readline())["number"])
    assert numbers == sorted(numbers)
    assert len(numbers) < 200  # of the pipe, and two


def test_the_view_closes_with_the_reader_of_its_lines(shown):
    with suppress(BrokenPipeError), piped(shown) as lines:
        lines.readline()
        lines.close()
        assert shown.closed.wait(PATIENCE)


def test_what_waits_is_written_before_the_end(shown):
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as lines:
        with os.fdopen(writing, "w", buffering=1) as file, write_events(shown, file, shown.close, VERDICTS):
            for _ in range(20):
                shown.set_verdict(verdict(), monotonic())
        assert [json.loads(line)["number"] for line in lines][-2:] == [19, 20]


def test_each_change_is_a_line_with_its_time(tmp_path):
    shown, path = display(0.0), tmp_path / "logs" / "alarms.jsonl"
    before = datetime.now(UTC)
    with write_file(shown, path):
        shown.set_verdict(None, monotonic(), "filling the window: 20 %")
        for dangerous in (False, True, True):
            shown.set_verdict(logged(dangerous), monotonic())
        shown.set_verdict(None, monotonic(), "unplugged", True)
        shown.set_verdict(logged(True), monotonic())
        shown.request_tare(monotonic())
        shown.set_verdict(logged(False), monotonic())
        shown.set_verdict(logged(True), monotonic())
    shown.set_verdict(logged(True), monotonic())  # after the end
    found = [json.loads(line) for line in path.read_text().splitlines()]
    events = ["started", "resumed", "alarm", "stale", "resumed", "tare_refused", "cleared", "alarm", "ended"]
    assert [one["event"] for one in found] == events
    alarm, stale = found[2], found[3]
    assert (alarm["probabilities"], alarm["contact"]) == ({"dangerous": 0.9}, 0.4)
    assert (stale["reason"], stale["alarm"]) == ("unplugged", True)
    for event in (found[5], found[8]):  # of an operator, or the end: while the alarm lasts
        assert (event["alarm"], event["stale"], event["state"]) == (True, False, "touch")
    times = [datetime.fromisoformat(one["time"]) for one in found]
    slack = timedelta(milliseconds=2)
    assert all(before - slack <= time <= datetime.now(UTC) + slack for time in times)
    with write_file(shown, path):
        pass
    assert len(path.read_text().splitlines()) == len(found) + 2  # appended


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    writing = write_file(display(0.0), tmp_path / "file" / "log")
    with pytest.raises(InputError, match=r"live\.log=FILE"), writing:
        pass


def test_a_full_disk_does_not_hide_how_the_view_ends(capsys):
    """Closing the file raised an error of its own: SIGTERM ended with code 2."""
    shown = display(0.0)
    with pytest.raises(SystemExit, match="143"), write_file(shown, Path("/dev/full")):
        raise SystemExit(143)
    assert capsys.readouterr().err == "/dev/full ends here: [Errno 28] No space left on device\n"


LIVE = """
import sys
import numpy as np
from skin.live.loop import Display, watch_age
from skin.live.verdict import Verdict
from skin.live.view import VERDICTS, write_events
from time import monotonic

assert sys.argv[-1] == "live.verdicts=stdout"
shown = Display("run", "port", np.zeros((4, 3)), (0.1, 0.1), 4.0)
with watch_age(shown), write_events(shown, sys.stdout, shown.close, VERDICTS):
    shown.closed.wait(1)
    for _ in range(40):
        chances = {"big": 0.3, "dangerous": 1.0}
        said = Verdict(1.5, monotonic(), chances, True, {"dangerous": True}, True, False, (), 0.4)
        shown.set_verdict(said, monotonic())
        if shown.closed.wait(0.05):
            break
print("ended", file=sys.stderr)
sys.exit(0)
"""
"""What stands for ``skin live``: a heartbeat, and dangerous verdicts for two seconds."""


def test_a_command_whose_reader_leaves_ends_with_code_0():
    command = [sys.executable, "-c", LIVE, "live.verdicts=stdout"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as live:
        assert json.loads(live.stdout.readline())["stale"] is True
        live.stdout.close()
        assert live.stderr.read() == b"ended\n"
    assert live.returncode == 0


def stand_in(published, parameters):
    """Return modules with the part of rclpy and std_msgs that the node uses."""

    class Node:
        def __init__(self, name):
            self.name = name

        def declare_parameter(self, name, default):
            return SimpleNamespace(value=parameters.get(name, default))

        def create_publisher(self, kind, topic, depth):
            return SimpleNamespace(publish=lambda message: published.append((topic, message.data)))

        def get_logger(self):
            return SimpleNamespace(warning=lambda text: None)

        def destroy_node(self):
            published.append(("destroyed", self.name))

    node, msg = SimpleNamespace(Node=Node), SimpleNamespace(Bool=SimpleNamespace, String=SimpleNamespace)
    packages = {"rclpy": SimpleNamespace(node=node), "std_msgs": SimpleNamespace(msg=msg)}
    return packages | {"rclpy.node": node, "std_msgs.msg": msg}


def test_the_ros_node_publishes_verdicts_and_marks_their_loss(monkeypatch):
    published = []
    wrapped = [sys.executable, "-c", f"print(3, flush=True)\n{LIVE}"]
    for name, module in stand_in(published, {"command": wrapped}).items():
        monkeypatch.setitem(sys.modules, name, module)
    path = ROOT / "docs" / "examples" / "ros2_node.py"
    assert len(path.read_text().splitlines()) <= 90
    spec = importlib.util.spec_from_file_location("ros2_node", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    monkeypatch.setattr(example, "SILENCE", 2 * HEARTBEAT)

    node = example.SkinNode()
    for entry in (("~/stale", True), ("~/danger", False), ("~/danger", True), ("~/stale", False)):
        until(lambda entry=entry: entry in published)
    node._live.wait(PATIENCE)
    lines = [json.loads(data) for topic, data in published if topic == "~/verdict"]
    assert any(line["event"] == "verdict" for line in lines)
    contacts = [json.loads(data) for topic, data in published if topic == "~/contacts"]
    assert [told for told in contacts if len(told) > 3] == [line["contacts"] for line in lines]
    sleep(2 * HEARTBEAT)
    published.clear()
    until(lambda: ("~/stale", True) in published)
    lost = [json.loads(data) for topic, data in published if topic == "~/contacts"]
    assert {contacts["state"] for contacts in lost} <= {"unknown"}
    assert "exit code of skin live: 0" in lost[-1]["reason"]
    assert ("~/danger", False) not in published  # that no line comes clears no alarm
    node.destroy_node()
    assert published[-1] == ("destroyed", "skin")
