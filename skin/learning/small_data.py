"""Learners for small data: kernel ridge regression, extra trees, and the better of several."""

import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import torch
from pydantic import Field, PositiveFloat, PositiveInt
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.special import expit, log_expit, log_softmax, softmax
from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor
from torch import Tensor

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.boosted_trees import FeatureLearner, check_trees
from skin.learning.data import TouchData
from skin.learning.features import course_features, feature_matrix
from skin.touch.labels import Task

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

Kind = Literal["binary", "exclusive", "regression"]


def small_data_features(touches: Touches, task: Task) -> np.ndarray:
    """Return the features of :class:`SmallDataLearner`, (B, D), float32."""
    course = torch.stack(list(course_features(touches.to("cpu")).values()), dim=1)
    return np.hstack([feature_matrix(touches, task), course.float().numpy()])


class SmallDataLearner(FeatureLearner):
    """Base class of learners that fit columns of labels to features of touches, without a validation.

    The features are the engineered ones, those of the course over time, and for a regression those of each
    sensor. A label is fitted on the touches for which it is known.
    """

    _features = staticmethod(small_data_features)

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed

    @property
    @abstractmethod
    def _kind(self) -> Any:
        """Type of the models, or a union of types."""

    def _fit(self, matrix: np.ndarray, labels: np.ndarray, kind: Kind) -> "Kernel | Forest":
        """Fit features (B, D) to labels (B, K): one label or target, or K classes."""
        raise NotImplementedError

    def fit(self, data: TouchData, logger: "Logger | None" = None) -> None:
        """Fit to the training split alone: the validation split is for thresholds and objectives."""
        began, touches = time.perf_counter(), data.touches("train")
        matrix, labels = small_data_features(touches, data.task), touches.known_labels.cpu().numpy()
        self.learn(matrix, labels, data.task)
        self.seconds_per_epoch = time.perf_counter() - began

    def learn(self, matrix: np.ndarray, labels: np.ndarray, task: Task) -> Self:
        """Fit features (B, D) to labels (B, L), NaN where unknown.

        Raises:
            InputError: a label or target has one value only.
        """
        known = task.counts(torch.from_numpy(labels)).numpy()
        for label, name in enumerate(task.names):
            if len(np.unique(labels[known[:, label], label])) < 2:
                raise InputError(
                    f"all training touches have the same label {name}: give more touches, or touches of "
                    "every label"
                )
        models = []
        for columns in _columns(task):
            rows = known[:, columns[0]]
            kind: Kind = task.kind if task.names[columns[0]] in task.binary else "regression"
            models.append(self._fit(matrix[rows], labels[rows][:, columns], kind))
        self._set(models, task)
        return self

    def _kinds(self, task: Task) -> Sequence[Any]:
        return [self._kind] * len(_columns(task))

    def _check(self, model: "Kernel | Forest") -> None:
        if isinstance(model, Forest):
            leaves = model.feature < 0
            check_trees(leaves, model.feature, model.children, model.values, model.n_features_in_)


def _columns(task: Task) -> list[list[int]]:
    """Return which labels are fitted together: classes, and else each by itself."""
    labels = list(range(len(task)))
    return [labels] if task.kind == "exclusive" else [[label] for label in labels]


# Kernel ridge regression.


