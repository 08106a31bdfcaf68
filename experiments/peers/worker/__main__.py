"""Fit and apply a model of another library, in the environment of that library.

Reads requests from standard input, one JSON object per line, and answers each with a line of JSON:

- ``{"do": "fit", "path": ..., "library": ..., "seed": ..., "jobs": ..., settings}`` fits a model to the
  arrays ``train``, ``train_labels``, ``validation`` and ``validation_labels`` of an .npz file.
- ``{"do": "load", "path": ..., ...}`` with the same settings restores the model that
  ``{"do": "save", "path": ...}`` wrote as an .npz file.
- ``{"do": "predict", "path": ..., "to": ...}`` reads inputs (B, ...) from an .npy file and writes
  probabilities (B, L).
- ``{"do": "place", "path": ..., "count": ..., "distance": ...}`` chooses sites of sensors from the arrays
  ``readings`` and ``places`` of an .npz file and answers with the result of ``sensor_sites``.

The answer to ``fit`` and ``load`` has the keys ``seconds``, ``parameters``, ``shape`` (of one input) and
``labels`` (their number); the answer to a request that fails has the key ``error``.
"""

import json
import os
import sys
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from experiments.peers.worker.kernel_model import KernelModel
from experiments.peers.worker.sensor_sites import sensor_sites
from experiments.peers.worker.tree_model import TreeModel

Arrays = dict[str, np.ndarray]


class Model(Protocol):
    """A model of another library."""

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one input."""

    @property
    def labels(self) -> int:
        """L."""

    def fit(self, data: Arrays) -> float:
        """Fit to the arrays of a request and return the duration, s."""

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L)."""

    def arrays(self) -> Arrays:
        """Return the fitted model as arrays of numbers."""

    def restore(self, arrays: Arrays) -> None:
        """Restore the model that :meth:`arrays` returned."""


LIBRARIES: dict[str, Callable[..., Model]] = {"lightgbm": TreeModel, "aeon": KernelModel}


class Worker:
    """Answers requests, each by the method of its name, on one model."""

    model: Model

    def fit(self, path: str, library: str, **settings: Any) -> dict[str, Any]:
        """Fit a model and describe it."""
        self.model = LIBRARIES[library](**settings)
        return self._described(self.model.fit(_load_arrays(path)))

    def load(self, path: str, library: str, **settings: Any) -> dict[str, Any]:
        """Restore a model and describe it."""
        self.model = LIBRARIES[library](**settings)
        self.model.restore(_load_arrays(path))
        return self._described(0.0)

    def save(self, path: str) -> dict[str, Any]:
        """Write the model."""
        np.savez_compressed(path, **self.model.arrays())  # type: ignore[arg-type]
        return {}

    def predict(self, path: str, to: str) -> dict[str, Any]:
        """Write the probabilities of the labels of touches."""
        np.save(to, self.model.predict(np.load(path, allow_pickle=False)))
        return {}

    def place(self, path: str, count: int, distance: float) -> dict[str, Any]:
        """Choose sites of sensors; this needs no model."""
        return sensor_sites(**_load_arrays(path), count=count, distance=distance)

    def _described(self, seconds: float) -> dict[str, Any]:
        model = self.model
        parameters = int(model.parameters)
        return {"seconds": seconds, "parameters": parameters, "shape": model.shape, "labels": model.labels}


def _load_arrays(path: str) -> Arrays:
    """Return the arrays of an .npz file."""
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def main() -> None:
    """Answer requests until standard input ends."""
    # What libraries print must not be read as an answer.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    worker = Worker()
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = getattr(worker, request.pop("do"))(**request)
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
