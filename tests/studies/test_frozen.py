"""Frozen test touches, and the score of a predictor on them."""

import sys

import numpy as np
import pytest
from omegaconf import OmegaConf

from experiments.studies import frozen
from skin.core.files import CONF
from skin.errors import InputError

MODULE = """
import numpy as np

def safe(readings, positions):
    assert readings.shape == (64, 30, 25) and positions.shape == (25, 3)
    return np.zeros((len(readings), 4))

def wrong(readings, positions):
    return np.zeros((3, 4))
"""


@pytest.fixture
def described(tmp_path, monkeypatch):
    """A file with a small set whose hash is right, and a module of predictors."""
    (tmp_path / "guesses.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("guesses", None)
    about = {"common": ["simulator=naive", "data.gestures=10"], "gestures": 64}
    words = {"small": {"overrides": ["device.dead=2"]}}
    device = frozen.build_set("small", words["small"], about["common"], 64)
    words["small"]["hash"] = frozen.frozen_hash(device.recording("test", complete=False), words["small"])
    path = tmp_path / "sets.yaml"
    OmegaConf.save(OmegaConf.create(about | {"sets": words}), path)
    return path


def test_a_function_is_scored(described):
    (row,) = frozen.score(frozen.FrozenSettings(predictor="guesses:safe", file=str(described)))
    assert (row["set"], row["gestures"]) == ("small", 64)
    shares = [row[f"{name}/accuracy"] for name in ("big", "dynamic", "press", "dangerous", "overall")]
    assert shares == pytest.approx([50.0] * 5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"predictor": "guesses:wrong"}, "finite probabilities"),
        ({"predictor": "guesses:missing"}, "cannot be imported"),
        ({"predictor": "guesses:safe", "sets": "large"}, "none of small"),
    ],
)
def test_what_cannot_be_scored_is_refused(described, words, message):
    with pytest.raises(InputError, match=message):
        list(frozen.score(frozen.FrozenSettings(**words, file=str(described))))


def test_other_touches_than_the_frozen_ones_are_refused(described):
    described.write_text(described.read_text().replace("device.dead=2", "device.dead=3"))
    with pytest.raises(InputError, match="frozen"):
        list(frozen.score(frozen.FrozenSettings(predictor="guesses:safe", file=str(described))))


def test_the_published_sets_have_hashes():
    about = OmegaConf.load(CONF / "benchmark.yaml")
    assert all(len(entry.hash) == 16 for entry in about.sets.values())
    assert len({entry.hash for entry in about.sets.values()}) == len(about.sets)
    assert np.isin("100 Hz", list(about.sets))
