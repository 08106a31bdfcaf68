"""The name of an option, asked of its class, its factory or of what it has made."""

from functools import partial

import pytest

from skin.core.settings import option_name
from skin.device.base import Blank
from skin.mechanics.simulator.fem import PlatesAndBeams


@pytest.mark.parametrize(
    ("made", "name"),
    [(PlatesAndBeams, "fem"), (Blank(None, (1.0, 1.0), None), "base"), (partial, "functools")],
)
def test_an_option_is_named_after_its_module(made, name):
    assert option_name(made) == name
