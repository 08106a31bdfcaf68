"""The name of an option, from its class, a function or an object of it."""

from functools import partial

import pytest

from skin.body.layout import Grid
from skin.core.settings import option_name
from skin.device.base import Blank
from skin.learning.representation import Interpolation
from skin.mechanics.simulator.fem import PlatesAndBeams


@pytest.mark.parametrize(
    ("made", "name"),
    [
        (PlatesAndBeams, "fem"),
        (Interpolation, "interp"),
        (Grid(), "grid"),
        (Blank(None, (1.0, 1.0), None), "base"),
        (partial, "functools"),
        (option_name, "settings"),
    ],
)
def test_an_option_is_named_after_its_file_of_settings_or_its_module(made, name):
    assert option_name(made) == name
