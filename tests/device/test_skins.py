"""Touches on many skins, drawn in their ranges: what a batch holds, and that test skins are others."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from skin import Arm, Grid, InputError, Sheet, Solid
from skin.body.base import GEOMETRY, Layer
from skin.body.material import Material
from skin.core.files import CONF
from skin.core.rng import Stream, generator
from skin.device import skins
from skin.device.skins import SkinDistribution
from skin.runs.build import build_device

SMALL = (
    "device=skins", "device.count=2", "device.test_skins=1", "device.skins.length=[0.08,0.1]",
    "device.skins.aspect=[1,1.2]", "device.skins.cell=0.01", "device.skins.sensors=[4,9]",
    "device.skins.divisions=1", "data.gestures=100", "device.test_gestures=32", "device.fresh=true",
)  # fmt: skip


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured(*SMALL))


def test_touches_of_skins_with_few_sensors_are_filled_up(device):
    touches = device.touches("train", 1)
    counts = [len(skin.sensors) for skin in device.training_skins]
    assert touches.readings.shape == (80, 30, max(counts))
    assert touches.positions.shape == (80, max(counts), 3)
    assert touches.geometry.shape == (80, max(counts), len(GEOMETRY))
    working = touches.valid.any(dim=1).sum(dim=1)
    assert set(working.tolist()) <= {count - dead for count in counts for dead in range(count // 4 + 1)}
    assert torch.equal(touches.geometry[..., :2], touches.positions[..., :2])
    assert touches.labels.mean(0).tolist() == pytest.approx([0.5] * 4, abs=0.05)


def test_an_epoch_is_new_and_repeatable_and_validation_stays(device):
    first, second = device.touches("train", 1), device.touches("train", 2)
    assert torch.equal(first.readings, device.touches("train", 1).readings)
    assert not torch.equal(first.readings, second.readings)
    assert device.touches("validation", 1) is device.touches("validation", 2)
    sizes = {skin.body.size for skin in device.training_skins}
    assert not sizes & {skin.body.size for skin in device.unseen_skins}
    assert len(device.touches("test")) == 32


def test_training_skins_may_have_other_touches(configured):
    changes = "+device.training_touch.second=0.5", "+device.training_touch.press=[0.4,2.8]"
    wider = build_device(configured(*SMALL, *changes))
    assert {skin.sampler.settings.second for skin in wider.training_skins} == {0.5}
    assert {skin.sampler.settings.frames.press for skin in wider.training_skins} == {(4, 28)}
    for skin in (*wider.unseen_skins, wider.reference):
        assert (skin.sampler.settings.second, skin.sampler.settings.frames.press) == (0.0, (4, 20))
    with pytest.raises(InputError, match=r"touch\.window"):
        build_device(configured(*SMALL, "+device.training_touch.window=4.0"))
    with pytest.raises(InputError, match=r"device\.skins\.interface must be at most 1, got 1\.1"):
        build_device(configured(*SMALL, "device.skins={plates: 0.6, naive: 0.5}"))


def test_no_stream_defines_a_skin_and_orders_an_epoch(configured, monkeypatch):
    """With skin_seed=0 and data_seed=0, one stream used to do both for skin e and epoch e."""
    fresh, used = build_device(configured(*SMALL)), []

    def noted(stream, *key):
        used.append((stream, *key))
        return generator(stream, *key)

    monkeypatch.setattr(skins, "generator", noted)
    assert fresh.training_skins
    assert fresh.unseen_skins
    defining = set(used)
    used.clear()
    for epoch in range(fresh.count):
        fresh.touches("train", epoch)
    for split in ("validation", "holdout", "test"):
        fresh.touches(split)
    assert len(defining) == fresh.count + fresh.test_skins
    assert used
    assert not defining & set(used)


def test_a_blank_device_prepares_no_skin(configured):
    fresh = build_device(configured(*SMALL))
    blank = fresh.blank()
    assert blank.touches("train").readings.shape == (1, 30, 25)
    assert "training_skins" not in vars(fresh)


@pytest.fixture(scope="module")
def distribution():
    settings = OmegaConf.to_container(OmegaConf.load(CONF / "device" / "skins.yaml").skins)
    return SkinDistribution(**settings)


def test_skin_distributions_lie_in_their_ranges(distribution):
    kinds, bodies = set(), set()
    for number in range(60):
        skin = SimpleNamespace(**distribution.draw(generator(Stream.SKIN, 0, 0, number)))
        sensors = skin.layout.sensors(skin.body)
        kinds.add(type(skin.layout).__name__)
        bodies.add(type(skin.body))
        assert 4 <= len(sensors) <= 72  # the last row of a grid may be longer than wanted
        assert 0.08 <= max(skin.body.size) <= 0.32
        assert max(skin.body.size) / min(skin.body.size) <= 3 + 1e-9
        top = skin.body.layers[-1].thickness
        assert (sensors.positions[:, 2] >= 0.5 * top - 1e-12).all()
        assert (sensors.positions[:, 2] <= top + 1e-12).all()
        apart = np.abs(sensors.positions[:, None, :2] - sensors.positions[None, :, :2])
        meet = (apart < np.array(sensors.footprint) - 1e-6).all(axis=2)
        assert meet.sum() == len(sensors), type(skin.layout)
    assert kinds == {"Grid", "Scattered", "Hexagonal", "Random", "Listed"}
    assert bodies == {Sheet, Arm}


def test_a_skin_that_reads_forces_between_layers_is_described_as_a_solid(distribution):
    def drawn(settings, number):
        return SimpleNamespace(**settings.draw(generator(Stream.SKIN, 0, 0, number), mixed=True))

    def simulators(mixed):
        skins = [distribution.draw(generator(Stream.SKIN, 0, 0, n), mixed) for n in range(60)]
        return [getattr(one["simulator"], "func", one["simulator"]).__name__ for one in skins]

    assert set(simulators(False)) == {"Solid"}, "as those of tests are"
    assert set(simulators(True)) == {"Solid", "PlatesAndBeams", "Naive"}
    assert 40 <= simulators(True).count("Solid") < 60
    mixed = replace(distribution, interface=0.5, footprint_error=0.1)
    kinds = {False: 0, True: 0}
    for number in range(40):
        skin, former = drawn(mixed, number), drawn(distribution, number)
        assert skin.body.size == former.body.size
        assert skin.position_error == former.position_error
        assert (skin.footprint_error, former.footprint_error) == (0.1, 0.0)
        interface = getattr(skin.simulator, "keywords", {}).get("reading") == "interface"
        kinds[interface] += 1
        assert interface == (skin.described is not None)
        if interface:
            assert skin.described.func is Solid
            top = skin.body.layers[-1].thickness
            assert (skin.layout.sensors(skin.body).positions[:, 2] == top).all()
        else:
            kind, before = (getattr(one.simulator, "func", one.simulator) for one in (skin, former))
            assert kind is before
    assert min(kinds.values()) > 10


def test_what_is_outside_is_named(distribution):
    layers = [Layer(Material("hard", 2e5, 0.49), 0.01), Layer(Material("soft", 1e5, 0.49), 0.01)]
    known = Sheet((0.16, 0.16), (16, 16), layers)
    grid = lambda count, **depth: Grid(count, count, (0.01, 0.01), **depth)  # noqa: E731
    assert distribution.outside(known, grid(5).sensors(known)) == []
    assert distribution.outside(known, grid(9).sensors(known)) == ["number of sensors 81 (4 to 64)"]
    (shallow,) = distribution.outside(known, grid(5, depth=0.002).sensors(known))[:1]
    assert shallow == "least depth over upper layer 0.2 (0.5 to 1)"
    large = Sheet((0.5, 0.5), (16, 16), layers[:1])
    expected = ["longer side 0.5 m (0.08 to 0.32 m)", "number of layers 1 (2 to 2)"]
    assert distribution.outside(large, grid(5).sensors(large)) == expected
