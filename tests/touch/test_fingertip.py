"""Fingertips press with their force, where they are."""

import pytest
import torch

from skin.body.sheet import Sheet
from skin.mechanics.geometry import Fingertip

SHEET = Sheet([0.12, 0.08], [24, 16], [{"material": "EcoFlex 00-30", "thickness": 0.01}])
TOUCHES = torch.tensor([[0.05, 0.03, 0.010, 5.0], [0.1, 0.06, 0.004, 1.0]], dtype=torch.float64)


def test_pressure_has_the_force_and_the_centre_of_the_touch():
    pressure = Fingertip(SHEET, 0.0015)(TOUCHES)
    assert pressure.shape == (2, 16, 24)
    force = pressure * (0.12 / 24 * 0.08 / 16)
    assert force.sum((1, 2)).numpy() == pytest.approx([5, 1], rel=1e-12)
    x, y = (torch.arange(count) * 0.005 + 0.0025 for count in (24, 16))
    assert ((force.sum(1) @ x.double()) / force.sum((1, 2))).numpy() == pytest.approx([0.05, 0.1], abs=2e-4)
    assert ((force.sum(2) @ y.double()) / force.sum((1, 2))).numpy() == pytest.approx([0.03, 0.06], abs=2e-4)
    pressure = Fingertip(SHEET, 2e-4)(torch.tensor([[0.06, 0.04, 0.02, 3.0]], dtype=torch.float64))
    assert pressure.max().item() == pytest.approx(3 / (torch.pi * 0.02**2), rel=0.01)
