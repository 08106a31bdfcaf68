"""What every contact does, whichever it is, from the command line on."""

import numpy as np
import pytest
import torch

from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.build import build_device

OPTIONS = sorted(path.stem for path in (CONF / "contact").glob("*.yaml"))
SMALL = ("body.cells=[12,12]", "layout=grid", "data.gestures=16", "device.test_gestures=16")
SOLID = ("simulator=solid", "simulator.divisions=1")


@pytest.fixture(scope="module", params=OPTIONS)
def device(request, configured):
    return build_device(configured(f"contact={request.param}", *SOLID, *SMALL))


def test_touches_are_made_of_pressures_that_carry_their_force(device):
    movie = device.sampler.sample(16, np.random.default_rng(0))
    width, height = device.body.cell
    torch.testing.assert_close(
        movie.pressure().sum((2, 3)) * width * height, movie.force, rtol=1e-3, atol=1e-3
    )
    assert (movie.frames >= 0).all()


def test_a_device_draws_the_same_touches_again(device):
    first, second = (device.replace().recording("test") for _ in range(2))
    assert torch.equal(first.touches.readings, second.touches.readings)
    assert torch.equal(first.touches.labels, second.touches.labels)


@pytest.mark.parametrize("simulator", ["naive", "fem"])
def test_rigid_objects_need_a_surface_that_gives_way(configured, simulator):
    with pytest.raises(
        InputError, match=f"simulator={simulator}: set simulator=solid, or contact=prescribed"
    ):
        build_device(configured("contact=rigid", f"simulator={simulator}"))


def test_the_command_line_says_so_too(run, tmp_path):
    done = run(tmp_path, "train.py", "simulator=naive", "contact=rigid")
    assert done.returncode == 2
    assert "set simulator=solid" in done.stderr
    assert "Traceback" not in done.stderr


def test_rigid_gestures_are_generated(run, tmp_path):
    out = tmp_path / "touches.parquet"
    rigid = [*SOLID, "contact=rigid", "n=16", *SMALL[:2]]
    done = run(tmp_path, "generate.py", *rigid, f"out={out}", store=False)
    assert done.returncode == 0, done.stderr
    assert "0 frames not solved" in done.stdout
    assert out.is_file()
