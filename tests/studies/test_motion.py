"""The distances of sensors change with the touch, as positions that are moved by hand say."""

import numpy as np
import pytest
import torch

from experiments.studies.measures import Motion, Subject, distance_changes
from skin.errors import InputError

FREE = "simulator=fem", "simulator.constraint=free", "body.cells=[10,10]", "layout=grid", "layout.rows=2"


def measure(configured, *settings: str):
    return Motion(gestures=20)(Subject(configured(*settings)))


def test_changes_are_those_of_sensors_moved_by_hand():
    positions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.03, 0.0, 0.0]])
    motion = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.001, 0.0], [-0.003, 0.0, 0.0]]])
    changes = distance_changes(positions, motion, np.array([0, 0]), np.array([1, 2]))
    torch.testing.assert_close(changes, torch.tensor([[0.05, 0.1]]))


def test_what_cannot_move_is_refused(configured):
    with pytest.raises(InputError, match=r"simulator\.constraint=free"):
        measure(configured, "simulator=fem", *FREE[2:], "layout.columns=1")
    with pytest.raises(InputError, match="add sensors"):
        measure(configured, *FREE[:4], "layout.rows=1", "layout.columns=1")
