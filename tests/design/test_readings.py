"""The covariance is that of the device's own simulator, however the readings are computed."""

import numpy as np
import pytest
import torch

from skin.body.base import Sensors
from skin.core.rng import Stream, generator
from skin.design.place import reading_covariance
from skin.runs.build import build_device
from skin.touch.movie import balanced

SMALL = ("body.cells=[12,12]", "layout=grid", "layout.rows=3", "layout.columns=3", "touch.over_sensors=false")
SIMULATORS = [("naive", ()), ("solid", ("simulator.divisions=1",)), ("fem", ())]


def covariance(device, sensors=None, touches=40, seed=0, clip=10.0):
    return reading_covariance(device, sensors or device.sensors, touches, seed, clip)


@pytest.mark.parametrize(("simulator", "settings"), SIMULATORS)
def test_is_that_of_clipped_readings_during_contact(configured, simulator, settings):
    device = build_device(configured(f"simulator={simulator}", *SMALL, *settings))
    found, frames = covariance(device, clip=0.5)
    labels = balanced(40, generator(Stream.PLACEMENT, 0, 0))
    movie = device.sampler.sample(40, generator(Stream.PLACEMENT, 0, 1), labels)
    readings = device.model.respond(movie, displacement=False).readings[movie.scale > 0]
    assert readings.abs().max() > 0.5
    expected = np.cov(readings.clamp(-0.5, 0.5).double().numpy().T, bias=True)
    assert frames == len(readings) == int((movie.scale > 0).sum())
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-5 * np.abs(expected).max())


def test_of_other_sensors_needs_no_simulator_of_them(configured):
    """Solving for each sensor gives the same."""
    device = build_device(configured("simulator=solid", *SMALL, "simulator.divisions=1"))
    sensors = Sensors(np.array([[0.05, 0.03, 0.005], [0.071, 0.11, 0.005]]), (0.01, 0.01))
    found, _ = covariance(device, sensors)
    other = build_device(configured("simulator=solid", *SMALL, "simulator.divisions=1"))
    other.model.pressure_rows = lambda _: None
    expected, _ = covariance(other, sensors)
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-5 * np.abs(expected).max())


def test_friction_is_part_of_readings(configured):
    device = build_device(configured("simulator=solid", *SMALL, "simulator.divisions=1", "touch.shear=0.5"))
    tilted = Sensors(np.array([[0.05, 0.03, 0.005]]), (0.01, 0.01), np.array([[0.6, 0.0, 0.8]]))
    sheared, _ = covariance(device, tilted)
    without = build_device(configured("simulator=solid", *SMALL, "simulator.divisions=1"))
    plain, _ = covariance(without, tilted)
    assert sheared[0, 0] > 1.02 * plain[0, 0]


def test_depends_on_the_seed_and_on_nothing_else(configured):
    device = build_device(configured("simulator=naive", *SMALL))
    first, _ = covariance(device)
    torch.manual_seed(3)
    again, _ = covariance(device.replace(seed=5, data_seed=7))
    assert np.array_equal(first, again)
    assert not np.allclose(first, covariance(device, seed=1)[0])
