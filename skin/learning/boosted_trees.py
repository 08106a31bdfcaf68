"""Gradient-boosted trees on engineered features."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias
from zipfile import ZIP_DEFLATED

import numpy as np
import torch
from annotated_types import Ge, Gt
from sklearn._loss import HalfBinomialLoss, HalfSquaredError
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor
from sklearn.ensemble._hist_gradient_boosting.binning import _BinMapper
from sklearn.ensemble._hist_gradient_boosting.common import PREDICTOR_RECORD_DTYPE
from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor
from skops.io import dump, load
from threadpoolctl import threadpool_limits
from torch import Tensor

from skin.core.safe_loading import check_archive
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.features import feature_matrix
from skin.learning.learner import AbstractLearner
from skin.touch.labels import Task

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.data import TouchData
    from skin.learning.representation import FrameMaker

Trees: TypeAlias = HistGradientBoostingClassifier | HistGradientBoostingRegressor
_KINDS: dict[bool, type[Trees]] = {
    True: HistGradientBoostingClassifier,
    False: HistGradientBoostingRegressor,
}
_LOSSES = {HistGradientBoostingClassifier: HalfBinomialLoss, HistGradientBoostingRegressor: HalfSquaredError}
_TRUSTED = [f"{TreePredictor.__module__}.{TreePredictor.__qualname__}"]
"""Types that a file may have besides those of scikit-learn and NumPy that skops knows as harmless."""


class BoostedTrees(AbstractLearner):
    """Gradient-boosted decision trees on about 130 engineered features, one ensemble per label.

    This is the baseline that a network should beat. The features (:mod:`skin.learning.features`) do not
    depend on the number or order of sensors, so any layout is accepted. Where the task has a direction,
    signed features (:mod:`skin.learning.features`) are added, and regression trees with a squared-error loss
    predict its cosines. They predict the targets of a regression, too, for which features of each sensor are
    added: such trees accept the sensors of the training only.

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
        self._models: list[Trees] = []
        self._task: Task | None = None

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Grow the trees on the training split; the validation loss decides how many."""
        table: dict[str, np.ndarray] = {}
        for split in ("train", "validation"):
            touches = data.touches(split)
            labels = touches.known_labels.cpu().numpy()
            table |= {split: feature_matrix(touches, data.task), f"{split}_labels": labels}
        self._grow(table, data.task)

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout; cosines of a direction.

        Raises:
            InputError: targets of a regression for other sensors than those of the training.
        """
        if self._task is None:
            raise RuntimeError("fit or load the learner first")
        matrix = feature_matrix(touches, self._task)
        if matrix.shape[1] != (count := self._models[0].n_features_in_):
            raise InputError(
                f"these touches have {matrix.shape[1]} features, the trees were trained on {count}: give "
                "touches of the sensors of the training"
            )
        columns = [_predict(model, matrix) for model in self._models]
        result = torch.from_numpy(np.stack(columns, axis=1)).to(torch.float32)
        if self._task.kind == "exclusive":
            return result / result.sum(dim=1, keepdim=True)
        return result.clamp(-1, 1) if self._task.direction else result  # of the cosines

    def save(self, folder: Path) -> Path:
        """Write the trees to ``trees.skops`` and return its path: skops stores no code and no pickles."""
        if self._task is None:
            raise RuntimeError("fit or load the learner first")
        path = Path(folder) / "trees.skops"
        dump(self._models, path, compression=ZIP_DEFLATED)
        return path

    def load(self, data: "FrameMaker", path: Path) -> None:
        """Load the trees that :meth:`save` wrote.

        Raises:
            InputError: they are of an earlier version.
            ValueError, TypeError: the file is damaged or holds something else.
        """
        if path.suffix == ".npz":
            raise InputError(
                f"{path.name} holds the training data of trees, from which an earlier version grew them: "
                "train the run again, with tracking.resume=false"
            )
        try:
            check_archive(path)
            models = load(path, trusted=_TRUSTED)
        except Exception as error:  # whatever zipfile, zlib, JSON, numpy and skops raise
            raise ValueError(" ".join(str(error).split()) or "it is cut off") from error
        task, example = data.task, feature_matrix(data.example, data.task)
        if not isinstance(models, list) or len(models) != len(task):
            raise ValueError(f"it has no trees for each of {', '.join(task.names)}")
        for model, name in zip(models, task.names, strict=True):
            _check(model, _KINDS[name in task.binary], example.shape[1])
            if not np.isfinite(_predict(model, example)).all():
                raise ValueError(f"it predicts no number for {name}")
        self._models, self._task = models, task
        self._count()

    def _grow(self, table: dict[str, np.ndarray], task: Task) -> None:
        began = time.perf_counter()
        self._models = []
        # Each label is trained on the touches for which it is defined.
        trained, checked = (
            task.counts(torch.from_numpy(table[f"{split}_labels"])).numpy()
            for split in ("train", "validation")
        )
        for label, name in enumerate(task.names):
            rows, held = trained[:, label], checked[:, label]
            truth = table["train_labels"][rows, label]
            if len(np.unique(truth)) < 2:
                raise InputError(
                    f"all training touches have the same label {name}: give more touches, or "
                    "touches of every label, as touch=gestures draws them"
                )
            if not held.any():
                raise InputError(f"no validation touch has a label {name}: give more touches")
            model = _KINDS[name in task.binary](**self._settings)
            validation = {
                "X_val": table["validation"][held],
                "y_val": table["validation_labels"][held, label],
            }
            with threadpool_limits(torch.get_num_threads(), "openmp"):  # a job's share of the cores
                self._models.append(model.fit(table["train"][rows], truth, **validation))
        self._task = task
        self.seconds_per_epoch = time.perf_counter() - began
        self._count()

    def _count(self) -> None:
        # One number per leaf; scikit-learn has no public count of leaves.
        trees = [tree for model in self._models for trees in model._predictors for tree in trees]
        self.parameters = sum(tree.get_n_leaf_nodes() for tree in trees)


