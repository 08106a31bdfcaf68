"""An exported network, run by ONNX Runtime. torch is not imported."""

from pathlib import Path
from threading import Thread
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from skin.errors import InputError
from skin.exported.inspection import inspect
from skin.safe_loading import limited_memory

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

_PATIENCE = 20.0  # s to load a file and to classify a window, which takes some ms
_MEMORY = 1 << 30  # bytes that it may take


class ExportedModel:
    """A network that ``skin export`` wrote.

    Args:
        path: of the file.

    Attributes:
        metadata: its description.

    Raises:
        InputError: ONNX or ONNX Runtime is missing, the file cannot be used or is damaged, or it takes more
            time or memory than a network needs.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path).expanduser()
        content, self.metadata = inspect(path)
        self._try(content, path)

    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), float32.

        Args:
            readings: (B, T, S), float32, N.
            valid: (B, T, S), bool.
        """
        return self._session.run(["probabilities"], {"readings": readings, "valid": valid})[0]  # type: ignore[return-value]

    def _try(self, content: bytes, path: Path) -> None:
        """Load a file and classify a window of zeros, as costly as any other, in bounded time and memory."""
        _runtime()  # imported before memory is limited
        shape = 1, self.metadata.window, len(self.metadata.positions)
        results: list[np.ndarray | BaseException] = []

        def classify() -> None:
            try:
                self._session = _open(content)
                results.append(self.probabilities(np.zeros(shape, np.float32), np.ones(shape, bool)))
            except BaseException as error:  # those of ONNX Runtime share no other base
                results.append(error)

        thread = Thread(target=classify, name="skin-trial", daemon=True)
        with limited_memory(_MEMORY):
            thread.start()
            thread.join(_PATIENCE)
        if not results:
            raise InputError(f"{path} needs more than {_PATIENCE:g} s for a window: export it again")
        (result,) = results
        if isinstance(result, InputError):
            raise result
        if isinstance(result, BaseException):
            raise InputError(f"{path} is no model that ONNX Runtime can load: export it again") from result
        labels = len(self.metadata.labels)
        if result.shape != (1, labels) or result.dtype != np.float32 or not np.isfinite(result).all():
            raise InputError(f"{path} does not give probabilities of its {labels} labels: export it again")


def _runtime() -> ModuleType:
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise InputError(
            "an ONNX model needs ONNX Runtime: pip install onnxruntime, or 'tactile-skin[export]'"
        ) from error
    return onnxruntime


def _open(content: bytes) -> "InferenceSession":
    """Return a session on one thread: a window alone is too small to be shared among threads."""
    runtime = _runtime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # its errors are reported by the caller
    return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
