"""Callbacks of a training: its duration, and what continues an interrupted one."""

import json
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from torch import Tensor


class Clock(Callback):
    """Measures the training part of every epoch, from its start to the end of its last batch.

    Args:
        path: of a file that keeps the durations; the process that trains may be another one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seconds: list[float] = []
        self._began = 0.0

    def median(self) -> float:
        """Return the median duration of an epoch after the training, s; validation is left out."""
        # A continued training that was complete runs no epoch: then the checkpoint alone knows.
        return median(self._seconds or json.loads(self._path.read_text()))

    def on_train_epoch_start(self, *_: Any) -> None:
        """Start an epoch."""
        self._began = time.perf_counter()
        self._seconds.append(0.0)

    def on_train_batch_end(self, *_: Any) -> None:
        """Note the time so far."""
        self._seconds[-1] = time.perf_counter() - self._began

    def on_train_end(self, trainer: Trainer, *_: Any) -> None:
        """Keep the durations."""
        if trainer.is_global_zero:
            self._path.write_text(json.dumps(self._seconds))

    def state_dict(self) -> dict[str, list[float]]:
        """Return the durations, for a checkpoint."""
        return {"seconds": self._seconds}

    def load_state_dict(self, state_dict: dict[str, list[float]]) -> None:
        """Take the durations of a checkpoint."""
        self._seconds = state_dict["seconds"]


class RandomState(Callback):
    """Keeps torch's random state in checkpoints: a continued training drops out the same units."""

    def __init__(self) -> None:
        self._state: Tensor | None = None

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state, for a checkpoint."""
        return {"state": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Take the state of a checkpoint."""
        self._state = state_dict["state"]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the state, after the last use of random numbers by the start itself."""
        if self._state is not None:
            torch.set_rng_state(self._state)
