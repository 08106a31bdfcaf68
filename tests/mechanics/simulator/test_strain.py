"""The largest strain of the linear solution, against what is known and against a direct look at it."""

import numpy as np
import pytest
import torch

from skin.body.base import Sensors, Sheet
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.solid import Solid

SOFT = {"name": "soft", "young": 1e5, "poisson": 0.3}
BODY = Sheet([0.2, 0.2], [10, 10], [{"material": SOFT, "thickness": high} for high in (0.01, 0.005)])
SENSORS = Sensors(np.array([[0.1, 0.1, 0.005]]), (0.01, 0.01))


def test_plates_and_beams_are_squeezed_like_a_column():
    """Under even pressure each layer is a column: p / E, but at the free edges."""
    strain = PlatesAndBeams(BODY, SENSORS).strain(torch.full((1, 10, 10), 2e4))
    assert strain.item() == pytest.approx(0.2, rel=0.1)


def test_a_wide_solid_is_squeezed_as_in_an_oedometer():
    """Confined: p (1 + nu) (1 - 2 nu) / (E (1 - nu)) in the middle; the free edges bulge further."""
    confined = 2e4 * 1.3 * 0.4 / (1e5 * 0.7)
    even = torch.full((1, 10, 10), 2e4)
    assert confined < Solid(BODY, SENSORS, divisions=2).strain(even).item() < 2 * confined
