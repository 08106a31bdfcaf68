"""Alarms counted by hand."""

import math

import pytest
import torch
from scipy.stats import poisson

from skin.evaluation.alarm import Alarms, count_alarms


def count(alarm, gesture, dangerous=(True, False, True, True)):
    said = torch.tensor([one == "!" for one in alarm])
    shown = torch.tensor([int(one) if one.isdigit() else -1 for one in gesture])
    return count_alarms(said, shown, torch.tensor(dangerous), 0.5)


def test_an_alarm_that_lasts_is_one_and_one_that_outlasts_its_touch_is_false():
    found = count("!!..!.!!!!..!", "...........2.")
    assert (found.false, found.idle_hours) == (4, 6.0)
    found = count(".!!!!..", ".000...")
    assert (found.false, found.found) == (1, 1)
    assert count(".!!!...", ".000...").false == 0


def test_touches_that_raised_an_alarm():
    found = count("..!..!.......", ".000.111.222.")
    assert (found.dangerous, found.found, found.safe, found.raised) == (2, 1, 1, 1)
    assert found.false == 0


def test_touches_that_no_window_shows_are_not_counted():
    found = count("....", "....")
    assert (found.dangerous, found.safe, found.false) == (0, 0, 0)


@pytest.mark.parametrize("false", [0, 1, 7, 40])
def test_the_range_holds_the_rates_under_which_the_count_is_no_surprise(false):
    found = Alarms(2.0, false, 0, 0, 0, 0)
    low, high = found.range
    assert found.per_hour == false / 2
    assert poisson.cdf(false, high * 2) == pytest.approx(0.025)
    assert low == 0 if not false else poisson.sf(false - 1, low * 2) == pytest.approx(0.025)


def test_without_idle_time_there_is_no_rate():
    found = count("!!", "00")
    assert math.isnan(found.per_hour)
    assert math.isnan(found.range[1])
