"""Frames of a device become frames of a model."""

import numpy as np
import pytest

from skin.errors import InputError
from skin.port.frame import Frame
from skin.session.reduction import check_rate, rate_of, reduced


def frame(t, *values, valid=None, lost=0):
    row = np.array(values, dtype=float)
    good = np.ones(len(row), dtype=bool) if valid is None else np.array(valid)
    return Frame(None, t, t, row, good, 0, lost)


def test_the_largest_of_each_interval():
    frames = [frame(number / 100, number % 7, -number) for number in range(100)]
    values, valid = reduced(frames, 0.2, 10.0, 5)
    by_hand = [[max(n % 7 for n in range(k, k + 10)), -k] for k in range(20, 70, 10)]
    assert values.tolist() == by_hand
    assert valid.all()


def test_one_bad_frame_spoils_its_channel_for_the_interval():
    frames = [frame(number / 100, 1.0, 2.0) for number in range(20)]
    frames[13] = frame(0.13, 9.0, 2.0, valid=[False, True])
    _, valid = reduced(frames, 0.0, 10.0, 2)
    assert valid.tolist() == [[True, True], [False, True]]


def test_nothing_is_invented_where_no_frame_came():
    values, valid = reduced([frame(0.0, 5.0), frame(0.25, 5.0)], 0.0, 10.0, 3)
    assert values[:, 0].tolist() == [5, 0, 5]
    assert valid[:, 0].tolist() == [True, False, True]


def test_lost_frames_count_for_the_rate():
    assert rate_of([frame(0.0, 1), frame(0.01, 1), frame(0.05, 1, lost=3)]) == pytest.approx(100)


def test_a_slower_device_is_refused_with_both_rates():
    check_rate(9.9, 10.0)
    with pytest.raises(InputError, match=r"sends 5 frames a second, the model needs 10"):
        check_rate(5.0, 10.0)
