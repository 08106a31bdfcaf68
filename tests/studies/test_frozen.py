"""Frozen test touches, and the score of a predictor on them."""

import sys

import pytest

from experiments.studies.measures import Frozen, Subject, frozen_hash
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
