"""Learning by boosted trees on engineered measurements."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from annotated_types import Ge, Gt
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor
from threadpoolctl import threadpool_limits
from torch import Tensor

from skin.errors import InputError
from skin.labels import Task
from skin.learner.base import AbstractLearner
from skin.recording import Touches
from skin.safe_loading import load_npz
from skin.signal.features import measurements
from skin.signal.sliding_direction import direction_features

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.datamodule import TouchData


class Features(AbstractLearner):
    """Measures about 130 numbers on a touch and boosts decision trees on them, one ensemble per label.

    What a practitioner would try first; a network that does not beat it is not worth its cost. The
    measurements know no sensor by number, so it takes any layout. Where the task has a direction, signed
    measurements (:mod:`skin.signal.sliding_direction`) join them, and trees of least squares learn its
    cosines.

    Args:
        rounds: most trees per label; fewer if the validation loss stops falling.
        learning_rate: share of each tree that is added.
        patience: trees without a lower validation loss before stopping.
        seed: of the trees' ties.
    """

    def __init__(
        self,
        rounds: Annotated[int, Ge(1)] = 500,
        learning_rate: Annotated[float, Gt(0)] = 0.1,
        patience: Annotated[int, Ge(1)] = 30,
        seed: int = 0,
    ) -> None:
        self._settings = {
            "max_iter": rounds,
            "learning_rate": learning_rate,
            "n_iter_no_change": patience,
            "random_state": seed,
            "early_stopping": True,
        }
        self._fitted: dict[str, np.ndarray] | None = None
        self._models: list[HistGradientBoostingClassifier | HistGradientBoostingRegressor] = []
        self._task: Task | None = None

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Grow the trees on the training split, as many as the validation split likes."""
        table: dict[str, np.ndarray] = {}
        for split in ("train", "validation"):
            touches = data.touches(split)
            labels = touches.known_labels.cpu().numpy()
            table |= {split: _matrix(touches, data.task), f"{split}_labels": labels}
        self._grow(table, data.task)

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout; of a direction cosines."""
        if self._task is None:
            raise RuntimeError("fit or load the learner first")
        matrix = _matrix(touches, self._task)
        columns = [_told(model, matrix) for model in self._models]
        result = torch.from_numpy(np.stack(columns, axis=1)).to(torch.float32)
        return result / result.sum(dim=1, keepdim=True) if self._task.kind == "exclusive" else result

    def save(self, folder: Path) -> Path:
        """Write the table that the trees grew from to ``features.npz`` in ``folder`` and return its path.

        Trees have no format that is safe to load; grown again from the same table they are the same.
        """
        if self._fitted is None:
            raise RuntimeError("fit or load the learner first")
        path = Path(folder) / "features.npz"
        np.savez_compressed(path, **self._fitted)  # type: ignore[arg-type]
        return path

    def load(self, data: "TouchData", path: Path) -> None:
        """Grow the trees again from what ``save`` wrote; takes some seconds."""
        table = load_npz(path)
        columns = _matrix(data.touches("train")[:1], data.task).shape[1]
        for split in ("train", "validation"):
            values, labels = table[split], table[f"{split}_labels"]
            if labels.ndim != 2 or labels.shape[1] != len(data.task):
                known = labels.shape[-1] if labels.ndim else 0
                raise ValueError(f"it has learnt {known} labels, not {', '.join(data.task.names)}")
            if values.shape != (len(labels), columns) or not {values.dtype.kind, labels.dtype.kind} <= set(
                "f"
            ):
                raise ValueError(
                    f"{split} is {values.dtype} {values.shape}, not {len(labels)} x {columns} numbers"
                )
        self._grow(table, data.task)

    def _grow(self, table: dict[str, np.ndarray], task: Task) -> None:
        began = time.perf_counter()
        self._models = []
        # A label is learnt from the touches in which it means something.
        known, other = (
            task.counts(torch.from_numpy(table[f"{split}_labels"])).numpy()
            for split in ("train", "validation")
        )
        for label, name in enumerate(task.names):
            rows, held = known[:, label], other[:, label]
            truth = table["train_labels"][rows, label]
            if len(np.unique(truth)) < 2:
                raise InputError(f"all training touches have the same label {name}: give more touches")
            kind = HistGradientBoostingClassifier if name in task.binary else HistGradientBoostingRegressor
            model = kind(**self._settings)
            validation = {
                "X_val": table["validation"][held],
                "y_val": table["validation_labels"][held, label],
            }
            with threadpool_limits(torch.get_num_threads(), "openmp"):  # a job's share of the cores
                self._models.append(model.fit(table["train"][rows], truth, **validation))
        self._fitted, self._task = table, task
        self.seconds_per_epoch = time.perf_counter() - began
        # one number per leaf; scikit-learn counts leaves nowhere in public
        trees = [tree for model in self._models for trees in model._predictors for tree in trees]
        self.parameters = sum(tree.get_n_leaf_nodes() for tree in trees)


def _told(
    model: HistGradientBoostingClassifier | HistGradientBoostingRegressor, matrix: np.ndarray
) -> np.ndarray:
    """Return the probability (B,) that trees give, or the cosine."""
    if isinstance(model, HistGradientBoostingRegressor):
        return model.predict(matrix).clip(-1, 1)
    return model.predict_proba(matrix)[:, 1]


def _matrix(touches: Touches, task: Task) -> np.ndarray:
    """Return the measurements as (B, D), float32."""
    here = touches.to("cpu")
    columns = measurements(here) | (direction_features(here) if task.direction else {})
    return torch.stack([column.to(torch.float32) for column in columns.values()], dim=1).numpy()
