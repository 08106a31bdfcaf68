"""Learners for few touches: kernel ridge regression, extra trees, and the better of several."""

import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, Self

import numpy as np
import torch
from annotated_types import Ge
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.special import expit, log_expit, log_softmax, softmax
from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor
from torch import Tensor

from skin.core.safe_loading import check_archive
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.features import course_features, feature_matrix
from skin.learning.learner import AbstractLearner
from skin.touch.labels import Task

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.data import TouchData
    from skin.learning.representation import FrameMaker

Kind = Literal["binary", "exclusive", "regression"]
_LEAST = 0.01  # a probability below which a loss grows no further


class _Fitted(Protocol):
    """What was fitted to columns of labels."""

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        """Return outputs (B, K) of features (B, D)."""

    @property
    def size(self) -> int:
        """Number of fitted numbers."""


class AbstractFew(AbstractLearner):
    """Base class of learners that fit columns of labels to features of touches, without a validation.

    The features are the engineered ones, those of the course over time, and for a regression those of each
    sensor. A label is fitted on the touches for which it is known.
    """

    _task: Task | None = None
    _fitted: Sequence[_Fitted] = ()
    _file: str

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed

    @abstractmethod
    def _fit(self, matrix: np.ndarray, labels: np.ndarray, kind: Kind) -> _Fitted:
        """Fit features (B, D) to labels (B, K): one label or target, or K classes."""

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Fit to the training and the validation split, since nothing else needs the latter."""
        began = time.perf_counter()
        self.learn(*join_splits(data), data.task)
        self.seconds_per_epoch = time.perf_counter() - began

    def learn(self, matrix: np.ndarray, labels: np.ndarray, task: Task) -> Self:
        """Fit features (B, D) to labels (B, L), NaN where unknown.

        Raises:
            InputError: a label or target has one value only.
        """
        known = task.counts(torch.from_numpy(labels)).numpy()
        columns = [range(len(task))] if task.kind == "exclusive" else [[n] for n in range(len(task))]
        for label, name in enumerate(task.names):
            if len(np.unique(labels[known[:, label], label])) < 2:
                raise InputError(
                    f"all training touches have the same label {name}: give more touches, or touches of "
                    "every label"
                )
        fitted = list[_Fitted]()
        for chosen in columns:
            rows = known[:, chosen[0]]
            kind: Kind = task.kind if task.names[chosen[0]] in task.binary else "regression"
            fitted.append(self._fit(matrix[rows], labels[rows][:, chosen], kind))
        self._fitted = fitted
        self._task = task
        self.parameters = sum(part.size for part in self._fitted)
        return self

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        """Return probabilities or targets (B, L) of features (B, D)."""
        return np.concatenate([part.predict(matrix) for part in self._fitted], axis=1)

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L); targets of a regression, cosines of a direction."""
        if self._task is None:
            raise RuntimeError("fit or load the learner first")
        chances = torch.from_numpy(self.predict(few_features(touches, self._task))).float()
        return chances.clamp(-1, 1) if self._task.direction else chances

    def save(self, folder: Path) -> Path:
        """Write the fitted numbers to an .npz file and return its path."""
        if self._task is None:
            raise RuntimeError("fit or load the learner first")
        path = Path(folder) / self._file
        arrays: dict[str, Any] = {
            f"{number}_{name}": np.asarray(values)
            for number, part in enumerate(self._fitted)
            for name, values in vars(part).items()
        }
        np.savez_compressed(path, **arrays)
        return path

    def load(self, data: "FrameMaker", path: Path) -> None:
        """Load the file that :meth:`save` wrote.

        Raises:
            ValueError: it is damaged or holds something else.
        """
        check_archive(path)
        task, matrix = data.task, few_features(data.example, data.task)
        with np.load(path, allow_pickle=False) as stored:
            content = {name: stored[name] for name in stored.files}
        count = 1 if task.kind == "exclusive" else len(task)
        kind, width = self._kind(), len(task) // count
        fitted = []
        for number in range(count):
            try:
                arrays = {name: content[f"{number}_{name}"] for name in kind.__dataclass_fields__}
            except KeyError as error:
                raise ValueError(f"it has no {error} for each of {', '.join(task.names)}") from error
            part = kind(**arrays)
            part.check(matrix.shape[1], width)
            fitted.append(part)
        self._task, self._fitted = task, fitted
        if not np.isfinite(self.predict(matrix)).all():
            raise ValueError("it predicts no numbers")
        self.parameters = sum(part.size for part in fitted)

    @abstractmethod
    def _kind(self) -> Any:
        """Return the class of what is fitted."""


