"""Gradient-boosted trees on engineered features."""

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
from skin.signal.features import engineered_features
from skin.signal.sliding_direction import direction_features

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.datamodule import TouchData


class BoostedTrees(AbstractLearner):
    """Gradient-boosted decision trees on about 130 engineered features, one ensemble per label.

    This is the baseline that a network should beat. The features (:mod:`skin.signal.features`) do not depend
    on the number or order of sensors, so any layout is accepted. Where the task has a direction, signed
    features (:mod:`skin.signal.sliding_direction`) are added, and regression trees with a squared-error loss
    predict its cosines.

    Args:
        rounds: maximum number of trees per label; early stopping may use fewer.
        learning_rate: shrinkage of each tree.
        patience: number of trees without a lower validation loss before training stops.
        seed: breaks ties between splits.
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
        """Grow the trees on the training split; the validation loss decides how many."""
        table: dict[str, np.ndarray] = {}
        for split in ("train", "validation"):
            touches = data.touches(split)
            labels = touches.known_labels.cpu().numpy()
            table |= {split: _matrix(touches, data.task), f"{split}_labels": labels}
        self._grow(table, data.task)

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout; cosines of a direction."""
        if self._task is None:
            raise RuntimeError("fit or load the learner first")
        matrix = _matrix(touches, self._task)
        columns = [_predict(model, matrix) for model in self._models]
        result = torch.from_numpy(np.stack(columns, axis=1)).to(torch.float32)
        return result / result.sum(dim=1, keepdim=True) if self._task.kind == "exclusive" else result

    def save(self, folder: Path) -> Path:
        """Write the features and labels of the training data to ``features.npz`` and return its path.

        No format for trees is safe to load. :meth:`load` grows the same trees again from the same data.
        """
        if self._fitted is None:
            raise RuntimeError("fit or load the learner first")
        path = Path(folder) / "features.npz"
        np.savez_compressed(path, **self._fitted)  # type: ignore[arg-type]
        return path

    def load(self, data: "TouchData", path: Path) -> None:
        """Grow the trees again from the file that :meth:`save` wrote; takes some seconds."""
        table = load_npz(path)
        columns = _matrix(data.example, data.task).shape[1]
        for split in ("train", "validation"):
            values, labels = table[split], table[f"{split}_labels"]
            if labels.ndim != 2 or labels.shape[1] != len(data.task):
                known = labels.shape[-1] if labels.ndim else 0
                raise ValueError(f"it was trained on {known} labels, not {', '.join(data.task.names)}")
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
        # Each label is trained on the touches for which it is defined.
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
        # One number per leaf; scikit-learn has no public count of leaves.
        trees = [tree for model in self._models for trees in model._predictors for tree in trees]
        self.parameters = sum(tree.get_n_leaf_nodes() for tree in trees)


def _predict(
    model: HistGradientBoostingClassifier | HistGradientBoostingRegressor, matrix: np.ndarray
) -> np.ndarray:
    """Return the predicted probability (B,), or the predicted cosine."""
    if isinstance(model, HistGradientBoostingRegressor):
        return model.predict(matrix).clip(-1, 1)
    return model.predict_proba(matrix)[:, 1]


def _matrix(touches: Touches, task: Task) -> np.ndarray:
    """Return the features as (B, D), float32."""
    here = touches.to("cpu")
    columns = engineered_features(here) | (direction_features(here) if task.direction else {})
    return torch.stack([column.to(torch.float32) for column in columns.values()], dim=1).numpy()
