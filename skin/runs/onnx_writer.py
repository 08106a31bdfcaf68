"""Write a network as an ONNX file and compare the file with the network.

Importing it needs onnx, onnxscript and onnxruntime."""

import logging
import warnings
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import onnx
import onnx_ir
import torch
from onnxscript import opset20
from torch import nn
from tqdm import tqdm

from skin.core import files
from skin.core.safe_loading import BLANK, seal
from skin.core.safe_loading import KEY as CHECKSUM
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.features import SINGULAR_VALUES
from skin.runs.model import KEY, ModelMetadata, OnnxModel

TOLERANCE = 1e-5
"""Largest difference of a probability from that of torch, unless rounding makes a larger one in torch."""


def write_model(module: nn.Module, metadata: ModelMetadata, touches: Touches, path: Path) -> float:
    """Write a module with its description to an ONNX file.

    Args:
        module: (B, T, S) readings and valid to (B, L) probabilities.
        metadata: its description.
        touches: on which the file is compared with the module.
        path: of the file.

    Returns:
        The largest difference of a probability.

    Raises:
        InputError: ONNX cannot express the module, the file differs from it, or it cannot be written.
    """
    whole, readings, valid = _convert(module, touches), touches.readings, touches.valid
    whole.metadata_props.update({CHECKSUM: BLANK, KEY: metadata.text()})
    with files.whole(path, "out=FILE.onnx") as partial, torch.inference_mode():
        onnx_ir.save(whole, partial)
        seal(partial)
        expected = module(readings, valid)
        written = torch.from_numpy(OnnxModel(partial).probabilities(readings.numpy(), valid.numpy()))
        difference = float((written - expected).abs().max())
        # What is rounded in torch may differ as much from the numbers in double precision.
        if not difference <= TOLERANCE:
            exact = deepcopy(module).double()(readings.double(), valid)
            if not difference <= 2 * float((exact - expected).abs().max()):
                raise InputError(
                    f"the ONNX file would differ from the network by {difference:.2g}, more than "
                    f"{TOLERANCE:g}: it was not written; export another run"
                )
    return difference


def _convert(module: nn.Module, touches: Touches) -> Any:
    """Return the ONNX model of a module, for batches of any size."""
    # Batches of one touch would be taken for the only size.
    example = touches.readings.new_zeros(3, *touches.readings.shape[1:])
    module(example, example == 0)  # its own errors are clearer than those of the exporter
    batch = {0: torch.export.Dim("batch")}
    # The exporter tells of libraries that are not needed, and would start a thread of tqdm.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    tqdm.monitor_interval = 0
    try:
        with warnings.catch_warnings(action="ignore"):
            program = torch.onnx.export(
                module,
                (example, example == 0),
                dynamo=True,
                input_names=["readings", "valid"],
                output_names=["probabilities"],
                dynamic_shapes=(batch, batch),
                opset_version=20,  # that of the translations below
                custom_translation_table=TRANSLATIONS,
                verbose=False,
            )
    except torch.onnx.OnnxExporterError as error:
        reason = (str(error.__cause__ or error).strip().splitlines() or [""])[0]
        raise InputError(f"ONNX cannot express this network: {reason}; export another run") from error
    assert program is not None
    for node in program.model.graph:
        for value in node.outputs:
            if not value.is_graph_output():
                value.shape = None  # torch expects other shapes of the unused outputs of translations
    return program.model


# Translations of the torch operators of the representations that ONNX lacks.

op: Any = opset20  # its types leave out Python numbers, which it converts
_DOUBLE, _FLOAT, _INT64 = 11, 1, 7  # TensorProto.DataType
_SQUARINGS = 3, 6  # rounds, and squarings in each: the power 2^18
_TINY = 1e-300
_ONE = onnx.helper.make_tensor("one", _FLOAT, [1], [1.0])


def nanmedian(x: Any, dim: int, keepdim: bool = False) -> tuple[Any, Any]:
    """Translate ``aten.nanmedian.dim``: the lower median of the numbers in rows of x (B, N).

    Returns:
        The medians (B,), NaN in rows without a number, and no useful indices.
    """
    missing = op.IsNaN(x)
    filled = op.Where(missing, op.Constant(value_float=float("inf")), x)
    count = op.ReduceSum(op.Cast(op.Not(missing), to=_INT64), [dim], keepdims=1)
    length = op.Gather(op.Shape(x), [dim])
    rising, order = op.TopK(filled, length, axis=dim, largest=0)
    middle = op.Max(op.Div(op.Sub(count, 1), 2), 0)
    median = op.GatherElements(rising, middle, axis=dim)
    median = op.Where(op.Greater(count, 0), median, op.Constant(value_float=float("nan")))
    return (median, order) if keepdim else (op.Squeeze(median, [dim]), order)