@dataclass(frozen=True)
class Kernel:
    """A kernel expansion: outputs are sums of weights times kernels with the vectors, and an intercept.

    Attributes:
        typical: (D,), what features are divided by before asinh, which tames their long tails.
        mean, deviation: (D,), of the results.
        vectors: (V, D), scaled touches.
        weights: (V, K).
        intercept: (K,).
        scale: of the Laplacian kernel ``exp(-scale mean(abs(z - z')))``; 0: the linear kernel ``mean(z z')``.
        link: (2,), slope and offset of the logits of a label, or slope for classes; NaN: outputs are targets.
    """

    typical: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    vectors: np.ndarray
    weights: np.ndarray
    intercept: np.ndarray
    scale: np.ndarray
    link: np.ndarray

    @property
    def size(self) -> int:
        """Number of fitted numbers."""
        return self.weights.size

    @property
    def n_features_in_(self) -> int:
        """Number of features, D."""
        return len(self.mean)

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        """Return outputs (B, K) of features (B, D)."""
        scaled = _scale(matrix, self.typical, self.mean, self.deviation)
        outputs = _kernel(scaled, self.vectors, float(self.scale)) @ self.weights + self.intercept
        if np.isnan(self.link).any():
            return outputs
        if outputs.shape[1] > 1:
            return softmax(self.link[0] * outputs, axis=1)
        return expit(self.link[0] * outputs + self.link[1])


def _scale(
    matrix: np.ndarray, typical: np.ndarray, mean: np.ndarray, deviation: np.ndarray, limit: float = 5.0
) -> np.ndarray:
    """Return features (B, D) with a mean of 0 and a deviation of 1; they end at ``limit`` deviations."""
    return ((np.arcsinh(matrix / typical) - mean) / deviation).clip(-limit, limit)


def _kernel(first: np.ndarray, second: np.ndarray, scale: float) -> np.ndarray:
    """Return the kernel of scaled touches (B, D) and (V, D), (B, V)."""
    if scale == 0:
        return first @ second.T / first.shape[1]
    return np.exp(-scale / first.shape[1] * cdist(first, second, "cityblock"))


class KernelRidge(SmallDataLearner):
    """Kernel ridge regression of labels, classes or targets, linear or with a Laplacian kernel.

    Kernel and ridge are those with the lowest leave-one-out error, which is known in closed form; so are the
    outputs from which the probabilities are calibrated (Platt, 1999). It is the strongest learner for some
    ten to thousand touches of one skin.

    Args:
        scales: candidates for the scale of the Laplacian kernel; features differ by one deviation.
        ridges: candidates for the ridge.
        touches: of more touches, as many are drawn; the kernel of 4000 takes 128 MB.
        seed: of that draw.
    """

    _kind = Kernel

    def __init__(
        self,
        scales: Sequence[PositiveFloat] = (0.1, 0.3, 1.0, 3.0),
        ridges: Sequence[PositiveFloat] = tuple(np.logspace(-5, 2, 15).tolist()),
        touches: PositiveInt = 4000,
        seed: int = 0,
    ) -> None:
        super().__init__(seed)
        self._scales, self._ridges, self._touches = scales, ridges, touches

    def _fit(self, matrix: np.ndarray, labels: np.ndarray, kind: Kind) -> Kernel:
        drawn = np.sort(np.random.default_rng(self._seed).permutation(len(matrix))[: self._touches])
        matrix, labels = matrix[drawn].astype(float), labels[drawn].astype(float)
        middle = np.median(np.abs(matrix), axis=0)
        typical = np.where(middle > 0, middle, np.abs(matrix).mean(axis=0))
        typical = np.where(typical > 0, typical, 1.0)
        curved = np.arcsinh(matrix / typical)
        mean, deviation = curved.mean(axis=0), curved.std(axis=0)
        deviation = np.where(deviation > 1e-6, deviation, np.inf)
        vectors = _scale(matrix, typical, mean, deviation)
        intercept, unit = labels.mean(axis=0), labels.std(axis=0).max()
        outputs = (labels - intercept) / unit
        candidates = []
        for scale in (0.0, *self._scales):
            values, axes = np.linalg.eigh(_kernel(vectors, vectors, scale))
            along = axes.T @ outputs
            for ridge in self._ridges:
                inverse = 1 / (values.clip(0) + ridge)
                weights = axes @ (inverse[:, None] * along)
                errors = weights / (np.square(axes) @ inverse)[:, None]
                candidates.append((np.square(errors).mean(), scale, weights, errors))
        _, scale, weights, errors = min(candidates, key=lambda candidate: candidate[0])
        link = np.full(2, np.nan) if kind == "regression" else _fit_link(labels - unit * errors, labels)
        return Kernel(typical, mean, deviation, vectors, unit * weights, intercept, np.asarray(scale), link)


