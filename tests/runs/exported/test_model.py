"""An exported network is for one skin, which its file describes; other and damaged files are refused."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.core import safe_loading as checksum
from skin.errors import InputError
from skin.runs.configuration import settings_of
from skin.runs.model import KEY, ModelMetadata, OnnxModel, check_overrides, describe_skin
from tests.damage import DAMAGED_FILES, damaged, mutated, opened

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

SIZES = ("simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=3")
ABOUT = ModelMetadata(
    "abc", "title", "1", ["a", "b"], "binary", None, False, 10.0, 3, [(0.0, 0.0, 0.0)] * 4, (0.1, 0.1),
    10.0, 0.5, 0.3, False, 3.0,
)  # fmt: skip
WINDOW = np.ones((1, 3, 4), np.float32), np.ones((1, 3, 4), bool)


def test_it_describes_itself(exported):
    of, path = exported
    about = OnnxModel(path).metadata
    assert about.task == of.device.task
    assert (about.rate, about.window, len(about.positions)) == (10.0, 30, 6)
    assert (about.run, about.contact, about.saturation) == ("none", 0.3, 10.0)
    entry = {one.key: one.value for one in onnx.load(path).metadata_props}[KEY]
    assert json.loads(entry)["schema"] == 1
    assert json.loads(entry)["sensors"] == 6


def test_positions_stay_where_a_process_gets_the_tensors_of_a_run(exported):
    of, _ = exported
    assert not np.shares_memory(of.positions, of.sites.numpy())
    before = of.positions.tolist()
    of.sites.share_memory_()  # as where the final threshold of a live view is chosen
    assert of.positions.tolist() == before


def changed(path, folder, change):
    model = onnx.load(path)
    (entry,) = [one for one in model.metadata_props if one.key == KEY]
    known = json.loads(entry.value)
    change(known)
    entry.value = json.dumps(known)
    onnx.save(model, folder / "changed.onnx")
    return folder / "changed.onnx"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda known: known.update(schema=2), "has schema 2, this version reads 1"),
        (lambda known: known.pop("schema"), "damaged description"),
        (lambda known: known.update(rate="fast"), "rate=fast"),
        (lambda known: known.update(labels=[]), "labels"),
        (lambda known: known.update(window=20), "not readings .float. and valid .bool. of"),
    ],
)
def test_a_wrong_description_is_refused(exported, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        OnnxModel(changed(exported[1], tmp_path, change))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"No such file .* skin export run=latest out="):
        OnnxModel(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(InputError, match=r"cannot read the model .*text.onnx"):
        OnnxModel(tmp_path / "text.onnx")
    os.mkfifo(tmp_path / "pipe.onnx")
    for path in (tmp_path / "pipe.onnx", Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError, match="it is not a regular file"):
            OnnxModel(path)
    with pytest.raises(InputError, match="was not written by skin export"):
        ModelMetadata.parse({}, "x.onnx")


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


def model(nodes="", constants="", domains=""):
    """Return a model of a sum of the readings, with further operators before it, and a seal to fill."""
    weights = ", ".join(f"{0.01 * number:.2f}" for number in range(24))
    made = onnx.parser.parse_model(
        f"""
        <ir_version: 10, opset_import: ["": 20{domains}]>
        graph (float[batch,3,4] readings, bool[batch,3,4] valid) => (float[batch,2] probabilities)
        <int64[2] flat = {{-1, 12}}, float[12,2] weights = {{{weights}}}{constants}> {{
            {nodes}
            rows = Reshape(readings, flat)
            sums = MatMul(rows, weights)
            probabilities = Sigmoid(sums)
        }}"""
    )
    onnx.helper.set_model_props(made, {checksum.KEY: checksum.BLANK, KEY: ABOUT.text()})
    return made


def write(made, path: Path) -> Path:
    path.write_bytes(made.SerializeToString())
    checksum.seal(path)
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(model(), tmp_path_factory.mktemp("onnx") / "skin.onnx")


@DAMAGED_FILES
@given(data=st.data())
def test_damage_never_passes_for_a_network(written, data):
    path = written.with_name("damaged.onnx")
    path.write_bytes(data.draw(damaged(written.read_bytes())))
    known = opened(lambda: OnnxModel(path))
    if known is not None:
        np.testing.assert_array_equal(known.probabilities(*WINDOW), OnnxModel(written).probabilities(*WINDOW))


@DAMAGED_FILES
@given(data=st.data())
def test_every_description_works_or_is_refused(written, data):
    text = json.dumps(data.draw(mutated(json.loads(ABOUT.text()))))
    opened(lambda: ModelMetadata.parse({KEY: text}, "skin.onnx"))


def huge(size):
    return model("huge = ConstantOfShape(size)", f", int64[1] size = {{{size}}}")


def outside():
    made = model()
    weights = made.graph.initializer[1]
    weights.ClearField("float_data")
    weights.data_location = onnx.TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="../../../../dev/zero")
    return made


@pytest.mark.parametrize(
    "made",
    [
        lambda: huge(1 << 33),
        lambda: huge(1 << 60),
        outside,
        lambda: model("x = mine.Foreign(readings)", domains=', "mine": 1'),
        lambda: model("x = Relu(missing)"),
    ],
)
def test_what_no_network_needs_is_refused(tmp_path, made):
    with pytest.raises(InputError, match="ONNX Runtime cannot load"):
        OnnxModel(write(made(), tmp_path / "skin.onnx"))


def test_outputs_that_are_no_probabilities_are_refused(tmp_path):
    made = model()
    made.graph.initializer[1].float_data[0] = float("nan")
    with pytest.raises(InputError, match="does not give probabilities"):
        OnnxModel(write(made, tmp_path / "skin.onnx"))


def test_a_description_of_an_earlier_version_has_no_limits_and_no_guarantees():
    stored = json.loads(ABOUT.text())
    text = json.dumps({name: value for name, value in stored.items() if name not in ("limits", "guarantees")})
    read = ModelMetadata.parse({KEY: text}, "skin.onnx")
    assert (read.limits, read.guarantees, read.run) == (None, None, ABOUT.run)
