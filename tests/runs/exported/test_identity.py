"""An exported network refuses overrides that contradict its skin."""

import json
import re
from dataclasses import replace

import pytest
from hydra import initialize_config_dir

from skin.core.files import CONF
from skin.core.safe_loading import KEY as CHECKSUM
from skin.errors import InputError
from skin.runs.configuration import settings_of
from skin.runs.model import check_overrides, describe_skin

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
SIZES = ["layout=grid", "layout.rows=2", "layout.columns=3"]


@pytest.fixture(scope="module")
def model(untrained, configured, tmp_path_factory):
    """Return the file of a network with the description of its skin."""
    from skin.runs.onnx_writer import write_model

    of = untrained("representation=readings", "model=mlp", "fusion=early")
    skin = describe_skin(settings_of(configured("simulator=naive", *SIZES)), of.positions)
    path = tmp_path_factory.mktemp("identity") / "skin.onnx"
    module = of.learner.pipeline(of.sites)
    metadata = replace(of.describe(), skin=skin)
    write_model(module, metadata, of.device.touches("train")[:20], path)
    return path


def check(path, *overrides):
    given = [f"run={path}", *overrides]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        check_overrides(str(path), given)


CONTRADICTING = [
    "layout=file", "layout=grid", "layout.footprint=[0.02,0.02]", "body.size=[0.2,0.16]", "body=arm",
    "touch.rate=50", "touch.rate=-1", "touch.window=2", "evaluation.profile=nosuch", "simulator=solid",
]  # fmt: skip
INEFFECTIVE = ["seed=3", "model=mlp", "data.gestures=7", "profile=mild", "experiment=gru"]


@pytest.mark.parametrize("override", [*CONTRADICTING, *INEFFECTIVE])
def test_an_override_that_contradicts_the_skin_or_has_no_effect_is_refused(model, override):
    refused = "contradicts" if override in CONTRADICTING else "has no effect on"
    with pytest.raises(InputError, match=f"^{re.escape(override)} {refused} {model}"):
        check(model, override)


@pytest.mark.parametrize(
    "overrides",
    [
        [], SIZES, ["body=sheet"], ["touch.rate=10", "touch.window=3.0"], ["body.size=[0.16,0.16]"],
        ["simulator=naive"],
        ["device=serial", "device.port=x", "live.touch=0.5", "web=true", "seconds=3", "tracking.threads=1"],
    ],
)  # fmt: skip
def test_what_agrees_or_belongs_to_the_command_is_accepted(model, overrides):
    check(model, *overrides)


def test_the_same_positions_are_accepted_from_a_file(model, tmp_path, untrained):
    positions = untrained("representation=readings", "model=mlp", "fusion=early").positions
    lines = [",".join(f"{value:.9f}" for value in position) for position in positions.tolist()]
    path = tmp_path / "six.csv"
    path.write_text("\n".join(["x_m,y_m,depth_m", *lines]))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        words = ["layout=file", f"layout.path={path}"]
        check_overrides(str(model), words)
        path.write_text("\n".join(["x_m,y_m,depth_m", *lines[::-1]]))
        with pytest.raises(InputError, match="contradicts"):
            check_overrides(str(model), words)


def test_a_file_of_an_earlier_version_accepts_no_description(exported):
    check(exported[1], "live.touch=0.5")
    with pytest.raises(InputError, match="does not describe its skin"):
        check(exported[1], "touch.rate=10")


def test_a_file_may_not_name_code(model, tmp_path):
    whole = onnx.load(model)
    entry = next(entry for entry in whole.metadata_props if entry.key == "tactile_skin")
    known = json.loads(entry.value)
    known["skin"]["layout"]["_target_"] = "os.system"
    entry.value = json.dumps(known)
    # As an older version wrote it, or somebody who knows the checksum.
    kept = [entry for entry in whole.metadata_props if entry.key != CHECKSUM]
    del whole.metadata_props[:]
    whole.metadata_props.extend(kept)
    onnx.save(whole, tmp_path / "evil.onnx")
    with pytest.raises(InputError, match="could run any code"):
        check(tmp_path / "evil.onnx", "layout.footprint=[0.01,0.01]")


def test_sensors_of_a_recording_are_not_described(configured):
    import numpy as np

    assert describe_skin(settings_of(configured(*SIZES)), np.zeros((4, 3))) is None
