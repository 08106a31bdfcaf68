"""Features of touches made by hand."""

from itertools import groupby

import pytest
import torch

from skin.recording import Touches
from skin.signal.features import engineered_features

PLACES = torch.tensor([[0.02, 0.02, 0.0], [0.06, 0.02, 0.0], [0.10, 0.02, 0.0], [0.06, 0.08, 0.0]])


def touch(*forces, offset=0.0):
    """Return one touch of 10 frames; each of ``forces`` is (frame, sensor, N)."""
    readings = torch.full((1, 10, 4), offset)
    for frame, sensor, force in forces:
        readings[0, frame, sensor] += force
    return Touches(readings, torch.ones_like(readings, dtype=torch.bool), PLACES, None, 10.0)


def value(name, *forces, **options):
    return engineered_features(touch(*forces, **options))[name].item()


def test_a_press_of_three_frames_then_one_more():
    press = [(2, 0, 2.5), (3, 0, 2.5), (4, 0, 2.5), (7, 0, 2.5)]
    assert value("longest run above 2.0 N", *press) == 3
    assert value("frames above 2.0 N", *press) == 4
    assert value("frames above 3.0 N", *press) == 0


def test_an_offset_of_the_sensors_does_not_matter():
    press = [(2, 0, 2.5), (3, 1, 1.5)]
    plain, moved = engineered_features(touch(*press)), engineered_features(touch(*press, offset=0.8))
    for name in plain:
        if "raw" not in name:
            assert moved[name].item() == pytest.approx(plain[name].item(), abs=1e-5), name


def test_a_slide_has_a_path_and_a_press_none():
    slide = [(2, 0, 2.0), (3, 1, 2.0), (4, 2, 2.0)]
    assert value("path of the centre 1", *slide) == pytest.approx(0.08)
    assert value("way of the centre 1", *slide) == pytest.approx(0.08)
    assert value("extent of the centre 1", *slide) == pytest.approx(0.08)
    assert value("reach of the centre 1", *slide) == pytest.approx(0.04)
    assert value("sensors that were strongest", *slide) == 3
    press = [(frame, 0, 2.0) for frame in (2, 3, 4)]
    assert value("path of the centre 1", *press) == pytest.approx(0, abs=1e-6)


def test_sensors_that_share_one_course_have_one_singular_value():
    press = [
        (frame, sensor, force * (sensor + 1)) for frame, force in ((2, 1.0), (3, 2.0)) for sensor in (0, 1)
    ]
    assert value("singular value 2 of the first", *press) == pytest.approx(0, abs=1e-5)
    slide = [(2, 0, 2.0), (3, 1, 2.0)]
    assert value("singular value 2 of the first", *slide) == pytest.approx(1, abs=1e-5)


def test_active_sensors_are_counted():
    wide = [(2, sensor, 1.5) for sensor in range(4)]
    assert value("sensors above 1.0 N", *wide) == 4
    assert value("most sensors above 1.0 N at once", *wide) == 4
    one_by_one = [(2 + sensor, sensor, 1.5) for sensor in range(4)]
    assert value("sensors above 1.0 N", *one_by_one) == 4
    assert value("most sensors above 1.0 N at once", *one_by_one) == 1


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
    generator = torch.Generator().manual_seed(seed)
    readings = 3 * torch.rand(count, 30, 4, generator=generator)
    readings *= torch.rand(count, 30, 4, generator=generator) > 0.5
    valid = torch.rand(count, 30, 4, generator=generator) > 0.1
    return Touches(readings, valid, PLACES, None, 10.0)


def test_a_window_alone_gives_what_it_gives_in_a_batch():
    touches = random_touches(20)
    together = engineered_features(touches)
    for place in range(len(touches)):
        for name, alone in engineered_features(touches[place : place + 1]).items():
            torch.testing.assert_close(alone[0], together[name][place], rtol=1e-6, atol=1e-6, msg=name)


def test_runs_and_counts_are_those_that_plain_python_finds():
    touches = random_touches(50)
    found = engineered_features(touches)
    raw = touches.readings.where(touches.valid, 0)
    x = (raw - raw.quantile(0.2, dim=1, keepdim=True)) * touches.valid
    for place, rows in enumerate(x):
        peak, total = rows.amax(dim=1), rows.sum(dim=1)
        for series, level, name in (
            (peak, 1.0, "longest run above 1.0 N"),
            (peak, 0.3 * peak.max(), "longest run above 0.3 of the peak"),
            (total, 0.7 * total.max(), "longest run of the sum above 0.7 of its peak"),
        ):
            runs = [len(list(run)) for on, run in groupby((series > level).tolist()) if on]
            assert found[name][place] == max(runs, default=0), name
        at_once = max(sum(force > 2.0 for force in row) for row in rows.tolist())
        assert found["most sensors above 2.0 N at once"][place] == at_once
        assert found["frames above 0.6 N"][place] == sum(force > 0.6 for force in peak.tolist())
