"""Two gestures at the same time."""

import numpy as np
import pytest
import torch

from skin.body.layout import Scattered
from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.gestures import GestureSettings, TouchSampler
from skin.touch.movie import add_second

BODY = Sheet([0.16, 0.16], [16, 16], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
WEIGHTS = BODY.footprints(Scattered(4, 4, seed=0).sensors(BODY))


def sample(count=240, **settings):
    sampler = TouchSampler(BODY, WEIGHTS, Prescribed(), GestureSettings.of(settings))
    return sampler.sample(count, np.random.default_rng(3))


@pytest.fixture(scope="module")
def single():
    return sample()


@pytest.fixture(scope="module")
def paired(single):
    return add_second(single, 0.5, 0.02, np.random.default_rng(4))


def test_a_pair_is_the_sum_of_two_gestures_side_by_side(single, paired):
    rows = torch.nonzero(paired.parameters["contacts"] == 2)[:, 0]
    first, both = single.pressure()[rows].double(), paired.pressure()[rows].double()
    second = both - first
    assert (second > -1).all()  # Pa, of 1e5
    pressed = [(part > 0.02 * part.amax()).any(dim=1) for part in (first, second)]
    assert not (pressed[0] & pressed[1]).any()
    touched = [part.amax(dim=(2, 3)) > 100 for part in (first, second)]
    assert (touched[0] & touched[1]).any(dim=1).all()  # at the same time
    union = (touched[0] | touched[1]).int()
    onset, duration = (paired.parameters[name][rows].long() for name in ("onset", "duration"))
    assert torch.equal(union.argmax(dim=1), onset)
    assert torch.equal(union.sum(dim=1), duration)
    total = both.sum(dim=(2, 3)) * BODY.cell[0] * BODY.cell[1]
    torch.testing.assert_close(paired.force[rows].double(), total, rtol=1e-4, atol=1e-3)


def test_a_label_holds_if_it_holds_for_one_of_the_two(single, paired):
    """Big and dangerous are measured again; dynamic and press are those of the longer or the moving one."""
    assert torch.equal(paired.labels, single.labels)
    rows = paired.parameters["contacts"] == 2
    sensors = paired.pressure().flatten(2) @ torch.as_tensor(WEIGHTS.T).float()
    assert torch.equal(sensors.amax(dim=(1, 2)) > 90.5e3, single.labels[:, 3] == 1)
    for name, column, limit in (("area", 0, 0.3), ("frames", 2, 3), ("pressure", 3, 90.5e3)):
        assert torch.equal(paired.parameters[name][rows] > limit, single.labels[rows, column] == 1)


def test_what_does_not_add_up_is_refused():
    with pytest.raises(InputError, match=r"touch\.shear=0"):
        sample(second=0.5, shear=0.3)

    class Rigid(Prescribed):
        proportional = False

    with pytest.raises(InputError, match="contact=prescribed"):
        GestureSettings(second=0.5).sampler(BODY, WEIGHTS, Rigid(), True, None)
    with pytest.raises(InputError, match="limit of force together"):
        sample(second=0.5, limits={"force": {"limit": 65, "unit": "N", "source": "a table"}})