def join_splits(data: "TouchData") -> tuple[np.ndarray, np.ndarray]:
    """Return features (B, D) and labels (B, L) of the training and the validation split."""
    parts = [data.touches(split) for split in ("train", "validation")]
    labels = np.concatenate([part.known_labels.cpu().numpy() for part in parts])
    return np.concatenate([few_features(part, data.task) for part in parts]), labels


def few_features(touches: Touches, task: Task) -> np.ndarray:
    """Return the features of :class:`AbstractFew`, (B, D), float32."""
    course = torch.stack(list(course_features(touches.to("cpu")).values()), dim=1)
    return np.hstack([feature_matrix(touches, task), course.float().numpy()])


# Kernel ridge regression.


_SCALES = (0.1, 0.3, 1.0, 3.0)  # of the Laplacian kernel, for features that differ by one deviation
_RIDGES = np.logspace(-5, 2, 15)
_MOST = 4000  # touches, whose kernel has 128 MB
_FAR = 5.0  # deviations beyond which a feature counts as no further


@dataclass(frozen=True)
class _Kernel:
    """A kernel expansion: outputs are sums of weights times kernels with the vectors, and an intercept.

    Attributes:
        typical: (D,), what features are divided by before asinh, which tames their long tails.
        mean, deviation: (D,), of the results.
        vectors: (V, D), scaled touches.
        weights: (V, K).
        intercept: (K,).
        scale: of the Laplacian kernel exp(-scale mean |z - z'|); 0: the linear kernel mean(z z').
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
        return self.weights.size

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        scaled = _scale(matrix, self.typical, self.mean, self.deviation)
        outputs = _kernel(scaled, self.vectors, float(self.scale)) @ self.weights + self.intercept
        if np.isnan(self.link).any():
            return outputs
        if outputs.shape[1] > 1:
            return softmax(self.link[0] * outputs, axis=1)
        return expit(self.link[0] * outputs + self.link[1])

    def check(self, features: int, outputs: int) -> None:
        """Raise a ValueError where arrays have other shapes."""
        count = len(self.vectors) if self.vectors.ndim else 0
        shapes = {
            **dict.fromkeys(("typical", "mean", "deviation"), (features,)),
            "vectors": (count, features),
            "weights": (count, outputs),
            "intercept": (outputs,),
            "scale": (),
            "link": (2,),
        }
        check_shapes(self, shapes)


def check_shapes(part: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise a ValueError where an attribute is no array of numbers with a shape."""
    for name, shape in shapes.items():
        array = getattr(part, name)
        if array.shape != shape or array.dtype.kind not in "fi":
            raise ValueError(f"its {name} are no numbers {shape}")