def _fit_link(held: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return slope and offset, (2,), of the logits of outputs that did not see their label; both are (B, K).

    Labels are smoothed as Platt (1999) does, so that outputs that separate them have a finite slope.
    """
    count = labels.sum(axis=0)
    target = np.where(labels > 0.5, (count + 1) / (count + 2), 1 / (len(labels) - count + 2))

    def loss(link: np.ndarray) -> float:
        if held.shape[1] > 1:
            return -float((labels * log_softmax(link[0] * held, axis=1)).sum(axis=1).mean())
        logits = link[0] * held + link[1]
        return -float((target * log_expit(logits) + (1 - target) * log_expit(-logits)).mean())

    return np.asarray(minimize(loss, [4.0, -2.0], method="Nelder-Mead").x)


# Extra trees.


@dataclass(frozen=True)
class Forest:
    """Trees as arrays of N nodes, the children of which stand behind them; their outputs are averaged.

    scikit-learn's own trees take ten times as long for one touch, and a forged file of them could crash the
    process.

    Attributes:
        roots: (T,), numbers of the first nodes.
        feature: (N,), which feature is compared; below 0 in leaves.
        threshold: (N,), up to which the first child follows.
        children: (N, 2), numbers of the children.
        values: (N, K), of leaves: probabilities or targets.
        n_features_in_: number of features, D.
    """

    roots: np.ndarray
    feature: np.ndarray
    threshold: np.ndarray
    children: np.ndarray
    values: np.ndarray
    n_features_in_: int

    @property
    def size(self) -> int:
        """Number of leaves."""
        return int((self.feature < 0).sum())

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        """Return outputs (B, K) of features (B, D)."""
        node = np.tile(self.roots, (len(matrix), 1))
        rows = np.arange(len(matrix))[:, None]
        matrix = matrix.astype(np.float32)  # as in the training
        while (inner := self.feature[node] >= 0).any():
            above = matrix[rows, self.feature[node]] > self.threshold[node]
            node = np.where(inner, self.children[node, above.astype(int)], node)
        return np.asarray(self.values[node].mean(axis=1))


class ExtraTrees(SmallDataLearner):
    """Extremely randomised trees (Geurts, Ernst and Wehenkel, 2006).

    Unlike boosted trees they need no validation, and learn from fifty touches.

    Args:
        trees: number for each label.
        seed: of the splits.
    """

    _kind = Forest

    def __init__(self, trees: PositiveInt = 300, seed: int = 0) -> None:
        super().__init__(seed)
        self._trees = trees

    def _fit(self, matrix: np.ndarray, labels: np.ndarray, kind: Kind) -> Forest:
        make = ExtraTreesRegressor if kind == "regression" else ExtraTreesClassifier
        truth = labels.argmax(axis=1) if kind == "exclusive" else labels[:, 0]
        model = make(self._trees, random_state=self._seed).fit(matrix, truth)
        trees = [estimator.tree_ for estimator in model.estimators_]
        roots = np.cumsum([0, *(tree.node_count for tree in trees[:-1])])
        children = [
            np.column_stack([tree.children_left, tree.children_right]) + root
            for tree, root in zip(trees, roots, strict=True)
        ]
        return Forest(
            roots,
            np.concatenate([tree.feature for tree in trees]),
            np.concatenate([tree.threshold for tree in trees]),
            np.concatenate(children),
            # of a label with two values only the probability of the second
            np.concatenate([tree.value[:, 0, -labels.shape[1] :] for tree in trees]),
            matrix.shape[1],
        )


# The better of several learners.


def split_folds(labels: Tensor, count: int, seed: int) -> Tensor:
    """Return the fold of each touch, (B,), from 0 up, for labels (B, L).

    Folds differ by at most one in size, and in the number of touches with each combination of labels. The
    touches are dealt out in an order that the seed gives.
    """
    order = torch.randperm(len(labels), generator=torch.Generator().manual_seed(seed))
    combination = torch.unique(labels > 0.5, dim=0, return_inverse=True)[1]
    order = order[combination[order].argsort(stable=True)]
    folds = torch.empty_like(order)
    folds[order] = torch.arange(len(order)) % count
    return folds


def predict_held_out(
    make: Callable[[], SmallDataLearner], matrix: np.ndarray, labels: np.ndarray, task: Task, fold: np.ndarray
) -> np.ndarray:
    """Return probabilities or targets (B, L) of each touch, from a learner that did not see its fold (B,).

    Raises:
        InputError: a label has one value outside of a fold.
    """
    held = np.empty(labels.shape)
    for number in np.unique(fold):
        inside = fold == number
        held[inside] = make().learn(matrix[~inside], labels[~inside], task).predict(matrix[inside])
    return held


def touch_losses(
    probabilities: np.ndarray, labels: np.ndarray, task: Task, minimum: float = 0.01
) -> np.ndarray:
    """Return the mean loss of each touch over its known labels, (B,), 0 without any.

    The loss of a probability is its cross-entropy, of a target the square error in units of the variance.

    Args:
        probabilities: (B, L); of a direction the mean cosines; or targets.
        labels: (B, L), NaN where unknown.
        task: meaning of the labels.
        minimum: probability below which a loss grows no further.
    """
    known = task.counts(torch.from_numpy(labels)).numpy()
    truth = np.where(known, labels, 0.0)
    if task.kind == "regression":
        losses = np.square(probabilities - truth) / np.nanvar(labels, axis=0)
    elif task.kind == "exclusive":
        return np.asarray(-(truth * np.log(probabilities.clip(minimum, 1))).sum(axis=1))
    else:
        predicted, target = (
            task.fractions(torch.from_numpy(np.asarray(values, dtype=float))).numpy()
            for values in (probabilities, truth)
        )
        predicted = predicted.clip(minimum, 1 - minimum)
        losses = -(target * np.log(predicted) + (1 - target) * np.log(1 - predicted))
    return np.asarray((losses * known).sum(axis=1) / known.sum(axis=1).clip(1))


class BestByCrossValidation(SmallDataLearner):
    """Fits the one of several learners that predicts held-out touches best.

    Args:
        members: name -> a learner for small data, without its seed.
        folds: number of parts, each of which is held out once.
        seed: of the folds and the learners.

    Attributes:
        losses: member -> its mean loss on held-out touches, known after ``fit``.

    Raises:
        InputError: no member.
    """

    _kind = Kernel | Forest

    def __init__(
        self,
        members: Mapping[str, Callable[..., SmallDataLearner]],
        folds: Annotated[int, Field(ge=2)] = 5,
        seed: int = 0,
    ) -> None:
        super().__init__(seed)
        if not members:
            raise InputError("learner=chosen has no member: give learner.members.kernel_ridge, for example")
        self._members, self._folds = dict(members), folds

    def learn(self, matrix: np.ndarray, labels: np.ndarray, task: Task) -> Self:
        """Compare the members on held-out parts; fit the best to all touches.

        Raises:
            InputError: a label or target has one value only outside of a part.
        """
        fold = split_folds(torch.from_numpy(labels), self._folds, self._seed).numpy()
        makers = {name: partial(make, seed=self._seed) for name, make in self._members.items()}
        self.losses = dict[str, float]()
        for name, make in makers.items():
            held = predict_held_out(make, matrix, labels, task, fold)
            self.losses[name] = float(touch_losses(held, labels, task).mean())
        best = min(self.losses, key=self.losses.__getitem__)
        words = ", ".join(f"{name} {loss:.4f}" for name, loss in self.losses.items())
        print(f"held-out loss: {words}: {best}", file=sys.stderr, flush=True)
        self._set(makers[best]().learn(matrix, labels, task).learned[0], task)
        return self
