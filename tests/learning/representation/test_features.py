"""Readings above their idle level, beside engineered features."""

import pytest
import torch

from skin.learning.features import engineered_features
from skin.learning.representation import Features

TIME, SENSORS = 30, 5


@pytest.fixture
def made():
    generator = torch.Generator().manual_seed(3)
    readings = 0.05 * torch.randn(6, TIME, SENSORS, generator=generator)
    readings[:, 10:18] += torch.rand(6, 1, SENSORS, generator=generator)
    positions = torch.rand(SENSORS, 3, generator=generator)
    return Features(positions, (1.0, 1.0)), readings, torch.ones_like(readings, dtype=torch.bool)


def test_a_constant_offset_is_not_seen(made):
    represent, readings, valid = made
    offset = torch.linspace(-1, 1, SENSORS)
    torch.testing.assert_close(represent(readings + offset, valid).x, represent(readings, valid).x)


def test_both_views_of_one_newton_above_idle(made):
    represent = made[0]
    readings = torch.zeros(1, TIME, SENSORS)
    readings[0, 20, 2] = 1.0
    x = represent(readings, torch.ones_like(readings, dtype=torch.bool)).x[0, 20]
    assert x[2] == pytest.approx(1 / 3)
    # asinh(1 / 0.2) = ln(5 + sqrt(26))
    assert x[SENSORS + 2] == pytest.approx(2.3124383 / 2)
    assert x.count_nonzero() == 2


def test_the_summary_holds_every_feature(made, made_up_device):
    represent, readings, valid = made
    summary = represent(readings, valid).summary
    assert summary.shape == (6, len(engineered_features(made_up_device.touches("test"))))
    assert torch.isfinite(summary).all()
