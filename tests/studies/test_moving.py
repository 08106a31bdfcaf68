"""What is said of moving sensors follows from figures that can be worked out otherwise."""

from functools import partial

import numpy as np
import pytest
import torch

from skin.body.sheet import Sheet
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.layout.grid import Grid
from skin.simulator.fem import PlatesAndBeams
from studies.moving import Change, _changes, change
from studies.moving_runs import Trial, conditions
from studies.moving_table import comparison, publish
from studies.settings import MovingSettings

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]
GIVEN = {"rows": "all", "errors": [0.0], "variation": 0.2, "gestures": 9, "devices": 2, "train": False}


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
    found = change(device, 40, neighbourhood=8)
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
        change(device.replace(layout=Grid(1, 1)), 20)


def test_conditions_are_paired_by_seed(device):
    """Same gains, offsets and noise in all of them; only places, or moduli, differ."""
    plain, near, far, varied = conditions(device, [0.0, 0.002, 0.005], 0.2, seed=1, gestures=12)
    for other in (near, far, varied):
        assert torch.equal(other.constants.gain, plain.constants.gain)
        assert other.test_gestures == 12
    np.testing.assert_array_equal(plain.true_sensors.positions, device.sensors.positions)
    moved = [other.true_sensors.positions - device.sensors.positions for other in (near, far)]
    np.testing.assert_allclose(moved[1], 2.5 * moved[0], atol=1e-12)
    np.testing.assert_array_equal(varied.true_sensors.positions, device.sensors.positions)
    assert (varied.body.variation, varied.body.variation_seed) == (0.2, 2)
    assert plain.body.variation == 0


def test_differences_are_judged_over_paired_seeds():
    base = {"0": 80.0, "1": 70.0, "2": 60.0}
    trials = [
        Trial("a", "0 mm", base),
        Trial("a", "2 mm", {seed: value - 1 for seed, value in base.items()}),
        Trial("a", "5 mm", {"0": 81.0, "1": 68.0, "2": 60.5}),
        Trial("b", "0 mm", {"0": 50.0}),
        Trial("b", "2 mm", {"0": 10.0}),
    ]
    lines = comparison(trials)
    assert [line["verdict"] for line in lines] == ["", "worse", "undecided", "", "undecided"]
    assert lines[1]["difference"] == "-1.00 ± 0.00"
    assert lines[0]["accuracy"] == "70.0 ± 10.0"


def test_files_are_written_whole(tmp_path, capsys):
    moves = Change(0.02, 0.01, (1e-3, 2e-3, 3e-3), (0.9, 0.8, 0.7))
    publish(tmp_path, moves, 7, comparison([Trial("a", "0 mm", {"0": 80.0})]))
    text = (tmp_path / "moving.md").read_text()
    assert "Over 7 gestures neighbours' distances change by 2.00% at most" in text
    assert "1.00 mm along x, 2.00 mm along y and 3.00 mm into the skin" in text
    assert "| a | 0 mm | 80.0 |" in text
    assert (tmp_path / "moving.csv").read_text().splitlines()[1] == "a,0 mm,80.0,,1,"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["moving.csv", "moving.md"]


@pytest.mark.parametrize(("name", "value"), [("seeds", 2), ("errors", [-1]), ("devices", 0), ("gestures", 0)])
def test_settings_that_mean_nothing_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=rf"moving\.{name}"):
        MovingSettings(**(GIVEN | {"seeds": [0]} | {name: value}))
