"""Learners on features of touches, stored by skops; of them gradient-boosted trees."""

import time
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias
from zipfile import ZIP_DEFLATED

import numpy as np
import torch
from annotated_types import Ge, Gt
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor
from sklearn.ensemble._hist_gradient_boosting.common import PREDICTOR_RECORD_DTYPE
from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor
from skops.io import dump, load
from threadpoolctl import threadpool_limits
from torch import Tensor

from skin.core.safe_loading import check_archive
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.features import feature_matrix
from skin.learning.learner import AbstractLearner
from skin.touch.labels import Task

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

_TRUSTED = [
    f"{TreePredictor.__module__}.{TreePredictor.__qualname__}",
    "skin.learning.small_data.Forest",
    "skin.learning.small_data.Kernel",
]
"""Types that a file may have besides those of scikit-learn and NumPy that skops knows as harmless."""


class FeatureLearner(AbstractLearner):
    """Base class of learners that fit models to features of touches.

    ``learned`` is a list of models, which have an attribute ``n_features_in_`` as in scikit-learn, and the
    task.
    """

    _features = staticmethod(feature_matrix)

    def _predict(self, model: Any, matrix: np.ndarray) -> np.ndarray:
        """Return what a model predicts of features (B, D): (B,) or (B, K)."""
        return model.predict(matrix)

    @abstractmethod
    def _kinds(self, task: Task) -> Sequence[Any]:
        """Return the type of each model, or a union of types."""

    @abstractmethod
    def _check(self, model: Any) -> None:
        """Raise a ValueError if predictions of a stored model could crash or never end."""

    def _size(self, model: Any) -> int:
        """Return the number of fitted numbers."""
        return model.size

    def _set(self, models: list[Any], task: Task) -> None:
        self._learned = models, task
        self.parameters = sum(map(self._size, models))

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        """Return probabilities or targets (B, L) of features (B, D).

        Raises:
            InputError: other features than those of the training, as targets of a regression depend on the
                number of sensors.
        """
        models, _ = self.learned
        if matrix.shape[1] != (count := models[0].n_features_in_):
            raise InputError(
                f"these touches have {matrix.shape[1]} features, the learner was trained on {count}: give "
                "touches of the sensors of the training"
            )
        return np.column_stack([self._predict(model, matrix) for model in models])

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L); targets of a regression, cosines of a direction.

        Raises:
            InputError: targets of a regression for other sensors than those of the training.
        """
        _, task = self.learned
        result = torch.from_numpy(self.predict(self._features(touches, task))).float()
        return result.clamp(-1, 1) if task.direction else result  # of the cosines

    def save(self, folder: Path) -> Path:
        """Write the models to ``models.skops`` and return its path: skops stores no code and no pickles."""
        path = Path(folder) / "models.skops"
        dump(self.learned[0], path, compression=ZIP_DEFLATED)
        return path

    def load(self, data: TouchData, path: Path) -> None:
        """Load the models that :meth:`save` wrote.

        Raises:
            InputError: they are of an earlier version.
            ValueError, TypeError, AttributeError: the file is damaged or holds something else.
        """
        if path.suffix != ".skops":
            raise InputError(
                f"{path.name} was stored by an earlier version: train the run again, with "
                "tracking.resume=false"
            )
        try:
            check_archive(path)
            models = load(path, trusted=_TRUSTED)
        except Exception as error:  # whatever zipfile, zlib, JSON, numpy and skops raise
            raise ValueError(" ".join(str(error).split()) or "it is cut off") from error
        task, kinds = data.task, self._kinds(data.task)
        features = self._features(data.example, task)
        if (
            not isinstance(models, list)
            or len(models) != len(kinds)
            or not all(map(isinstance, models, kinds))
        ):
            raise ValueError(f"it does not hold {len(kinds)} models of this learner")
        for model in models:
            if model.n_features_in_ != features.shape[1]:
                raise ValueError(f"it was trained on other features than these {features.shape[1]}")
            self._check(model)
        self._set(models, task)
        outputs = self.predict(features)
        if outputs.shape != (1, len(task)) or not np.isfinite(outputs).all():
            raise ValueError(f"it does not predict a number for each of {', '.join(task.names)}")


def check_trees(
    leaves: np.ndarray, features: np.ndarray, children: np.ndarray, values: np.ndarray, limit: int
) -> None:
    """Check stored trees: each path has to end in them, at a finite value.

    Args:
        leaves: (N,), whether a node is a leaf.
        features: (N,), number of the feature that a node compares.
        children: (N, 2), numbers of the nodes that follow, behind their parent.
        values: (N, ...), of leaves.
        limit: number of features.

    Raises:
        ValueError: a path leads out of the trees or the features, or in a circle.
    """
    ahead = (children > np.arange(len(leaves))[:, None]) & (children < len(leaves))
    known = ahead.all(axis=1) & (features >= 0) & (features < limit)
    if not len(leaves) or len(values) != len(leaves) or not (known | leaves).all():
        raise ValueError("it holds a tree that leads nowhere")
    if not np.isfinite(values).all():
        raise ValueError("it holds a tree without finite values")


Trees: TypeAlias = HistGradientBoostingClassifier | HistGradientBoostingRegressor


class BoostedTrees(FeatureLearner):
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

    def fit(self, data: TouchData, logger: "Logger | None" = None) -> None:
        """Grow the trees on the training split; the validation loss decides how many.

        Raises:
            InputError: a label has one value only, or no validation touch has it.
        """
        splits = [data.touches(split) for split in ("train", "validation")]
        matrices = [feature_matrix(touches, data.task) for touches in splits]
        labels = [touches.known_labels.cpu() for touches in splits]
        began = time.perf_counter()
        models = list[Trees]()
        for label, (name, kind) in enumerate(zip(data.task.names, self._kinds(data.task), strict=True)):
            # Each label is trained on the touches for which it is defined.
            defined = [data.task.counts(split)[:, label].numpy() for split in labels]
            train, validation = (
                (matrix[rows], split[rows, label].numpy())
                for matrix, split, rows in zip(matrices, labels, defined, strict=True)
            )
            if len(np.unique(train[1])) < 2:
                raise InputError(
                    f"all training touches have the same label {name}: give more touches, or "
                    "touches of every label, as touch=gestures draws them"
                )
            if not len(validation[1]):
                raise InputError(f"no validation touch has a label {name}: give more touches")
            with threadpool_limits(torch.get_num_threads(), "openmp"):  # a job's fraction of the cores
                models.append(kind(**self._settings).fit(*train, X_val=validation[0], y_val=validation[1]))
        self.seconds_per_epoch = time.perf_counter() - began
        self._set(models, data.task)

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout; cosines of a direction.

        Raises:
            InputError: targets of a regression for other sensors than those of the training.
        """
        result = super().probabilities(touches)
        return result / result.sum(dim=1, keepdim=True) if self.learned[1].kind == "exclusive" else result

    def _predict(self, model: Trees, matrix: np.ndarray) -> np.ndarray:
        if isinstance(model, HistGradientBoostingClassifier):
            return model.predict_proba(matrix)[:, 1]
        return super()._predict(model, matrix)

    def _kinds(self, task: Task) -> "list[type[Trees]]":
        kinds = HistGradientBoostingRegressor, HistGradientBoostingClassifier
        return [kinds[name in task.binary] for name in task.names]

    def _check(self, model: Trees) -> None:
        """Check stored trees, which scikit-learn follows without looking where they lead."""
        for (tree,) in model._predictors:
            nodes = tree.nodes
            plain = type(tree) is TreePredictor and nodes.dtype == PREDICTOR_RECORD_DTYPE
            if not plain or nodes["is_categorical"].any() or model._preprocessor is not None:
                raise ValueError("it holds something else than trees of numbers")
            children = np.column_stack([nodes["left"], nodes["right"]])
            leaves = nodes["is_leaf"] != 0
            check_trees(leaves, nodes["feature_idx"], children, nodes["value"], model.n_features_in_)

    def _size(self, model: Trees) -> int:
        """Return the number of leaves, of which scikit-learn has no public count."""
        return sum(tree.get_n_leaf_nodes() for (tree,) in model._predictors)
