"""A sweep tells the time left."""

import pytest

from skin.progress import SweepProgress, expected_seconds, format_duration


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
    assert two - 5 == pytest.approx(2 * (one - 5))
    assert expected_seconds(Empty(), configured(), known | {"row": "custom"}) is None
