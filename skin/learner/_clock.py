"""How long training takes."""

import time
from typing import Any

from pytorch_lightning import Callback

__all__ = ["Clock"]


class Clock(Callback):
    """Measures the training part of every epoch, from its start to the end of its last batch.

    Attributes:
        seconds: of each epoch, s; validation left out.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self._began = 0.0

    def on_train_epoch_start(self, *_: Any) -> None:
        """Start an epoch."""
        self._began = time.perf_counter()
        self.seconds.append(0.0)

    def on_train_batch_end(self, *_: Any) -> None:
        """Note the time so far."""
        self.seconds[-1] = time.perf_counter() - self._began
