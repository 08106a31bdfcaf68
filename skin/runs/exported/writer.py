"""Write a network as an ONNX file and compare the file with the network."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from skin.core import files
from skin.core.safe_loading import BLANK, seal
from skin.core.safe_loading import KEY as CHECKSUM
from skin.device.touches import Touches
from skin.errors import InputError
from skin.runs.exported.model import KEY, ExportedModel, ModelMetadata

TOLERANCE = 1e-5
"""Largest difference of a probability from that of torch, unless rounding makes a larger one in torch."""

_OPSET = 20


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
    whole = _convert(module, touches)
    whole.metadata_props[CHECKSUM] = BLANK
    whole.metadata_props[KEY] = metadata.text()
    with files.whole(path, "out=FILE.onnx") as partial:
        import onnx_ir

        onnx_ir.save(whole, partial)
        seal(partial)
        difference = _difference(module, ExportedModel(partial), touches)
        if not difference <= TOLERANCE and not difference <= 2 * _rounding(module, touches):
            raise InputError(
                f"the ONNX file would differ from the network by {difference:.2g}, more than {TOLERANCE:g}: "
                "it was not written; export another run"
            )
    return difference


def _convert(module: nn.Module, touches: Touches) -> Any:
    """Return the ONNX model of a module, for batches of any size."""
    try:
        import onnxruntime  # noqa: F401

        from skin.runs.exported.operators import TRANSLATIONS
    except ModuleNotFoundError as error:
        raise InputError(
            "skin export needs onnx, onnxscript and onnxruntime: pip install 'tactile-skin[export]'"
        ) from error
    # Batches of one touch would be taken for the only size.
    example = touches.readings.new_zeros(3, *touches.readings.shape[1:])
    module(example, example == 0)  # its own errors are clearer than those of the exporter
    batch = {0: torch.export.Dim("batch")}
    with _quiet():
        try:
            program = torch.onnx.export(
                module,
                (example, example == 0),
                dynamo=True,
                input_names=["readings", "valid"],
                output_names=["probabilities"],
                dynamic_shapes=(batch, batch),
                opset_version=_OPSET,
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


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what the exporter says about libraries that are not needed, and start no thread of tqdm."""
    logger = logging.getLogger("torch.onnx")
    before, interval = logger.level, tqdm.monitor_interval
    logger.setLevel(logging.ERROR)
    tqdm.monitor_interval = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
        tqdm.monitor_interval = interval


def _difference(module: nn.Module, model: ExportedModel, touches: Touches) -> float:
    with torch.inference_mode():
        expected = module(touches.readings, touches.valid).numpy()
    computed = model.probabilities(touches.readings.numpy(), touches.valid.numpy())
    return float(np.abs(computed - expected).max())


def _rounding(module: nn.Module, touches: Touches) -> float:
    """Return the largest difference of a probability of the module from that in double precision."""
    with torch.inference_mode():
        single = module(touches.readings, touches.valid)
        double = deepcopy(module).double()(touches.readings.double(), touches.valid)
    return float((single - double).abs().max())
