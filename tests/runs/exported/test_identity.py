"""An exported network is for one skin, which its file describes."""

import re

import numpy as np
import pytest

from skin.errors import InputError
from skin.runs.configuration import settings_of
from skin.runs.model import check_overrides, describe_skin

SIZES = ("simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=3")


@pytest.mark.parametrize(
    "override",
    ["layout=file", "body.size=[0.2,0.16]", "touch.rate=50", "evaluation.profile=mild", "simulator=solid",
     "seed=3", "model=mlp", "data.gestures=7", "profile=mild", "experiment=gru"],
)  # fmt: skip
def test_what_the_file_fixes_is_refused(override):
    with pytest.raises(InputError, match=f"^{re.escape(override)} has no effect on skin.onnx, a network for"):
        check_overrides("skin.onnx", ["run=skin.onnx", override])


def test_what_belongs_to_the_command_is_accepted():
    words = ["device=serial", "device.port=x", "live.touch=0.5", "web=true", "seconds=3"]
    check_overrides("skin.onnx", ["run=skin.onnx", *words, "tracking.threads=1", "hydra.searchpath=[x]"])


def test_a_skin_is_described_unless_its_sensors_are_those_of_a_recording(untrained, configured):
    settings = settings_of(configured(*SIZES))
    of = untrained("representation=readings", "model=mlp", "fusion=early")
    described = describe_skin(settings, of.positions)
    assert described == {name: settings[name] for name in described}
    assert set(described) == {"body", "layout", "simulator", "touch", "evaluation"}
    assert describe_skin(settings, np.zeros((4, 3))) is None