def cummax(x: Any, dim: int) -> tuple[Any, Any]:
    """Translate ``aten.cummax`` of counts x (B, T, K), from 0 up, along T.

    Returns:
        The largest value so far (B, T, K), and no useful indices.
    """
    until = op.Trilu(op.ConstantOfShape([x.shape[1], x.shape[1]], value=_ONE), upper=0)
    earlier = op.Mul(op.Unsqueeze(x, [1]), op.CastLike(op.Unsqueeze(until, [0, 3]), x))
    return op.ReduceMax(earlier, [2], keepdims=0), op.Cast(x, to=_INT64)


def eigenvalues(x: Any, uplo: str = "L", compute_v: bool = False) -> tuple[Any, Any]:
    """Translate ``aten._linalg_eigh`` of symmetric matrices x (B, 2, 2), without eigenvectors.

    Returns:
        The eigenvalues (B, 2), rising, and no useful eigenvectors.
    """
    rows = op.Split(op.Reshape(op.Cast(x, to=_DOUBLE), [-1, 4]), num_outputs=4, axis=1)
    first, mixed, _, last = rows
    half = op.Mul(op.Sub(first, last), _double(0.5))
    radius = op.Sqrt(op.Add(op.Mul(half, half), op.Mul(mixed, mixed)))
    large = op.Add(op.Mul(op.Add(first, last), _double(0.5)), radius)
    # The difference of mean and radius would lose the digits of a small eigenvalue.
    determinant = op.Sub(op.Mul(first, last), op.Mul(mixed, mixed))
    small = op.Div(determinant, op.Max(large, _double(_TINY)))
    return op.CastLike(op.Concat(small, large, axis=1), x), op.Identity(x)


def singular_values(
    x: Any, full_matrices: bool = False, compute_uv: bool = True, driver: str | None = None
) -> tuple[Any, Any, Any]:
    """Translate ``aten._linalg_svd`` of matrices x (B, M, N), without singular vectors.

    The values are roots of the eigenvalues of the smaller Gram matrix. A high power of it, by repeated
    squaring, leaves the largest eigenvalue only, which is then removed. Where two are so close that the power
    mixes them, the error is below 1e-6 of the value.

    Returns:
        No useful vectors; the singular values, falling, 0 after the first ``SINGULAR_VALUES``; no useful
        vectors.
    """
    whole = op.Cast(x, to=_DOUBLE)
    turned = op.Transpose(whole, perm=[0, 2, 1])
    rows, columns = x.shape[1], x.shape[2]
    gram = op.MatMul(turned, whole) if columns <= rows else op.MatMul(whole, turned)
    identity = op.CastLike(op.EyeLike(op.ConstantOfShape([min(rows, columns)] * 2)), gram)
    values = []
    for _ in range(min(SINGULAR_VALUES, rows, columns)):
        value, gram = _largest_eigenvalue(gram, identity)
        values.append(value)
    largest = op.Sqrt(op.Max(op.Concat(*values, axis=1), _double(0.0)))
    others = min(rows, columns) - len(values)
    values = op.Pad(op.Cast(largest, to=_FLOAT), [0, 0, 0, others])
    # Not x itself, to which the exporter would give the shape of the output.
    return op.Identity(x), values, op.Identity(x)


def _largest_eigenvalue(matrix: Any, identity: Any) -> tuple[Any, Any]:
    """Return the largest eigenvalue (B, 1) of symmetric matrices (B, N, N), and them without it."""
    power = matrix
    for _ in range(_SQUARINGS[0]):
        # Between two scalings the power neither vanishes nor overflows.
        power = op.Div(power, _positive(op.ReduceL2(power, [1, 2], keepdims=1)))
        for _ in range(_SQUARINGS[1]):
            power = op.MatMul(power, power)
    diagonal = op.ReduceSum(op.Mul(power, identity), [2], keepdims=0)
    row = op.GatherND(power, op.ArgMax(diagonal, axis=1, keepdims=1), batch_dims=1)
    vector = op.Unsqueeze(op.Div(row, _positive(op.ReduceL2(row, [1], keepdims=1))), [2])
    across = op.Transpose(vector, perm=[0, 2, 1])
    image = op.MatMul(matrix, vector)
    value = op.MatMul(across, image)
    # (I - v v^T) M (I - v v^T)
    mixed = op.Sub(image, op.Mul(op.Mul(value, _double(0.5)), vector))
    outer = op.MatMul(mixed, across)
    deflated = op.Sub(op.Sub(matrix, outer), op.Transpose(outer, perm=[0, 2, 1]))
    return op.Squeeze(value, [2]), deflated


def _positive(x: Any) -> Any:
    return op.Max(x, _double(_TINY))


def _double(value: float) -> Any:
    return op.Constant(value=onnx.helper.make_tensor("value", _DOUBLE, [], [value]))


TRANSLATIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    torch.ops.aten.nanmedian.dim: nanmedian,
    torch.ops.aten.cummax.default: cummax,
    torch.ops.aten._linalg_eigh.default: eigenvalues,
    torch.ops.aten._linalg_svd.default: singular_values,
}
"""Operator -> its translation, for ``torch.onnx.export``."""
