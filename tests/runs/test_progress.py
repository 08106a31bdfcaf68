"""A command tells how far it is, and the time left."""

from time import sleep

import pytest

from skin.core.messages import Steps, format_duration


@pytest.mark.parametrize(
    ("duration", "text"), [(0.4, "0 s"), (89, "89 s"), (91, "2 min"), (7200, "120 min"), (9000, "2.5 h")]
)
def test_a_duration_is_told_in_seconds_minutes_or_hours(duration, text):
    assert format_duration(duration) == text


def test_steps_say_the_share_and_the_time_that_is_left(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("skin.core.messages.time.monotonic", lambda: now[0])
    steps = Steps({"load": 10, "evaluate": 30})
    now[0] += 5
    assert steps.line() == "load: 12 % done, about 35 s left"
    now[0] += 1000  # longer than expected
    assert steps.line().startswith("load: 24 % done")
    now[0] = 120.0
    steps.begin("evaluate")
    now[0] += 30  # a machine of half the speed
    assert steps.line() == "evaluate: 62 % done, about 30 s left"


def test_steps_report_without_a_terminal(capsys):
    with Steps({"load": 1.0}, pause=0.01):
        sleep(0.1)
    assert capsys.readouterr().err.startswith("load: ")
    sleep(0.05)
    assert capsys.readouterr().err == ""
