"""The log of alarms."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from time import monotonic

import numpy as np
import pytest

from skin.errors import InputError
from skin.live.loop import Display, DisplayInfo
from skin.live.verdict import Verdict
from skin.live.verdicts import LineQueue, log_alarms


def display():
    return Display(DisplayInfo("run", "port", np.zeros((4, 3)), (0.1, 0.1), 4.0), calm=0.0)


def verdict(dangerous):
    return Verdict(
        1.5, monotonic(), {"dangerous": 0.9}, True, {"dangerous": dangerous}, dangerous, False, (), 0.4
    )


def test_each_change_is_a_line_with_its_time(tmp_path):
    shown, path = display(), tmp_path / "logs" / "alarms.jsonl"
    before = datetime.now(UTC)
    with log_alarms(shown, path):
        shown.set_verdict(None, monotonic(), "filling the window: 20 %")
        for dangerous in (False, True, True):
            shown.set_verdict(verdict(dangerous), monotonic())
        shown.set_verdict(None, monotonic(), "unplugged", True)
        shown.set_verdict(verdict(True), monotonic())
        shown.request_tare(monotonic())
        shown.set_verdict(verdict(False), monotonic())
        shown.set_verdict(verdict(True), monotonic())
    shown.set_verdict(verdict(True), monotonic())  # after the end
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
    with log_alarms(shown, path):
        pass
    assert len(path.read_text().splitlines()) == len(found) + 2  # appended


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"live\.log=FILE"), log_alarms(display(), tmp_path / "file" / "log"):
        pass


def test_a_full_disk_ends_the_log_and_not_the_view():
    class Full:
        def write(self, text):
            raise OSError("No space left on device")

    errors = []
    with LineQueue(Full(), errors.append) as lines:
        for _ in range(3):
            lines.add({"event": "alarm"})
    assert [str(error) for error in errors] == ["No space left on device"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device")
def test_a_full_disk_does_not_hide_how_the_view_ends(capsys):
    """Closing the file raised an error of its own: SIGTERM ended with code 2."""
    shown = display()
    with pytest.raises(SystemExit, match="143"), log_alarms(shown, Path("/dev/full")):
        raise SystemExit(143)
    assert capsys.readouterr().err == "the alarm log ends here: [Errno 28] No space left on device\n"


def test_the_log_is_valid_json_whatever_a_verdict_holds(tmp_path):
    shown, path = display(), tmp_path / "alarms.jsonl"
    broken = Verdict(
        float("inf"), monotonic(), {"a": float("nan")}, True, {"a": True}, True, False, (), 1e300
    )
    with log_alarms(shown, path):
        shown.set_verdict(broken, monotonic())
    messages = [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]
    assert {message.get("device_time") for message in messages} == {None}
