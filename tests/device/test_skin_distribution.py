"""Drawn skins lie in their ranges, and a skin outside is told by its numbers."""

from dataclasses import replace

import numpy as np
import pytest
from omegaconf import OmegaConf

from skin.body.arm import Arm
from skin.body.base import Layer
from skin.body.layout import Grid
from skin.body.material import Material
from skin.body.sheet import Sheet
from skin.core.files import CONF
from skin.core.rng import Stream, generator
from skin.device.skins import SkinDistribution
from skin.mechanics.simulator.solid import Solid


@pytest.fixture(scope="module")
def distribution():
    settings = OmegaConf.to_container(OmegaConf.load(CONF / "device" / "skins.yaml").skins)
    return SkinDistribution(**settings)


def test_skin_distributions_lie_in_their_ranges(distribution):
    kinds, bodies = set(), set()
    for number in range(60):
        skin = distribution.draw(generator(Stream.SKIN, 0, 0, number))
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
        return settings.draw(generator(Stream.SKIN, 0, 0, number), mixed=True)

    def simulators(mixed):
        skins = [distribution.draw(generator(Stream.SKIN, 0, 0, n), mixed) for n in range(60)]
        return [getattr(one.simulator, "func", one.simulator).__name__ for one in skins]

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
            assert getattr(skin.simulator, "func", skin.simulator) is getattr(
                former.simulator, "func", former.simulator
            )
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
    assert distribution.outside(large, grid(5).sensors(large)) == [
        "longer side 0.5 m (0.08 to 0.32 m)",
        "number of layers 1 (2 to 2)",
    ]
