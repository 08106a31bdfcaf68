"""Score any predictor on frozen sets of test touches: the conditions of ``conf/study/frozen.yaml``."""

import hashlib
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch

from skin.device.base import AbstractSimulated
from skin.device.touches import Recording
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics

if TYPE_CHECKING:
    from experiments.studies.trials import Subject

_HASHED = ("shape", "duration", "onset", "draws")


def frozen_hash(recording: Recording, overrides: Sequence[str]) -> str:
    """Return a hash of what rounding does not change: overrides, labels, gestures and invalid readings.

    Args:
        recording: the touches of a set.
        overrides: of the set.
    """
    touches = recording.touches
    parts = [touches.known_labels.bool(), touches.valid, *(recording.parameters[name] for name in _HASHED)]
    content = hashlib.sha256("\n".join(overrides).encode())
    for part in parts:
        content.update(part.contiguous().numpy().tobytes())
    return content.hexdigest()[:16]


@dataclass(frozen=True)
class Frozen:
    """Accuracies of a predictor on a set.

    Args:
        predictor: a finished run or pretrained model, a file of ``skin export`` (for the sets of its layout),
            or ``package.module:function`` of readings (B, T, S), N, NaN where invalid, and positions (S, 3),
            m, that returns the probability of each label, (B, 4): big, dynamic, press, dangerous.
        hash: of the touches.
    """

    predictor: str = "any_skin"
    hash: str = ""

    def __call__(self, subject: "Subject") -> pd.DataFrame:
        device = subject.device.simulated("frozen sets are simulated")
        if (predict := self._predict(subject, device)) is None:
            return pd.DataFrame()
        recording = device.recording("test", complete=False)
        if (present := frozen_hash(recording, subject.changes)) != self.hash:
            raise InputError(
                f"the touches of the set {subject.condition} have the hash {present}, and the frozen ones "
                f"{self.hash}: use the version of the package that they were frozen with"
            )
        touches = recording.touches
        labels = touches.known_labels
        readings = touches.readings.masked_fill(~touches.valid, torch.nan).numpy()
        probabilities = torch.as_tensor(np.asarray(predict(readings, device.sensors.positions), np.float32))
        if probabilities.shape != labels.shape or not probabilities.isfinite().all():
            raise InputError(
                f"a predictor returns finite probabilities {tuple(labels.shape)}, got "
                f"{tuple(probabilities.shape)}"
            )
        metrics = compute_metrics(probabilities, labels, device.task)
        accuracies = {
            key: round(100 * value, 2) for key, value in metrics.items() if key.endswith("/accuracy")
        }
        start = {"set": subject.condition, "hash": present, "gestures": len(touches)}
        return pd.DataFrame([start | accuracies])

    def _predict(
        self, subject: "Subject", device: AbstractSimulated
    ) -> Callable[[np.ndarray, np.ndarray], Any] | None:
        """Return the predictor for the skin of a device; None: it was exported for another layout."""
        module, _, function = self.predictor.partition(":")
        if function:
            try:
                return getattr(importlib.import_module(module), function)
            except (ImportError, AttributeError) as error:
                raise InputError(f"predictor={self.predictor} cannot be imported: {error}") from error
        model = subject.load(self.predictor)
        same = model.positions.shape == device.sensors.positions.shape
        if not same or not np.allclose(model.positions, device.sensors.positions, atol=1e-6):
            return None
        return lambda readings, positions: model.predict(readings)
