"""Signed features, on slides that are made by hand."""

import math

import pytest
import torch

from skin.device.touches import Touches
from skin.learning.features import direction_features

GRID = torch.cartesian_prod(torch.linspace(0.01, 0.15, 8), torch.linspace(0.01, 0.15, 8))
POSITIONS = torch.cat([GRID, torch.full((64, 1), 0.005)], dim=1)


def slide(angle: float, order: torch.Tensor | None = None) -> Touches:
    """Return a bump of 15 mm that moves 8 mm a frame through the middle for 10 of 20 frames."""
    places = POSITIONS if order is None else POSITIONS[order]
    steps = torch.arange(10) - 4.5
    way = 0.08 + 0.008 * steps[:, None] * torch.tensor([math.cos(angle), math.sin(angle)])
    distance = torch.cdist(way, places[:, :2])
    readings = torch.zeros(1, 20, 64)
    readings[0, 5:15] = 3 * torch.exp(-((distance / 0.015) ** 2))
    return Touches(readings, torch.ones_like(readings, dtype=torch.bool), places, None, 10.0)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.8, -1.2])
def test_every_vector_points_where_the_touch_goes(angle):
    found = direction_features(slide(angle))
    pairs = {name[: -len(", cosine with x")] for name in found if name.endswith(", cosine with x")}
    told = pairs - {"lean"}  # nothing pulls here
    assert len(told) == 13
    for name in told:
        x, y = (float(found[f"{name}, cosine with {axis}"]) for axis in "xy")
        assert math.cos(math.atan2(y, x) - angle) > 0.99, name
    assert found["lean, x"] == 0
    way = math.hypot(*(float(found[f"way of the centre 1 beyond 0.1 of the peak, {axis}"]) for axis in "xy"))
    assert way == pytest.approx(0.072, rel=0.05)
    slope = math.hypot(
        *(float(found[f"slope of the centre 2 beyond 0.25 of the peak, {axis}"]) for axis in "xy")
    )
    assert slope == pytest.approx(0.008, rel=0.05)


def test_a_pull_behind_is_a_lean_ahead():
    touches = slide(0.0)
    ahead = slide(0.0).readings.roll(-8, dims=2)
    touches.readings.sub_(0.4 * ahead)
    assert direction_features(touches)["lean, cosine with x"] > 0.9


def test_numbers_and_order_of_sensors_do_not_matter():
    order = torch.randperm(64, generator=torch.Generator().manual_seed(0))
    one, other = direction_features(slide(0.7)), direction_features(slide(0.7, order))
    for name, values in one.items():
        torch.testing.assert_close(values, other[name], atol=1e-5, rtol=1e-4)


def test_a_window_without_touch_tells_nothing():
    touches = slide(0.0)
    touches.readings.zero_()
    assert all((values == 0).all() for values in direction_features(touches).values())
