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
    force = movie.pressure().sum((2, 3)) * width * height
    torch.testing.assert_close(force, movie.force, rtol=1e-3, atol=1e-3)
    assert (movie.frames >= 0).all()


@pytest.mark.parametrize("simulator", ["naive", "fem"])
def test_rigid_objects_need_a_surface_that_gives_way(configured, simulator):
    match = f"simulator={simulator}: set simulator=solid, or contact=prescribed"
    with pytest.raises(InputError, match=match):
        build_device(configured("contact=rigid", f"simulator={simulator}"))
