"""A sweep tells the time left."""

from time import sleep

import pytest

from skin.core.messages import Steps, format_duration
from skin.runs.sweep import SweepProgress, expected_seconds


def test_nothing_known_gives_no_estimate():
    assert SweepProgress([None, None]).left() is None


def test_what_took_before_is_the_first_estimate():
    assert SweepProgress([10.0, None, 20.0]).left() == 45  # the unknown one like the mean of the others


def test_the_rest_follows_the_speed_of_this_machine():
    progress = SweepProgress([10.0, 10.0, 20.0])
    progress.finish(0, 30.0, skipped=False)
    assert progress.left() == 90


def test_a_skipped_job_says_nothing_about_speed():
    progress = SweepProgress([10.0, 10.0, 20.0])
    progress.finish(0, 0.01, skipped=True)
    assert progress.left() == 30


def test_jobs_that_finished_before_take_no_time():
    progress = SweepProgress([10.0, 10.0, None], finished={0, 1})
    assert progress.left() == 10  # the unknown one like the others, not like jobs that take no time


def test_a_continued_job_says_nothing_about_speed():
    progress = SweepProgress([10.0, 10.0, 20.0], partial={0})
    progress.finish(0, 1.0, skipped=False)
    assert progress.left() == 30
    progress.finish(1, 20.0, skipped=False)
    assert progress.left() == 40


@pytest.mark.parametrize(
    ("duration", "text"), [(0.4, "0 s"), (89, "89 s"), (91, "2 min"), (7200, "120 min"), (9000, "2.5 h")]
)
def test_a_duration_is_told_in_seconds_minutes_or_hours(duration, text):
    assert format_duration(duration) == text


class Empty:
    """A store without runs."""

    def find(self, status, **tags):
        return []


def test_the_published_table_tells_where_no_run_does(configured):
    known = {"row": "temporal_graph", "simulator": "fem"}
    one, two = (
        expected_seconds(
            Empty(), configured("experiment=temporal_graph", f"trainer.max_epochs={count}"), known
        )
        for count in (10, 20)
    )
    assert two - 25 == pytest.approx(2 * (one - 25))
    assert expected_seconds(Empty(), configured(), known | {"row": "custom"}) is None


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
