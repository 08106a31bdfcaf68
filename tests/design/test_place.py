"""`skin design design=place` as a person runs it: the covariance of its readings, and its files."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from PIL import Image

from skin.body.base import Sensors, Sheet
from skin.body.layout import File
from skin.core.files import CONF
from skin.core.rng import Stream, generator
from skin.design.place import Place, reading_covariance
from skin.errors import InputError
from skin.runs.build import build_device, build_skin
from skin.runs.configuration import validate_config
from skin.touch.movie import balanced

SIZE = (0.12, 0.08)
SHEET = Sheet(SIZE, [12, 8], [{"material": "EcoFlex 00-30", "thickness": 0.005}] * 2)
BODY = ("body.size=[0.12,0.08]", "body.cells=[12,8]")
GRID = ("layout=grid", "layout.rows=2", "layout.columns=3")
NAIVE = ("simulator=naive", *BODY, *GRID)
TOUCHES = 100


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """Return a function that places sensors and returns the folder; settings are those of Place."""

    def position(*overrides, **settings):
        folder = tmp_path_factory.mktemp("placed")
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = validate_config(compose("train", overrides=[*NAIVE, *overrides]))
        place = Place(**{"touches": TOUCHES} | settings)
        place.run(build_skin(config), partial(build_device, config), folder)
        return folder

    return position


def content(folder):
    return json.loads((folder / "placement.json").read_text())


def positions(folder):
    return File(folder / "placement.csv").sensors(SHEET).positions


@pytest.mark.parametrize("simulator", [("simulator=solid", "simulator.divisions=1"), ("simulator=fem",)])
def test_the_layout_is_read_by_the_next_command(run, tmp_path, simulator):
    """There, it has the information that was found for it."""
    words = (*simulator, *BODY, "design=place", f"design.touches={TOUCHES}")
    done = run(tmp_path, "design", *words, *GRID, "design.count=4", "out=first", store=False)
    assert "configured" in done.stdout
    assert "placement.csv" in done.stdout
    found = content(tmp_path / "first")
    with Image.open(tmp_path / "first" / "placement.png") as picture:
        assert picture.size[0] > picture.size[1]
    placed = ("layout=file", "layout.path=first/placement.csv")
    run(tmp_path, "design", *words, *placed, "out=second", store=False)
    configured = content(tmp_path / "second")["layouts"]["configured"]
    assert configured.pop("information_nats") == pytest.approx(found["information_nats"], rel=1e-3)
    assert configured == {"sensors": 4}
    second = content(tmp_path / "second")
    assert second["information_nats"] >= second["layouts"]["configured"]["information_nats"] - 1e-3


def test_tells_more_than_other_layouts(placed):
    folder = placed()
    found = content(folder)
    layouts = found["layouts"]
    assert set(layouts) == {"configured", "grid"}
    assert all(one["sensors"] == found["sensors"] == 6 for one in layouts.values())
    assert found["information_nats"] > max(one["information_nats"] for one in layouts.values())
    assert layouts["grid"] == pytest.approx(layouts["configured"])
    assert (found["noise_N"], found["clip_N"], found["touches"]) == (0.05, 10.0, TOUCHES)


def test_sensors_are_apart_in_reading_order_and_the_same_again(placed):
    folder = placed(distance=0.03)
    found = positions(folder)
    apart = np.linalg.norm(found[:, None, :2] - found[None, :, :2], axis=-1)
    assert apart[np.triu_indices(6, 1)].min() >= 0.03 - 1e-6
    assert np.lexsort((found[:, 0], found[:, 1])).tolist() == list(range(6))
    again = placed(distance=0.03)
    assert (again / "placement.csv").read_bytes() == (folder / "placement.csv").read_bytes()


def test_sensors_that_stay_come_first(placed):
    old = np.array([[0.1, 0.02], [0.02, 0.06]])
    found = positions(placed(keep=[4, 3], count=5))
    assert found[:2, :2] == pytest.approx(old, abs=1e-6)
    assert np.linalg.norm(found[2:, None, :2] - old, axis=-1).min() >= 0.012 - 1e-6
    every = positions(placed(keep="all", count=8))
    assert len(every) == 8
    assert every[0, :2] == pytest.approx([0.02, 0.02], abs=1e-6)


def test_no_new_sensor_is_in_a_zone(placed):
    found = positions(placed(keep_out=[[(0, 0), (0.06, 0), (0.06, 0.08), (0, 0.08)]]))
    assert found[:, 0].min() >= 0.065 - 1e-6


def test_normals_of_sensors_that_stay_are_written(placed):
    folder = placed("simulator=solid", "simulator.divisions=1", "layout.tilt=0.3", keep=[1], count=3)
    normals = File(folder / "placement.csv").sensors(SHEET).normals
    assert normals[0] == pytest.approx([np.sin(0.3), 0, np.cos(0.3)], abs=1e-5)
    assert normals[1:] == pytest.approx(np.tile([0.0, 0.0, 1.0], (2, 1)))


def test_more_noise_is_less_information(placed):
    quiet, loud = content(placed(noise=0.02)), content(placed("device.noise=0.2"))
    assert quiet["information_nats"] > 1.3 * loud["information_nats"]
    assert loud["noise_N"] == 0.2


@pytest.mark.parametrize(
    ("overrides", "settings", "reason"),
    [
        ((), {"count": 500}, "needs 500 sites, and there are 96: lower design.count"),
        ((), {"count": 40, "distance": 0.03}, "of 40 sensors fit"),
        ((), {"keep": [7]}, "design.keep names sensor 7, but the layout has 6"),
        ((), {"keep": "all"}, "design.keep keeps 6 sensors, and design.count=6 leaves none to place"),
        ((), {"keep": [1, 2, 3], "count": 2}, "set design.count=4 or more"),
        (("device.noise=0",), {}, "got device.noise=0: set design.noise=0.05"),
        ((), {"noise": 0.0}, "design.noise=0.0 must be greater than 0"),
        (("device=serial", "device.port=x"), {}, "sensors are placed by simulated touches"),
    ],
)
def test_bad_input_is_a_sentence(placed, overrides, settings, reason):
    with pytest.raises(InputError) as error:
        placed(*overrides, **settings)
    assert reason in str(error.value)


TWELVE = (
    "body.cells=[12,12]",
    "layout=grid",
    "layout.rows=3",
    "layout.columns=3",
    "touch.over_sensors=false",
)
SIMULATORS = [("naive", ()), ("solid", ("simulator.divisions=1",)), ("fem", ())]


def covariance(device, sensors=None, touches=40, seed=0, clip=10.0):
    return reading_covariance(device, sensors or device.sensors, touches, seed, clip)


@pytest.mark.parametrize(("simulator", "settings"), SIMULATORS)
def test_is_that_of_clipped_readings_during_contact(configured, simulator, settings):
    device = build_device(configured(f"simulator={simulator}", *TWELVE, *settings))
    found, frames = covariance(device, clip=0.5)
    labels = balanced(40, generator(Stream.PLACEMENT, 0, 0))
    movie = device.sampler.sample(40, generator(Stream.PLACEMENT, 0, 1), labels)
    readings = device.model.respond(movie).readings[movie.scale > 0]
    assert readings.abs().max() > 0.5
    expected = np.cov(readings.clamp(-0.5, 0.5).double().numpy().T, bias=True)
    assert frames == len(readings) == int((movie.scale > 0).sum())
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-5 * np.abs(expected).max())


def test_of_other_sensors_needs_no_simulator_of_them(configured):
    """Solving for each sensor gives the same."""
    device = build_device(configured("simulator=solid", *TWELVE, "simulator.divisions=1"))
    sensors = Sensors(np.array([[0.05, 0.03, 0.005], [0.071, 0.11, 0.005]]), (0.01, 0.01))
    found, _ = covariance(device, sensors)
    other = build_device(configured("simulator=solid", *TWELVE, "simulator.divisions=1"))
    other.model.pressure_rows = lambda _: None
    expected, _ = covariance(other, sensors)
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-5 * np.abs(expected).max())


def test_friction_is_part_of_readings(configured):
    device = build_device(configured("simulator=solid", *TWELVE, "simulator.divisions=1", "touch.shear=0.5"))
    tilted = Sensors(np.array([[0.05, 0.03, 0.005]]), (0.01, 0.01), np.array([[0.6, 0.0, 0.8]]))
    sheared, _ = covariance(device, tilted)
    without = build_device(configured("simulator=solid", *TWELVE, "simulator.divisions=1"))
    plain, _ = covariance(without, tilted)
    assert sheared[0, 0] > 1.02 * plain[0, 0]


def test_depends_on_the_seed_and_on_nothing_else(configured):
    device = build_device(configured("simulator=naive", *TWELVE))
    first, _ = covariance(device)
    torch.manual_seed(3)
    again, _ = covariance(device.replace(seed=5, data_seed=7))
    assert np.array_equal(first, again)
    assert not np.allclose(first, covariance(device, seed=1)[0])
