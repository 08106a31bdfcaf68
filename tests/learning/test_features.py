"""Features of touches that are made by hand."""

import math
from itertools import groupby

import pytest
import torch

from skin.device.touches import Touches
from skin.learning.features import above_idle, direction_features, engineered_features, estimate_noise

PLACES = torch.tensor([[0.02, 0.02, 0.0], [0.06, 0.02, 0.0], [0.10, 0.02, 0.0], [0.06, 0.08, 0.0]])
GRID = torch.cartesian_prod(torch.linspace(0.01, 0.15, 8), torch.linspace(0.01, 0.15, 8))
POSITIONS = torch.cat([GRID, torch.full((64, 1), 0.005)], dim=1)


def touch(*forces, offset=0.0):
    """Return one touch of 10 frames; each of ``forces`` is (frame, sensor, N)."""
    readings = torch.full((1, 10, 4), offset)
    for frame, sensor, force in forces:
        readings[0, frame, sensor] += force
    return Touches(readings, torch.ones_like(readings, dtype=torch.bool), PLACES, None, 10.0)


def value(name, *forces, **options):
    return engineered_features(touch(*forces, **options))[name].item()


def test_a_slide_has_a_path_and_a_press_none():
    slide = [(2, 0, 2.0), (3, 1, 2.0), (4, 2, 2.0)]
    assert value("path of the centre 1", *slide) == pytest.approx(0.08)
    assert value("way of the centre 1", *slide) == pytest.approx(0.08)
    assert value("extent of the centre 1", *slide) == pytest.approx(0.08)
    assert value("reach of the centre 1", *slide) == pytest.approx(0.04)
    assert value("sensors that were strongest", *slide) == 3
    press = [(frame, 0, 2.0) for frame in (2, 3, 4)]
    assert value("path of the centre 1", *press) == pytest.approx(0, abs=1e-6)


def test_the_order_of_sensors_does_not_matter_and_their_number_not_to_the_names():
    generator = torch.Generator().manual_seed(0)
    readings = 3 * torch.rand(5, 10, 4, generator=generator)
    valid = torch.rand(5, 10, 4, generator=generator) > 0.1
    order = torch.tensor([2, 0, 3, 1])
    plain = engineered_features(Touches(readings, valid, PLACES, None, 10.0))
    turned = engineered_features(Touches(readings[..., order], valid[..., order], PLACES[order], None, 10.0))
    for name in plain:
        torch.testing.assert_close(turned[name], plain[name], msg=name, atol=1e-4, rtol=1e-4)
    one = engineered_features(Touches(readings[..., :1], valid[..., :1], PLACES[:1], None, 10.0))
    assert list(one) == list(plain)
    assert 120 <= len(plain) <= 140


def test_an_idle_window_or_a_dead_sensor_gives_numbers():
    idle = touch()
    broken = touch((3, 1, 2.0))
    broken.readings[0, :, 2] = float("nan")
    broken.valid[0, :, 2] = False
    for touches in (idle, broken):
        for name, column in engineered_features(touches).items():
            assert torch.isfinite(column.float()).all(), name


def random_touches(count, seed=3):
    """Return touches of which most frames are idle, with noise of up to 0.2 N."""
    generator = torch.Generator().manual_seed(seed)
    readings = 3 * torch.rand(count, 30, 4, generator=generator)
    readings *= torch.rand(count, 30, 4, generator=generator) > 0.8
    spread = 0.2 * torch.rand(count, 1, 1, generator=generator)
    readings += spread * torch.randn(count, 30, 4, generator=generator)
    valid = torch.rand(count, 30, 4, generator=generator) > 0.1
    return Touches(readings, valid, PLACES, None, 10.0)


def test_a_window_alone_gives_what_it_gives_in_a_batch():
    touches = random_touches(20)
    together = engineered_features(touches)
    for position in range(len(touches)):
        for name, alone in engineered_features(touches[position : position + 1]).items():
            torch.testing.assert_close(alone[0], together[name][position], rtol=1e-6, atol=1e-6, msg=name)


def test_runs_and_counts_are_those_that_plain_python_finds():
    touches = random_touches(50)
    found = engineered_features(touches)
    raw, noises = touches.readings.where(touches.valid, 0), estimate_noise(touches)
    idle = raw.quantile(0.2, dim=1, keepdim=True) + 0.8416 * noises[:, None, None]
    for position, (rows, noise) in enumerate(zip((raw - idle) * touches.valid, noises, strict=True)):
        peak, total, more = rows.amax(dim=1), rows.sum(dim=1), 3 * (noise - 0.05).clamp(min=0)
        levels = {
            "longest run above 1.0 N": (peak, 1.0 + more),
            "longest run above 0.3 of the peak": (peak, torch.maximum(0.3 * peak.max(), 3 * noise)),
            "longest run of the sum above 0.7 of its peak": (total, max(0.7 * total.max(), 6 * noise)),
        }
        for name, (series, level) in levels.items():
            runs = [len(list(run)) for on, run in groupby((series > level).tolist()) if on]
            assert found[name][position] == max(runs, default=0), name
        at_once = max(sum(force > 2.0 + more for force in row) for row in rows)
        assert found["most sensors above 2.0 N at once"][position] == at_once
        assert found["frames above 0.6 N"][position] == sum(force > 0.6 + more for force in peak)


@pytest.mark.parametrize("spread", [0.0, 0.02, 0.05, 0.1, 0.2])
def test_the_noise_of_a_device_is_found_beside_a_touch(spread):
    generator = torch.Generator().manual_seed(5)
    readings = spread * torch.randn(200, 30, 25, generator=generator)
    readings[:, 8:20, :6] += 4 * torch.rand(200, 1, 6, generator=generator)  # a large touch
    touches = Touches(readings, torch.ones_like(readings, dtype=torch.bool), torch.rand(25, 3), None, 10.0)
    assert estimate_noise(touches).mean().item() == pytest.approx(spread, rel=0.2, abs=1e-6)
    assert above_idle(touches)[:, :, 6:].mean().item() == pytest.approx(0, abs=0.1 * spread + 1e-6)


def slide(angle: float, order: torch.Tensor | None = None) -> Touches:
    """Return a bump of 15 mm that moves 8 mm a frame through the middle for 10 of 20 frames."""
    positions = POSITIONS if order is None else POSITIONS[order]
    steps = torch.arange(10) - 4.5
    way = 0.08 + 0.008 * steps[:, None] * torch.tensor([math.cos(angle), math.sin(angle)])
    distance = torch.cdist(way, positions[:, :2])
    readings = torch.zeros(1, 20, 64)
    readings[0, 5:15] = 3 * torch.exp(-((distance / 0.015) ** 2))
    return Touches(readings, torch.ones_like(readings, dtype=torch.bool), positions, None, 10.0)


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
    lengths = {"way of the centre 1 beyond 0.1": 0.072, "slope of the centre 2 beyond 0.25": 0.008}
    for name, length in lengths.items():
        x, y = (float(found[f"{name} of the peak, {axis}"]) for axis in "xy")
        assert math.hypot(x, y) == pytest.approx(length, rel=0.05)