def _scale(matrix: np.ndarray, typical: np.ndarray, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return features (B, D) with a mean of 0 and a deviation of 1, without long tails."""
    return ((np.arcsinh(matrix / typical) - mean) / deviation).clip(-_FAR, _FAR)


def _kernel(first: np.ndarray, second: np.ndarray, scale: float) -> np.ndarray:
    """Return the kernel of scaled touches (B, D) and (V, D), (B, V)."""
    if scale == 0:
        return first @ second.T / first.shape[1]
    return np.exp(-scale / first.shape[1] * cdist(first, second, "cityblock"))


class KernelRidge(AbstractFew):
    """Kernel ridge regression of labels, classes or targets, linear or with a Laplacian kernel.

    Kernel and ridge are those with the lowest leave-one-out error, which is known in closed form; so are the
    outputs from which the probabilities are calibrated (Platt, 1999). It is the strongest learner for some
    ten to thousand touches of one skin. Of more than 4000 touches, as many are drawn.

    Args:
        seed: of that draw.
    """

    _file = "kernel.npz"

    def _kind(self) -> Any:
        return _Kernel

    def _fit(self, matrix: np.ndarray, labels: np.ndarray, kind: Kind) -> _Kernel:
        drawn = np.sort(np.random.default_rng(self._seed).permutation(len(matrix))[:_MOST])
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
        best: tuple[float, float, np.ndarray, np.ndarray] | None = None
        for scale in (0.0, *_SCALES):
            values, axes = np.linalg.eigh(_kernel(vectors, vectors, scale))
            along = axes.T @ outputs
            for ridge in _RIDGES:
                inverse = 1 / (values.clip(0) + ridge)
                weights = axes @ (inverse[:, None] * along)
                errors = weights / (np.square(axes) @ inverse)[:, None]
                loss = float(np.square(errors).mean())
                if best is None or loss < best[0]:
                    best = loss, scale, weights, errors
        assert best is not None
        _, scale, weights, errors = best
        link = np.full(2, np.nan) if kind == "regression" else _fit_link(labels - unit * errors, labels)
        return _Kernel(typical, mean, deviation, vectors, unit * weights, intercept, np.asarray(scale), link)


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


_TREES = 300


@dataclass(frozen=True)
class _Forest:
    """Trees as arrays of N nodes, the children of which stand behind them.

    Attributes:
        roots: (T,), numbers of the first nodes.
        feature: (N,), which feature is compared; -1 in leaves.
        threshold: (N,), up to which the left child follows.
        left, right: (N,), numbers of the children.
        values: (N, K), of leaves: probabilities or targets.
    """

    roots: np.ndarray
    feature: np.ndarray
    threshold: np.ndarray
    left: np.ndarray
    right: np.ndarray
    values: np.ndarray

    @property
    def size(self) -> int:
        return int((self.feature < 0).sum())

    def predict(self, matrix: np.ndarray) -> np.ndarray:
        node = np.tile(self.roots, (len(matrix), 1))
        rows = np.arange(len(matrix))[:, None]
        matrix = matrix.astype(np.float32)  # as the trees saw it
        while (inner := self.feature[node] >= 0).any():
            left = matrix[rows, self.feature[node]] <= self.threshold[node]
            node = np.where(inner, np.where(left, self.left[node], self.right[node]), node)
        return np.asarray(self.values[node].mean(axis=1))

    def check(self, features: int, outputs: int) -> None:
        """Raise a ValueError where trees lead out of themselves or of the features, or in circles."""
        count = len(self.feature) if self.feature.ndim else 0
        shapes = dict.fromkeys(("feature", "threshold", "left", "right"), (count,))
        check_shapes(self, shapes | {"values": (count, outputs), "roots": self.roots.shape[:1]})
        whole = (self.roots, self.feature, self.left, self.right)
        inner = np.flatnonzero(self.feature >= 0)
        ahead = np.minimum(self.left, self.right)[inner] > inner
        inside = np.maximum(self.left, self.right)[inner] < count
        starts = len(self.roots) and (self.roots >= 0).all() and (self.roots < count).all()
        integers = all(array.dtype.kind == "i" for array in whole)
        if not (integers and starts and (ahead & inside).all() and (self.feature < features).all()):
            raise ValueError("it holds a tree that leads nowhere")


class ExtraTrees(AbstractFew):
    """Extremely randomised trees (Geurts, Ernst and Wehenkel, 2006), 300 for each label.

    Unlike boosted trees they need no validation, and learn from fifty touches.

    Args:
        seed: of the splits.
    """

    _file = "forest.npz"

    def _kind(self) -> Any:
        return _Forest

    def _fit(self, matrix: np.ndarray, labels: np.ndarray, kind: Kind) -> _Forest:
        make = ExtraTreesRegressor if kind == "regression" else ExtraTreesClassifier
        truth = labels.argmax(axis=1) if kind == "exclusive" else labels[:, 0]
        model = make(_TREES, random_state=self._seed).fit(matrix, truth)
        trees = [estimator.tree_ for estimator in model.estimators_]
        roots = np.cumsum([0, *(tree.node_count for tree in trees[:-1])])
        values = np.concatenate([tree.value[:, 0] for tree in trees])
        if kind == "binary":
            values = values[:, 1:]
        elif kind == "exclusive":
            whole = np.zeros((len(values), labels.shape[1]))
            whole[:, model.classes_] = values
            values = whole
        return _Forest(
            roots,
            np.maximum(np.concatenate([tree.feature for tree in trees]), -1),
            np.concatenate([tree.threshold for tree in trees]),
            np.concatenate([tree.children_left + root for tree, root in zip(trees, roots, strict=True)]),
            np.concatenate([tree.children_right + root for tree, root in zip(trees, roots, strict=True)]),
            values,
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
    make: Callable[[], AbstractFew], matrix: np.ndarray, labels: np.ndarray, task: Task, fold: np.ndarray
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


def touch_losses(chances: np.ndarray, labels: np.ndarray, task: Task) -> np.ndarray:
    """Return the mean loss of each touch over its known labels, (B,), 0 without any.

    The loss of a probability is its cross-entropy, of a target the square error in units of the variance.

    Args:
        chances: (B, L), probabilities; of a direction the mean cosines; or targets.
        labels: (B, L), NaN where unknown.
        task: meaning of the labels.
    """
    known = task.counts(torch.from_numpy(labels)).numpy()
    truth = np.where(known, labels, 0.0)
    if task.kind == "regression":
        losses = np.square(chances - truth) / np.nanvar(labels, axis=0)
    elif task.kind == "exclusive":
        return np.asarray(-(truth * np.log(chances.clip(_LEAST, 1))).sum(axis=1))
    else:
        share, whole = (
            task.shares(torch.from_numpy(np.asarray(values, dtype=float))).numpy()
            for values in (chances, truth)
        )
        share = share.clip(_LEAST, 1 - _LEAST)
        losses = -(whole * np.log(share) + (1 - whole) * np.log(1 - share))
    return np.asarray((losses * known).sum(axis=1) / known.sum(axis=1).clip(1))


class Chosen(AbstractLearner):
    """Fits the one of several learners that predicts held-out touches best.

    Args:
        members: name -> a learner for few touches, without its seed.
        folds: number of parts, each of which is held out once.
        seed: of the folds and the learners.

    Attributes:
        losses: member -> its mean loss on held-out touches, known after ``fit``.

    Raises:
        InputError: no member.
    """

    def __init__(
        self,
        members: Mapping[str, Callable[..., AbstractFew]],
        folds: Annotated[int, Ge(2)] = 5,
        seed: int = 0,
    ) -> None:
        if not members:
            raise InputError("learner=chosen has no member: give learner.members.kernel_ridge, for example")
        self._members, self._folds, self._seed = dict(members), folds, seed
        self._learner: AbstractFew | None = None

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Compare the members on held-out parts of training and validation split; fit the best to all."""
        began = time.perf_counter()
        matrix, labels = join_splits(data)
        fold = split_folds(torch.from_numpy(labels), self._folds, self._seed).numpy()
        self.losses = dict[str, float]()
        for name, make in self._members.items():
            maker = partial(make, seed=self._seed)
            held = predict_held_out(maker, matrix, labels, data.task, fold)
            self.losses[name] = float(touch_losses(held, labels, data.task).mean())
        self._name = min(self.losses, key=lambda name: self.losses[name])
        words = ", ".join(f"{name} {loss:.4f}" for name, loss in self.losses.items())
        print(f"held-out loss: {words}: {self._name}", file=sys.stderr, flush=True)
        self._learner = self._members[self._name](seed=self._seed).learn(matrix, labels, data.task)
        self.parameters = self._learner.parameters
        self.seconds_per_epoch = time.perf_counter() - began

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probabilities of the chosen member, (B, L)."""
        if self._learner is None:
            raise RuntimeError("fit or load the learner first")
        return self._learner.probabilities(touches)

    def save(self, folder: Path) -> Path:
        """Write what the chosen member learned to ``folder/chosen/<name>``; return ``folder/chosen``."""
        if self._learner is None:
            raise RuntimeError("fit or load the learner first")
        whole = Path(folder) / "chosen"
        (whole / self._name).mkdir(parents=True)
        self._learner.save(whole / self._name)
        return whole

    def load(self, data: "FrameMaker", path: Path) -> None:
        """Load the folder that :meth:`save` wrote.

        Raises:
            ValueError: it holds no member.
        """
        names = [folder.name for folder in Path(path).iterdir()]
        if len(names) != 1 or names[0] not in self._members:
            raise ValueError(f"it holds none of {', '.join(self._members)}")
        (file,) = (Path(path) / names[0]).iterdir()
        learner = self._members[names[0]](seed=self._seed)
        learner.load(data, file)
        self._learner, self._name, self.parameters = learner, names[0], learner.parameters
