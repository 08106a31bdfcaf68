"""Files that are damaged, or that would do something else than to compute probabilities."""

import json
import os
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.core import safe_loading as checksum
from skin.errors import InputError
from skin.runs.model import KEY, ModelMetadata, OnnxModel
from tests.damage import DAMAGED_FILES, damaged, mutated, opened

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
TensorProto, helper = onnx.TensorProto, onnx.helper

ABOUT = ModelMetadata(
    "abc", "title", "1", ["a", "b"], "binary", None, False, 10.0, 3, [(0.0, 0.0, 0.0)] * 4, (0.1, 0.1),
    10.0, 0.5, 0.3, False, 3.0,
)  # fmt: skip
WINDOW = np.ones((1, 3, 4), np.float32), np.ones((1, 3, 4), bool)


def constant(name, values, kind=TensorProto.INT64):
    return helper.make_tensor(name, kind, [len(values)], values)


def model(*nodes, constants=(), about=None):
    """Return a model of the mean of the readings, with further operators before it, and a seal to fill."""
    graph = helper.make_graph(
        [
            *nodes,
            helper.make_node("Reshape", ["readings", "flat"], ["rows"]),
            helper.make_node("MatMul", ["rows", "weights"], ["sums"]),
            helper.make_node("Sigmoid", ["sums"], ["probabilities"]),
        ],
        "graph",
        [
            helper.make_tensor_value_info("readings", TensorProto.FLOAT, ["batch", 3, 4]),
            helper.make_tensor_value_info("valid", TensorProto.BOOL, ["batch", 3, 4]),
        ],
        [helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, ["batch", 2])],
        [
            constant("flat", [-1, 12]),
            helper.make_tensor(
                "weights", TensorProto.FLOAT, [12, 2], [0.01 * number for number in range(24)]
            ),
            *constants,
        ],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    text = ABOUT.text() if about is None else about
    helper.set_model_props(made, {checksum.KEY: checksum.BLANK, KEY: text})
    return made


def write(made, path: Path) -> Path:
    path.write_bytes(made.SerializeToString())
    checksum.seal(path)
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(model(), tmp_path_factory.mktemp("onnx") / "skin.onnx")


def test_a_sealed_file_is_used(written):
    assert OnnxModel(written).probabilities(*WINDOW).shape == (1, 2)


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


def loop(count):
    """Return a loop that does nothing ``count`` times."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["going"])],
        "body",
        [
            helper.make_tensor_value_info("round", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
        ],
        [helper.make_tensor_value_info("going", TensorProto.BOOL, [])],
    )
    return model(
        helper.make_node("Loop", ["count", "yes"], [], body=body),
        constants=[
            helper.make_tensor("count", TensorProto.INT64, [], [count]),
            helper.make_tensor("yes", TensorProto.BOOL, [], [True]),
        ],
    )


def doubled(times):
    """Return a tensor joined with itself again and again."""
    nodes = [helper.make_node("Identity", ["weights"], ["joined0"])]
    for number in range(times):
        before, after = f"joined{number}", f"joined{number + 1}"
        nodes.append(helper.make_node("Concat", [before, before], [after], axis=0))
    return model(*nodes, helper.make_node("ReduceMax", [f"joined{times}"], ["probability"]))


def huge(size):
    return model(
        helper.make_node("ConstantOfShape", ["size"], ["huge"]), constants=[constant("size", [size])]
    )


def outside():
    """Return a model with weights in another file."""
    made = model()
    (weights,) = [tensor for tensor in made.graph.initializer if tensor.name == "weights"]
    weights.ClearField("float_data")
    weights.data_location = TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="../../../../dev/zero")
    return made


def dependent():
    """Return a model whose need of memory depends on a reading."""
    return model(
        helper.make_node("ReduceMax", ["readings"], ["largest"], keepdims=0),
        helper.make_node("Cast", ["largest"], ["limit"], to=TensorProto.INT64),
        helper.make_node("Range", ["start", "limit", "step"], ["numbers"]),
        constants=[
            helper.make_tensor("start", TensorProto.INT64, [], [0]),
            helper.make_tensor("step", TensorProto.INT64, [], [1]),
        ],
    )


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (lambda: loop(1 << 60), "it uses the operator Loop"),
        (lambda: doubled(60), "ONNX Runtime cannot load"),
        (lambda: huge(1 << 33), "ONNX Runtime cannot load"),
        (lambda: huge(1 << 60), "ONNX Runtime cannot load"),
        (outside, "it refers to other files"),
        (dependent, "the size of what Range returns depends on readings"),
        (
            lambda: model(helper.make_node("Foreign", ["readings"], ["x"], domain="mine")),
            "operator mine Foreign",
        ),
        (lambda: model(helper.make_node("Relu", ["missing"], ["x"])), "ONNX Runtime cannot load"),
    ],
)
def test_a_hostile_file_is_refused_soon(tmp_path, made, reason):
    path, start = write(made(), tmp_path / "skin.onnx"), monotonic()
    with pytest.raises(InputError, match=reason):
        OnnxModel(path)
    assert monotonic() - start < 20


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.onnx")
    for path in (tmp_path / "pipe.onnx", Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError, match="it is not a regular file"):
            OnnxModel(path)


def test_outputs_that_are_no_probabilities_are_refused(tmp_path):
    made = model()
    (weights,) = [tensor for tensor in made.graph.initializer if tensor.name == "weights"]
    weights.float_data[0] = float("nan")
    with pytest.raises(InputError, match="does not give probabilities"):
        OnnxModel(write(made, tmp_path / "skin.onnx"))
