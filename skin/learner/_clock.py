"""How long training takes."""

import json
import time
from pathlib import Path
from statistics import median
from typing import Any

from pytorch_lightning import Callback, Trainer


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
        return median(json.loads(self._path.read_text()))

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
