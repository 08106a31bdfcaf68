"""What is said of moving sensors follows from figures that can be worked out otherwise."""

from functools import partial

import numpy as np
import pytest
import torch

from experiments.studies.motion import Change, _changes, motion_change
from skin.body.sheet import Sheet
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.layout.grid import Grid
from skin.simulator.fem import PlatesAndBeams

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


@pytest.fixture(scope="module")
def device():
    body = Sheet([0.16, 0.16], [16, 16], LAYERS)
    return Simulated(
        body=body,
        layout=Grid(3, 3),
        simulator=partial(PlatesAndBeams, constraint="free"),
        gestures=20,
        test_gestures=20,
    )


def test_change_of_distance_by_hand():
    """3 and 4 along x and y are 5 apart; one sensor goes 1 further in the second of three frames."""
    places = torch.tensor([[0.0, 0, 0], [3, 4, 0]])
    motion = torch.zeros(1, 3, 2, 3)
    motion[0, 1, 1] = torch.tensor([0.6, 0.8, 0])
    motion[0, 2] = 1.0  # all sensors alike: distances stay
    changes = torch.cat(list(_changes(places, motion, torch.tensor([[0, 1]]))))
    torch.testing.assert_close(changes, torch.tensor([0.2, 0.0]))


def test_a_skin_is_measured_over_all_its_gestures(device):
    """Independent answer: every pair of the 3 x 3 grid by itself, in numpy."""
    found = motion_change(device, 40, neighbourhood=8)
    touches = device.replace(track="oracle", test_gestures=40).touches("test")
    rest, motion = touches.positions.double().numpy(), touches.motion.double().numpy()
    largest = 0.0
    for i in range(9):
        for j in range(i):
            now = np.linalg.norm(rest[i] + motion[:, :, i] - rest[j] - motion[:, :, j], axis=-1)
            largest = max(largest, np.abs(now / np.linalg.norm(rest[i] - rest[j]) - 1).max())
    assert found.largest == pytest.approx(largest, rel=1e-2)
    assert 0 < found.quantile < found.largest
    assert found.furthest == pytest.approx(np.abs(motion).max(axis=(0, 1, 2)), rel=1e-5)
    assert all(0.5 < share < 1 for share in found.explained)


@pytest.mark.parametrize(
    ("largest", "says"), [(0.0099, "no effect possible"), (0.011, "an effect is possible")]
)
def test_below_one_per_cent_nothing_is_to_be_had(largest, says):
    assert says in Change(largest, 0.001, (0, 0, 0), (1, 1, 1)).sentence


def test_a_single_sensor_has_no_neighbour(device):
    with pytest.raises(InputError, match="add sensors"):
        motion_change(device.replace(layout=Grid(1, 1)), 20)


def test_the_motion_is_told_in_millimetres():
    told = Change(0.02, 0.01, (1e-3, 2e-3, 3e-3), (0.9, 0.8, 0.7)).motion
    assert "1.00 mm along x, 2.00 mm along y and 3.00 mm into the skin" in told
    assert "explains 90%, 80%, 70% of" in told
