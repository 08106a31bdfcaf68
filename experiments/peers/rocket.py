"""Random convolution kernels of aeon and a ridge, in the environment of aeon."""

import json
import subprocess
import weakref
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Ge
from torch import Tensor

from experiments.peers import python
from skin.core.files import ROOT
from skin.core.safe_loading import load_npz
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.features import above_idle
from skin.learning.learner import AbstractLearner

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.data import TouchData

WORKER = "experiments.peers.worker"
_PART = 8192  # touches


class Rocket(AbstractLearner):
    """Convolution kernels on the series of readings, and a ridge per label.

    Fits and applies the model in a process of the other environment (``worker.py``), with files of arrays.
    The process starts when it is needed and ends with the learner.

    References: A. Dempster et al., MiniRocket, KDD 2021; C. W. Tan et al., MultiRocket, Data Mining and
    Knowledge Discovery 2022; A. Dempster et al., Hydra, ibid. 2023.

    Args:
        transform: the kernels; ``flat`` are the readings themselves.
        kernels: their number; None: aeon's default.
        channels: ``readings`` of each sensor; or ``sorted``: the readings above idle, from the largest to the
            smallest of each frame, and their sum, which allows any number of sensors.
        largest: number of sorted readings.
        seed: of the kernels.
    """

    def __init__(
        self,
        transform: Literal["flat", "minirocket", "multirocket", "multirocket_hydra"] = "minirocket",
        kernels: Annotated[int, Ge(84)] | None = None,
        channels: Literal["readings", "sorted"] = "readings",
        largest: Annotated[int, Ge(1)] = 10,
        seed: int = 0,
    ) -> None:
        self._model = {"seed": seed, "transform": transform, "kernels": kernels}
        self._channels, self._largest = channels, largest
        self._process: subprocess.Popen[str] | None = None
        self._shape: tuple[int, ...] = ()
        self._labels = 0

    def inputs(self, touches: Touches) -> Tensor:
        """Return the channels, (B, C, T), N."""
        if self._channels == "readings":
            return touches.readings.where(touches.valid, 0.0).mT
        x = above_idle(touches)
        highest = x.sort(dim=2, descending=True).values[..., : self._largest]
        highest = torch.nn.functional.pad(highest, (0, self._largest - highest.shape[2]))
        return torch.cat([highest, x.sum(dim=2, keepdim=True)], dim=2).mT

    def check(self, data: "TouchData") -> None:
        """Raise InputError if the environment or labels are not available."""
        _python()
        if data.task.kind != "binary" or data.task.gate or data.task.direction:
            raise InputError(
                "models of other libraries learn independent binary labels only: leave out data.stream=true "
                "and data.direction=true"
            )

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Fit to the training split; the validation split stops the training and calibrates it."""
        arrays: dict[str, np.ndarray] = {}
        for split in ("train", "validation"):
            touches = data.touches(split)
            arrays |= {split: self._array(touches), f"{split}_labels": touches.known_labels.numpy()}
        with TemporaryDirectory() as folder:
            path = Path(folder) / "touches.npz"
            np.savez(path, **arrays)  # type: ignore[arg-type]
            self.seconds_per_epoch = self._start("fit", path)

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L).

        Raises:
            InputError: the model is of another number of sensors or frames.
        """
        if not self._shape:
            raise RuntimeError("fit or load the learner first")
        inputs = self._array(touches)
        if inputs.shape[1:] != self._shape:
            raise InputError(
                f"this model takes inputs of the shape {self._shape}, got {inputs.shape[1:]}: give touches "
                "with as many sensors and frames as in its training"
            )
        with TemporaryDirectory() as folder:
            path, answer = Path(folder) / "inputs.npy", Path(folder) / "answer.npy"
            np.save(path, inputs)
            self._ask("predict", path, to=str(answer))
            return torch.from_numpy(np.load(answer, allow_pickle=False)).to(torch.float32)

    def save(self, folder: Path) -> Path:
        """Write the model to ``model.npz``, in which there are only numbers, and return its path."""
        path = Path(folder) / "model.npz"
        self._ask("save", path)
        return path

    def load(self, data: "TouchData", path: Path) -> None:
        """Load the model that :meth:`save` wrote."""
        self.check(data)
        load_npz(path)
        self._start("load", path)
        if self._labels != len(data.task):
            raise ValueError(f"it was trained on {self._labels} labels, not {', '.join(data.task.names)}")

    def _array(self, touches: Touches) -> np.ndarray:
        """Return all inputs, computed in parts to save memory."""
        local = touches.to("cpu")
        parts = [self.inputs(local[start : start + _PART]) for start in range(0, len(local), _PART)]
        return torch.cat(parts).to(torch.float32).numpy()

    def _start(self, do: str, path: Path) -> float:
        """Fit or load a model and return the duration, s."""
        answer = self._ask(do, path, model={**self._model, "jobs": torch.get_num_threads()})
        self._shape, self._labels = tuple(answer["shape"]), answer["labels"]
        self.parameters = answer["parameters"]
        return answer["seconds"]

    def _ask(self, do: str, path: Path, **request: Any) -> dict[str, Any]:
        """Send a request to the process and return its answer."""
        if self._process is None:
            self._process = subprocess.Popen(
                [_python(), "-m", WORKER], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            weakref.finalize(self, _end, self._process)
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            print(json.dumps({"do": do, "path": str(path), **request}), file=process.stdin, flush=True)
            answer = process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise InputError(f"the process of aeon ended with exit code {process.wait()}")
        result = json.loads(answer)
        if "error" in result:
            raise RuntimeError(result["error"])
        return result


def _python() -> str:
    """Return the Python of the other environment."""
    # It is no setting, because a stored run must not choose a program.
    path = python()
    if not path.is_file():
        raise InputError(f"there is no {path}: make peers builds it")
    return str(path)


def _end(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()