def _check(model: Any, kind: "type[Trees]", columns: int) -> None:
    """Check stored trees, which scikit-learn follows without looking where they lead.

    Args:
        model: as it was loaded.
        kind: of the model that its label needs.
        columns: number of features.

    Raises:
        ValueError, TypeError, AttributeError: no such model, or a tree leads out of itself or the features.
    """
    parts = type(model), type(model._loss), type(model._bin_mapper)
    categories = model._preprocessor, model.is_categorical_
    if parts != (kind, _LOSSES[kind], _BinMapper) or categories != (None, None):
        raise ValueError(f"it holds something else than a {kind.__name__} of numbers")
    if model.n_features_in_ != columns:
        raise ValueError(f"it was trained on {model.n_features_in_} features, not {columns}")
    for (tree,) in model._predictors:
        nodes = tree.nodes
        if type(tree) is not TreePredictor or nodes.dtype != PREDICTOR_RECORD_DTYPE or not len(nodes):
            raise ValueError("it holds something else than trees")
        place = np.flatnonzero(nodes["is_leaf"] == 0)
        inner = nodes[place]
        # A child behind its parent: each path ends.
        first, last = np.minimum(inner["left"], inner["right"]), np.maximum(inner["left"], inner["right"])
        feature, category = inner["feature_idx"], inner["is_categorical"]
        ahead = (first > place) & (last < len(nodes)) & (feature >= 0) & (feature < columns)
        if not ahead.all() or category.any():
            raise ValueError("it holds a tree that leads nowhere")


def _predict(model: Trees, matrix: np.ndarray) -> np.ndarray:
    """Return the predicted probability (B,), or the predicted cosine or target."""
    if isinstance(model, HistGradientBoostingRegressor):
        return model.predict(matrix)
    return model.predict_proba(matrix)[:, 1]
