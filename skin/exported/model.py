"""An exported network, run by ONNX Runtime. torch is not imported."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from skin.errors import InputError
from skin.exported.metadata import ModelMetadata

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


class ExportedModel:
    """A network that ``skin export`` wrote.

    Args:
        path: of the file.

    Attributes:
        metadata: its description.

    Raises:
        InputError: ONNX Runtime is missing, or the file cannot be used.
    """

    def __init__(self, path: str | Path) -> None:
        self._session = _open(Path(path).expanduser())
        self.metadata = ModelMetadata.parse(self._session.get_modelmeta().custom_metadata_map, str(path))
        shape = [self.metadata.window, len(self.metadata.positions)]
        inputs = {given.name: given.shape[1:] for given in self._session.get_inputs()}
        if inputs != {"readings": shape, "valid": shape}:
            raise InputError(
                f"{path} has inputs {inputs}, not readings and valid of {shape}: export it again"
            )

    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), float32.

        Args:
            readings: (B, T, S), float32, N.
            valid: (B, T, S), bool.
        """
        return self._session.run(["probabilities"], {"readings": readings, "valid": valid})[0]  # type: ignore[return-value]


def _open(path: Path) -> "InferenceSession":
    """Return a session on one thread: a window alone is too small to be shared among threads."""
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise InputError(
            "an ONNX model needs ONNX Runtime: pip install onnxruntime, or 'tactile-skin[export]'"
        ) from error
    if not path.is_file():
        raise InputError(f"there is no file {path}: skin export run=latest out={path} writes one")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no other base
        raise InputError(f"{path} is no model that ONNX Runtime can load: export it again") from error
