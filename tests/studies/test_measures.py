"""Frozen test touches, the score of a predictor on them, and distances of sensors that move with a touch."""

import sys

import numpy as np
import pytest
import torch

from experiments.studies.measures import Frozen, Motion, Subject, distance_changes, frozen_hash
from skin.errors import InputError
from skin.runs.build import build_device

MODULE = """
import numpy as np

def safe(readings, positions):
    assert readings.shape == (64, 30, 25) and positions.shape == (25, 3)
    return np.zeros((len(readings), 4))

def wrong(readings, positions):
    return np.zeros((3, 4))
"""
WORDS = "simulator=naive", "data.gestures=10", "device.test_gestures=64", "device.dead=2"


@pytest.fixture
def subject(configured, tmp_path, monkeypatch):
    (tmp_path / "guesses.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("guesses", None)
    config = configured(*WORDS)
    device = build_device(config)
    known = frozen_hash(device.recording("test", complete=False), ["device.dead=2"])
    return Subject(config, condition="small", changes=["device.dead=2"]), known


def test_a_function_is_scored(subject):
    (row,) = Frozen("guesses:safe", subject[1])(subject[0]).to_dict("records")
    assert (row["set"], row["gestures"]) == ("small", 64)
    fractions = [row[f"{name}/accuracy"] for name in ("big", "dynamic", "press", "dangerous", "overall")]
    assert fractions == pytest.approx([50.0] * 5)


@pytest.mark.parametrize(
    ("predictor", "message"),
    [("guesses:wrong", "finite prob"), ("guesses:missing", "cannot be imported"), ("guesses:safe", "frozen")],
)
def test_what_cannot_be_scored_and_other_touches_are_refused(subject, predictor, message):
    known = "0" * 16 if predictor == "guesses:safe" else subject[1]
    with pytest.raises(InputError, match=message):
        Frozen(predictor, known)(subject[0])


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
