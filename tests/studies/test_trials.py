"""Conditions of a study and their devices."""

import pytest

from experiments.studies.study import Study
from experiments.studies.trials import numbered_settings
from skin.errors import InputError


def study(**settings):
    return Study("x", "x", [0], **settings)


def test_a_condition_without_lists_has_one_device():
    assert list(numbered_settings(study(), {"device.noise": 0.1})) == [("", {"device.noise": 0.1})]


def test_a_list_gives_each_device_its_value():
    condition = {"layout": "random", "layout.seed": [7, 8]}
    assert list(numbered_settings(study(), condition)) == [
        ("1", {"layout": "random", "layout.seed": 7}),
        ("2", {"layout": "random", "layout.seed": 8}),
    ]


def test_numbered_settings_are_the_number_of_the_device():
    found = list(numbered_settings(study(devices=2, numbered=["device.seed"]), {"device.dead": 1}))
    assert found == [("1", {"device.dead": 1, "device.seed": 1}), ("2", {"device.dead": 1, "device.seed": 2})]


def test_lists_of_different_lengths_are_refused():
    with pytest.raises(InputError, match="one length"):
        list(numbered_settings(study(devices=3, numbered=["device.seed"]), {"layout.seed": [1, 2]}))
