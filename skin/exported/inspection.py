"""Check an ONNX file before ONNX Runtime, which trusts its files, runs it."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from skin.checksum import KEY as CHECKSUM
from skin.checksum import ChecksumError, check_content
from skin.errors import InputError
from skin.exported.metadata import KEY, ModelMetadata
from skin.safe_loading import read_file

if TYPE_CHECKING:
    from onnx import ModelProto

_NAMES = """
Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh AveragePool BatchNormalization Cast
CastLike Ceil Celu Clip Concat Constant ConstantOfShape Conv ConvTranspose Cos Cosh CumSum
DepthToSpace Div Dropout Einsum Elu Equal Erf Exp Expand EyeLike Flatten Floor GRU Gather
GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual GridSample
GroupNormalization HardSigmoid HardSwish Identity InstanceNormalization IsInf IsNaN LSTM
LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Mean Min Mish Mod
Mul Neg Not Or PRelu Pad Pow RNN Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp
ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize Round
ScatterElements ScatterND Selu Shape Sigmoid Sign Sin Sinh Size Slice Softmax Softplus Softsign
SpaceToDepth Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Tile TopK Transpose Trilu Unsqueeze
Where Xor
"""
OPERATORS = frozenset(_NAMES.split())
"""Operators that a file may use: each computes tensors from tensors, without loops, branches or chance."""

# Operator -> its inputs that determine the size of its output. They may not depend on readings, so that a
# window of zeros needs as much time and memory as any other.
_SIZES = {
    "ConstantOfShape": (0,),
    "Expand": (1,),
    "Pad": (1, 3),
    "Range": (0, 1, 2),
    "Reshape": (1,),
    "Resize": (1, 2, 3),
    "Slice": (1, 2, 3, 4),
    "Split": (1,),
    "Squeeze": (1,),
    "Tile": (1,),
    "TopK": (1,),
    "Unsqueeze": (1,),
}
_BYTES = 1 << 28  # of a file: ten times the largest network of this package
_NODES = 20_000  # ten times an ensemble of the largest ones
_FLOAT, _BOOL, _EXTERNAL = 1, 9, 1  # TensorProto.DataType, TensorProto.DataLocation


def inspect(path: Path) -> tuple[bytes, ModelMetadata]:
    """Return the content of an ONNX file and the description of its network.

    Raises:
        InputError: the file is none of ``skin export``, is damaged, or could do something else than to
            compute probabilities of readings.
    """
    try:
        from google.protobuf.message import DecodeError
        from onnx import ModelProto
    except ModuleNotFoundError as error:
        raise InputError(
            "an ONNX model needs onnx and onnxruntime: pip install onnx onnxruntime, or "
            "'tactile-skin[export]'"
        ) from error
    if not path.exists():
        raise InputError(f"there is no file {path}: skin export run=latest out={path} writes one")
    try:
        content = read_file(path, _BYTES)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the model {path}: {error}") from error
    try:
        model = ModelProto.FromString(content)
    except DecodeError as error:
        raise InputError(f"{path} is no model that ONNX Runtime can load: export it again") from error
    entries = {entry.key: entry.value for entry in model.metadata_props}
    metadata = ModelMetadata.parse(entries, str(path))
    _check_interface(model, metadata, path)
    try:
        check_content(content)
        _check(model, entries)
    except ValueError as error:
        wrong = "" if isinstance(error, ChecksumError) else "is no file of skin export: "
        raise InputError(f"{path}: {wrong}{error}: export it again") from error
    return content, metadata


def _check_interface(model: "ModelProto", metadata: ModelMetadata, path: Path) -> None:
    """Raise InputError unless inputs and outputs are those of ``docs/export.md``."""
    shape, types = [metadata.window, len(metadata.positions)], {"readings": _FLOAT, "valid": _BOOL}
    tensors = {value.name: value.type.tensor_type for value in model.graph.input}
    inputs = {name: [axis.dim_value for axis in tensor.shape.dim][1:] for name, tensor in tensors.items()}
    outputs = [value.name for value in model.graph.output]
    if inputs != dict.fromkeys(types, shape) or outputs != ["probabilities"]:
        raise InputError(
            f"{path} has inputs {inputs}, not readings and valid of {shape}, or other outputs than "
            "probabilities: export it again"
        )
    if types != {name: tensor.elem_type for name, tensor in tensors.items()}:
        raise InputError(f"{path} has inputs of other types than float and bool: export it again")


def _check(model: "ModelProto", entries: dict[str, str]) -> None:
    """Raise a ValueError where a file has what no network needs."""
    graph = model.graph
    if other := sorted(set(entries) - {KEY, CHECKSUM}):
        raise ValueError(f"it has the unknown entry {other[0]!r}")
    if len(graph.node) > _NODES:
        raise ValueError(f"it has {len(graph.node)} operators")
    if model.functions or graph.sparse_initializer or model.training_info:
        raise ValueError("it has functions, sparse tensors or a training")
    # Whose content would be another file, perhaps a device.
    if any(tensor.data_location == _EXTERNAL or tensor.external_data for tensor in _tensors(model)):
        raise ValueError("it refers to other files")
    known = {value.name for value in graph.input}
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            raise ValueError(f"it uses the operator {node.domain} {node.op_type}".replace("  ", " "))
        if any(attribute.HasField("g") or attribute.graphs for attribute in node.attribute):
            raise ValueError(f"{node.op_type} has a graph inside")
        _follow(node, known)


def _tensors(model: "ModelProto") -> Iterator:
    yield from model.graph.initializer
    for node in model.graph.node:
        for attribute in node.attribute:
            yield from (attribute.t, *attribute.tensors)


def _follow(node, known: set[str]) -> None:  # type: ignore[no-untyped-def]
    """Add the outputs of an operator to the names of tensors that depend on readings, if they do.

    Raises:
        ValueError: the size of its output depends on readings.
    """
    sizes = {node.input[place] for place in _SIZES.get(node.op_type, ()) if place < len(node.input)}
    if sizes & known:
        raise ValueError(f"the size of what {node.op_type} returns depends on readings")
    if node.op_type not in ("Shape", "Size") and known & set(node.input):
        known.update(node.output)
