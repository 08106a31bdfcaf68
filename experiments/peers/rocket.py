"""Random convolution kernels of aeon and a ridge, in the environment of aeon."""

import pickle
import subprocess
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from experiments.peers import python
from skin.core.files import ROOT
from skin.core.safe_loading import load_npz
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.learner import AbstractLearner

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.data import TouchData


class Rocket(AbstractLearner):
    """Convolution kernels on the series of readings, and a ridge per label.

    Fits and applies the model in a process of the other environment (``worker.py``), which starts when it is
    needed and ends with the learner.

    References: A. Dempster et al., MiniRocket, KDD 2021; C. W. Tan et al., MultiRocket, Data Mining and
    Knowledge Discovery 2022; A. Dempster et al., Hydra, ibid. 2023.

    Args:
        transform: the kernels; ``flat`` are the readings themselves.
        seed: of the kernels.
    """

    def __init__(
        self,
        transform: Literal["flat", "minirocket", "multirocket_hydra"] = "minirocket",
        seed: int = 0,
    ) -> None:
        self._seed, self._transform = seed, transform
        self._process: subprocess.Popen[bytes] | None = None
        self._shape: tuple[int, ...] = ()

    def inputs(self, touches: Touches) -> Tensor:
        """Return the readings of each sensor, (B, S, T), N; 0 where they are not valid."""
        return touches.readings.where(touches.valid, 0.0).mT

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
        arrays = list[np.ndarray]()
        for split in ("train", "validation"):
            touches = data.touches(split)  # type: ignore[arg-type]
            arrays += [self._array(touches), touches.known_labels.numpy()]
        self._begin()
        self.seconds_per_epoch = self._ask("fit", *arrays)
        self.parameters, self._shape, _ = self._ask("describe")

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
        return torch.from_numpy(self._ask("predict", inputs)).to(torch.float32)

    def save(self, folder: Path) -> Path:
        """Write the model to ``model.npz``, in which there are only numbers, and return its path."""
        path = Path(folder) / "model.npz"
        np.savez_compressed(path, **self._ask("arrays"))
        return path

    def load(self, data: "TouchData", path: Path) -> None:
        """Load the model that :meth:`save` wrote."""
        self.check(data)
        self._begin()
        self._ask("load", load_npz(path))
        self.parameters, self._shape, labels = self._ask("describe")
        if labels != len(data.task):
            raise ValueError(f"it was trained on {labels} labels, not {', '.join(data.task.names)}")

    def _array(self, touches: Touches) -> np.ndarray:
        return self.inputs(touches.to("cpu")).to(torch.float32).numpy()

    def _begin(self) -> None:
        """Start the process with the settings of the model."""
        command = [_python(), "-m", "experiments.peers.worker"]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        weakref.finalize(self, _end, self._process)
        self._ask("begin", self._seed, torch.get_num_threads(), self._transform)

    def _ask(self, method: str, *values: Any) -> Any:
        """Return what a method of the process's model returns."""
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            pickle.dump((method, *values), process.stdin)
            process.stdin.flush()
            answer = pickle.load(process.stdout)  # of our own process
        except (BrokenPipeError, EOFError):
            raise InputError(f"the process of aeon ended with exit code {process.wait()}") from None
        if isinstance(answer, RuntimeError):
            raise answer
        return answer


def _python() -> str:
    """Return the Python of the other environment."""
    # It is not a setting, because a stored run must not choose a program.
    path = python()
    if not path.is_file():
        raise InputError(f"there is no {path}: make peers builds it")
    return str(path)


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    process.communicate()
