"""A recording as a device: it must be of the sheet and the layout that the configuration names."""

import pytest
import torch

from skin.body.sheet import Sheet
from skin.device.recording import Recorded
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.layout.grid import Grid
from skin.layout.scattered import Scattered
from skin.recording_file import write_recording
from skin.simulator.naive import Naive

LAYER = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
BODY = Sheet([0.16, 0.16], [16, 16], LAYER)
LAYOUT = Scattered(5, 5, seed=0)


@pytest.fixture(scope="module")
def simulated():
    return Simulated(body=BODY, layout=LAYOUT, simulator=Naive, gestures=50).recording()


@pytest.fixture(scope="module", params=["parquet", "csv"])
def path(request, simulated, tmp_path_factory) -> str:
    return str(write_recording(simulated, tmp_path_factory.mktemp("files") / f"x.{request.param}"))


def test_yields_what_was_written(path, simulated):
    device = Recorded(BODY, LAYOUT, path)
    parts = [device.touches(split) for split in ("train", "validation", "test")]
    readings = torch.cat([part.readings for part in parts]).flatten(1)
    written = simulated.touches.readings.flatten(1)
    assert torch.equal(readings.unique(dim=0), written.unique(dim=0))
    assert (device.window, device.rate, device.task) == (30, 10.0, simulated.task)


def test_the_test_part_is_the_holdout(path):
    device = Recorded(BODY, LAYOUT, path)
    assert torch.equal(device.touches("test").readings, device.touches("holdout").readings)


def test_another_split_seed_is_another_split(path):
    one, other = (Recorded(BODY, LAYOUT, path, split_seed=seed).touches("test") for seed in (0, 1))
    assert not torch.equal(one.readings, other.readings)


@pytest.mark.parametrize(
    ("body", "layout", "message"),
    [
        (BODY, Grid(4, 4), r"has 25 sensors, the layout has 16"),
        (BODY, Scattered(5, 5, seed=1), r"has sensor \d+ at .*the layout at"),
        (Sheet([0.2, 0.16], [16, 16], LAYER), LAYOUT, r"add body.size=\[0.16,0.16\]"),
    ],
)
def test_another_skin_is_refused(path, body, layout, message):
    with pytest.raises(InputError, match=message):
        Recorded(body, layout, path)


def test_no_file_and_too_few_touches_are_refused(simulated, tmp_path):
    with pytest.raises(InputError, match=r"add device.path=x.parquet"):
        Recorded(BODY, LAYOUT)
    few = write_recording(simulated[:9], tmp_path / "few.parquet")
    with pytest.raises(InputError, match=r"has 9 touches: 80/10/10 needs at least 10"):
        Recorded(BODY, LAYOUT, str(few))
