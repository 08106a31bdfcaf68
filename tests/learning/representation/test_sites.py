"""Virtual sites do not depend on the number and the order of the sensors."""

from dataclasses import replace

import pytest
import torch

from skin.body.base import GEOMETRY
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.representation import Sites


@pytest.fixture
def touches():
    """Five touches of nine sensors on a skin of 0.2 x 0.1 m; one sensor is dead in the first touch."""
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(5, 12, 9, generator=generator)
    sites = torch.rand(9, 2, generator=generator) * torch.tensor([0.2, 0.1])
    geometry = torch.rand(9, len(GEOMETRY), generator=generator)
    geometry[:, :2] = sites
    geometry[:, GEOMETRY.index("width")], geometry[:, GEOMETRY.index("height")] = 0.2, 0.1
    valid = torch.ones(5, 12, 9, dtype=torch.bool)
    valid[0, :, 3] = False
    positions = torch.cat([sites, torch.full((9, 1), 0.005)], dim=1)
    return Touches(readings, valid, positions, None, 10.0, geometry=geometry, saturated=readings > 0.98)


def shown(touches):
    return Sites(touches.positions, (0.2, 0.1)).show(touches)


def test_the_shape_does_not_depend_on_the_sensors(touches):
    frames = shown(touches)
    assert frames.x.shape == (5, 12, 36 * 3 * 4 + 2 * 10 + 2)
    assert frames.summary.shape == (5, 1 + 3 * len(GEOMETRY) + 36 * 3 + 107)
    assert torch.isfinite(frames.x).all()
    assert torch.isfinite(frames.summary).all()


def test_the_order_of_sensors_does_not_matter(touches):
    order = torch.randperm(9, generator=torch.Generator().manual_seed(1))
    other = replace(
        touches,
        readings=touches.readings[..., order],
        valid=touches.valid[..., order],
        saturated=touches.saturated[..., order],
        positions=touches.positions[order],
        geometry=touches.geometry[order],
    )
    for found, expected in zip(shown(other)[::2], shown(touches)[::2], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("filled", [0.0, 100.0])
def test_a_dead_sensor_changes_nothing(touches, filled):
    extra = torch.full((5, 12, 1), torch.nan)
    other = replace(
        touches,
        readings=torch.cat([touches.readings, extra], dim=2),
        valid=torch.cat([touches.valid, extra == 0], dim=2),
        saturated=torch.cat([touches.saturated, extra != extra], dim=2),
        positions=torch.cat([touches.positions, torch.zeros(1, 3)]),
        geometry=torch.cat([touches.geometry, filled * torch.ones(1, len(GEOMETRY))]),
    )
    for found, expected in zip(shown(other)[::2], shown(touches)[::2], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_each_touch_may_have_a_skin_of_its_own(touches):
    each = replace(
        touches,
        positions=touches.positions.expand(5, 9, 3),
        geometry=touches.geometry.expand(5, 9, len(GEOMETRY)).clone(),
    )
    torch.testing.assert_close(shown(each).x, shown(touches).x)
    each.geometry[2, :, 0] /= 2
    moved = (shown(each).x - shown(touches).x).abs().amax((1, 2))
    assert (moved > 1e-3).tolist() == [False, False, True, False, False]


def test_a_reading_appears_at_the_site_where_its_sensor_is(touches):
    readings = torch.zeros(1, 12, 9)
    readings[:, 11, 4] = 2.0
    one = replace(
        touches[:1], readings=readings, saturated=None, valid=torch.ones(1, 12, 9, dtype=torch.bool)
    )
    linear = shown(one).x[0, 11, : 36 * 4].view(36, 4)[:, 0]
    x, y = one.positions[4, :2] / torch.tensor([0.2, 0.1])
    sites = torch.stack(
        torch.meshgrid((torch.arange(6) + 0.5) / 6, (torch.arange(6) + 0.5) / 6, indexing="xy"), -1
    )
    distance = (sites.flatten(0, 1) - torch.stack([x, y])).norm(dim=1)
    assert distance[linear.argmax()] < 0.35
    assert linear.max() <= 2.0 / 3.0 + 1e-6


def test_touches_of_unknown_mechanics_are_refused(touches):
    with pytest.raises(InputError, match="representation=sites needs to know what each sensor responds to"):
        shown(replace(touches, geometry=None))
