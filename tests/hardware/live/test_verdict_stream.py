"""JSON lines: what they say, who gets them, and what happens to a reader that is gone."""

import importlib.util
import json
import socket
import sys
from contextlib import contextmanager
from threading import Thread
from time import monotonic, sleep
from types import ModuleType

import numpy as np
import pytest

from skin.core.files import ROOT
from skin.errors import InputError
from skin.hardware.live.loop import Display, DisplayInfo, watch_age
from skin.hardware.live.verdict import Verdict
from skin.hardware.live.verdicts import HEARTBEAT, stream_verdicts

PATIENCE = 60  # s


def display():
    return Display(DisplayInfo("run", "port", np.zeros((4, 3)), (0.1, 0.1), 4.0))


def verdict(dangerous=False, chance=0.25):
    labels = {"big": True, "dangerous": dangerous}
    chances = {"big": chance, "dangerous": float(dangerous)}
    return Verdict(1.5, monotonic(), chances, True, labels, dangerous, False, (2,), 0.4)


@contextmanager
def connected(shown):
    """Yield a function that returns the next message from a TCP port."""
    with stream_verdicts(shown, 0) as address:
        host, port = address.removeprefix("tcp://").split(":")
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as client:
            lines = client.makefile("rb")
            first = json.loads(lines.readline())  # a heartbeat, so the client is known from now on
            assert (first["event"], first["stale"]) == ("heartbeat", True)
            yield lambda: json.loads(lines.readline())


def wait_for(take, accepted):
    """Return the first message that is accepted."""
    deadline = monotonic() + PATIENCE
    while monotonic() < deadline:
        if accepted(message := take()):
            return message
    raise AssertionError("waited in vain")


def test_a_verdict_is_a_line():
    shown = display()
    with connected(shown) as take:
        shown.set_verdict(verdict(dangerous=True, chance=float("nan")))
        found = wait_for(take, lambda message: message["event"] == "verdict")
    assert found["schema"] == 1
    assert (found["alarm"], found["stale"], found["touched"], found["reason"]) == (True, False, True, "")
    assert found["labels"] == {"big": True, "dangerous": True}
    assert found["probabilities"] == {"big": None, "dangerous": 1.0}
    assert (found["device_time"], found["contact"], found["gap"], found["masked"]) == (1.5, 0.4, False, [2])
    assert found["time"].endswith("Z")


def test_a_verdict_that_is_too_old_is_stale_and_keeps_its_alarm():
    """Also where the engine hangs, which would tell nothing itself."""
    shown = display()
    with watch_age(shown), connected(shown) as take:
        shown.set_verdict(verdict(dangerous=True))
        began = monotonic()
        fresh = wait_for(take, lambda message: message["event"] == "verdict")
        old = wait_for(take, lambda message: message["stale"])
        assert 0.5 < monotonic() - began < PATIENCE
        assert (old["event"], old["alarm"], old["dangerous"], old["state"]) == (
            "change",
            True,
            True,
            "unknown",
        )
        assert old["notes"] == [{"code": "stale", "text": "no decision for longer than usual", "sensors": []}]
        assert old["number"] <= fresh["number"] + 2
        assert "labels" not in old


def test_the_first_line_tells_what_is_waited_for():
    shown = display()
    shown.set_verdict(None, "the threshold of the alarm is being chosen")
    with stream_verdicts(shown, 0) as address:
        host, port = address.removeprefix("tcp://").split(":")
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as client:
            message = json.loads(client.makefile("rb").readline())
    assert (message["reason"], message["state"]) == ("the threshold of the alarm is being chosen", "unknown")


def test_a_reason_is_sent_once_and_then_with_each_heartbeat():
    shown = display()
    with connected(shown) as take:
        for _ in range(3):
            shown.set_verdict(None, "unplugged", True)
        events = [take() for _ in range(3)]
    assert [one["event"] for one in events if one["reason"] == "unplugged"] == [
        "change",
        "heartbeat",
        "heartbeat",
    ]
    assert all(one["alarm"] for one in events)


def test_a_reader_that_is_gone_or_slow_delays_nothing():
    shown = display()
    with stream_verdicts(shown, 0) as address:
        host, port = address.removeprefix("tcp://").split(":")
        lazy = socket.create_connection((host, int(port)), timeout=PATIENCE)
        lazy.recv(1)
        socket.create_connection((host, int(port))).close()
        began = monotonic()
        for _ in range(20_000):
            shown.set_verdict(verdict())
        assert monotonic() - began < PATIENCE
        lazy.close()


def test_a_port_in_use_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as other:
        number = other.getsockname()[1]
        with pytest.raises(InputError, match="no verdicts on port"), stream_verdicts(display(), number):
            pass


def stand_in(published):
    """Return modules with the part of rclpy and std_msgs that the node uses."""
    rclpy, node, std_msgs, msg = map(ModuleType, ("rclpy", "rclpy.node", "std_msgs", "std_msgs.msg"))

    class Message:
        def __init__(self, data):
            self.data = data

    class Node:
        def __init__(self, name):
            self.name = name

        def declare_parameter(self, name, default):
            return type("Parameter", (), {"value": rclpy.parameters.get(name, default)})

        def create_publisher(self, kind, topic, depth):
            send = lambda message: published.append((topic, message.data))  # noqa: E731
            return type("Publisher", (), {"publish": staticmethod(send)})

        def get_logger(self):
            return type("Logger", (), {"warning": staticmethod(lambda text: None)})

        def destroy_node(self):
            published.append(("destroyed", self.name))

    node.Node, msg.Bool, msg.String, rclpy.parameters = Node, Message, Message, {}
    return {"rclpy": rclpy, "rclpy.node": node, "std_msgs": std_msgs, "std_msgs.msg": msg}


def test_the_ros_node_publishes_verdicts_and_marks_their_loss(monkeypatch):
    published = []
    modules = stand_in(published)
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    path = ROOT / "docs" / "examples" / "ros2_node.py"
    assert len(path.read_text().splitlines()) <= 90
    spec = importlib.util.spec_from_file_location("ros2_node", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    monkeypatch.setattr(example, "SILENCE", 4 * HEARTBEAT)

    def until(entry):
        deadline = monotonic() + PATIENCE
        while entry not in published:
            assert monotonic() < deadline, published[-3:]
            sleep(0.02)

    shown = display()
    with stream_verdicts(shown, 0) as address:
        modules["rclpy"].parameters = {"port": int(address.rpartition(":")[2])}
        node = example.SkinNode()
        until(("~/stale", True))
        until(("~/danger", False))
        pushing = Thread(
            target=lambda: [(shown.set_verdict(verdict(dangerous=True)), sleep(0.05)) for _ in range(40)]
        )
        pushing.start()
        until(("~/danger", True))
        until(("~/stale", False))
        pushing.join()
        lines = [json.loads(data) for topic, data in published if topic == "~/verdict"]
        assert any(line["event"] == "verdict" for line in lines)
        contacts = [json.loads(data) for topic, data in published if topic == "~/contacts"]
        assert contacts == [line["contacts"] for line in lines]
    published.clear()
    until(("~/stale", True))
    lost = [json.loads(data) for topic, data in published if topic == "~/contacts"]
    assert {contacts["state"] for contacts in lost} <= {"unknown"}
    assert ("~/danger", False) not in published  # the loss of the connection clears no alarm
    node.destroy_node()
    assert published[-1] == ("destroyed", "skin")
