"""What the studies of real recordings share: rows, presses, the choice of an estimator, and intervals."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le
from scipy.stats import binomtest
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.ensemble import BaggingRegressor, ExtraTreesRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GroupKFold, KFold
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from sklearn.svm import SVR

from skin.core.settings import checked

CHOICE = 2500  # presses at most for the choice of an estimator, which costs a fit per candidate and fold
KERNEL = 400  # presses at most for the length scales of a Gaussian process
EXACT = 5000  # presses at most in its covariance
FOLDS, RESAMPLES, LEVEL = 5, 1000, 0.95


@checked("real")
@dataclass(frozen=True)
class RealSettings:
    """RealSettings of the command line.

    Attributes:
        data: folder that holds ``eflesh`` and ``sdu_fsi``; absent recordings are named and left out.
        share: of the presses, or of the places of the pad.
        rows: beginnings of rows, separated by commas; empty: all.
        seed: of draws, folds and estimators.
        out: folder of the results.
    """

    data: str
    share: Annotated[float, Gt(0), Le(1)] = 1.0
    rows: str = ""
    seed: int = 0
    out: str = "results"


@dataclass(frozen=True)
class Presses:
    """Presses of a robot, in order of time.

    Attributes:
        inputs: name of the inputs -> values (N, K).
        targets: (N, D), mm or N.
        session: number of the session, (N,).
        place: number of the pressed place, (N,).
    """

    inputs: Mapping[str, np.ndarray]
    targets: np.ndarray
    session: np.ndarray
    place: np.ndarray

    def __len__(self) -> int:
        return len(self.targets)

    def __getitem__(self, index: np.ndarray) -> "Presses":
        inputs = {name: values[index] for name, values in self.inputs.items()}
        return Presses(inputs, self.targets[index], self.session[index], self.place[index])


@dataclass(frozen=True, kw_only=True)
class RealRow:
    """A comparison: train on some touches, test on others.

    Attributes:
        name: of the row.
        path: of the recording below the folder of the data.
        split: in words.
        unit: of the results.
        goal: to reach: an error, or an accuracy where ``higher``.
        read: returns what ``run`` needs.
        run: yields the results.
        mapping: of ``conf/mapping``.
        targets: parameters of the recording.
        factor: from SI units to those of the target.
        higher: whether higher values are better.
        over: what intervals resample.
    """

    name: str
    path: str
    split: str
    unit: str
    goal: float | None
    read: Callable[["RealRow", Path, RealSettings], Any] = field(repr=False)
    run: Callable[["RealRow", Any, RealSettings], Iterator[dict[str, Any]]] = field(repr=False)
    mapping: str = ""
    targets: tuple[str, ...] = ()
    factor: float = 1.0
    higher: bool = False
    over: str = "places"


class SubsetProcess(RegressorMixin, BaseEstimator):
    """Gaussian process with length scales of few presses and a posterior of many.

    Parameters:
        seed: of the choice of the presses.
    """

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed

    def fit(self, x: np.ndarray, y: np.ndarray) -> "SubsetProcess":
        """Fit inputs (N, K) and scaled targets (N, D)."""
        order = np.random.default_rng(self.seed).permutation(len(x))
        kernel = ConstantKernel(1.0) * RBF(np.full(x.shape[1], 3.0), (0.1, 1e3)) + WhiteKernel(
            0.01, (1e-6, 1.0)
        )
        few, many = order[:KERNEL], order[:EXACT]
        scales = GaussianProcessRegressor(kernel, random_state=self.seed).fit(x[few], y[few]).kernel_
        self.process_ = GaussianProcessRegressor(scales, optimizer=None).fit(x[many], y[many])
        return self

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the mean, (N, D)."""
        return np.asarray(self.process_.predict(x))


def estimators(outputs: int, seed: int) -> dict[str, BaseEstimator]:
    """Return the estimators of the choice, for scaled inputs and a number of scaled targets."""
    network = MLPRegressor(hidden_layer_sizes=(64, 64), alpha=0.01, max_iter=300, early_stopping=True)
    svm = SVR(C=10.0, epsilon=0.02)
    return {
        "ridge": make_pipeline(PolynomialFeatures(2, include_bias=False), RidgeCV(np.logspace(-2, 4, 13))),
        "svm": MultiOutputRegressor(svm) if outputs > 1 else svm,
        "gaussian process": SubsetProcess(seed),
        "extra trees": ExtraTreesRegressor(200, min_samples_leaf=2, random_state=seed),
        "networks": BaggingRegressor(network, 5, bootstrap=False, random_state=seed),
    }


def pair_estimators(presses: Presses, seed: int) -> dict[tuple[str, str], BaseEstimator]:
    """Return estimators by (inputs, estimator); engineered features go to SVM and trees."""
    pairs = {}
    for inputs in presses.inputs:
        for name, estimator in estimators(presses.targets.shape[1], seed).items():
            if inputs != "features" or name in ("svm", "extra trees"):
                scaled = make_pipeline(StandardScaler(), clone(estimator))
                pairs[inputs, name] = TransformedTargetRegressor(scaled, transformer=StandardScaler())
    return pairs


def predict(pair: tuple[str, str], training: Presses, test: Presses, seed: int) -> np.ndarray:
    """Return the predicted targets of the test presses, (N, D)."""
    estimator = pair_estimators(training, seed)[pair]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the choice judges what has not converged
        targets = training.targets
        estimator.fit(training.inputs[pair[0]], targets if targets.shape[1] > 1 else targets[:, 0])
    return np.asarray(estimator.predict(test.inputs[pair[0]])).reshape(len(test), -1)


def square_errors(predicted: np.ndarray, presses: Presses) -> np.ndarray:
    """Return the squared distance from the target, (N,)."""
    return np.asarray(np.square(predicted - presses.targets).sum(axis=1))


def choose(training: Presses, seed: int, by_place: bool) -> tuple[str, str]:
    """Return (inputs, estimator) with the least error in cross-validation on the training presses.

    Held out are places, else sessions, else blocks of time.
    """
    groups = training.place if by_place else training.session
    thin = _thin(groups if by_place else np.arange(len(groups)), seed)
    training, groups = training[thin], groups[thin]
    if by_place:
        folds = list(GroupKFold(FOLDS, shuffle=True, random_state=seed).split(groups, groups=groups))
    elif len(set(groups)) > 1:
        folds = list(GroupKFold(len(set(groups))).split(groups, groups=groups))
    else:
        folds = list(KFold(FOLDS).split(groups))
    errors = {}
    for pair in pair_estimators(training, seed):
        parts = (
            square_errors(predict(pair, training[fit], training[held], seed), training[held])
            for fit, held in folds
        )
        errors[pair] = float(np.sqrt(np.concatenate(list(parts)).mean()))
    return min(errors, key=lambda pair: errors[pair])


def _thin(units: np.ndarray, seed: int) -> np.ndarray:
    """Return the sorted index of whole units with ``CHOICE`` presses at most, as far as folds allow."""
    names = np.random.default_rng([seed, 3]).permutation(np.unique(units))
    count = max(FOLDS, int(len(names) * min(1.0, CHOICE / len(units))))
    return np.flatnonzero(np.isin(units, names[:count]))


def interval(squares: np.ndarray, units: np.ndarray, seed: int) -> tuple[float, float]:
    """Return the interval of the rms error, resampling whole units (N,), such as places."""
    _, number = np.unique(units, return_inverse=True)
    sums, counts = np.bincount(number, squares), np.bincount(number)
    draw = np.random.default_rng([seed, 4]).integers(len(sums), size=(RESAMPLES, len(sums)))
    values = np.sqrt(sums[draw].sum(axis=1) / counts[draw].sum(axis=1))
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def exact_interval(count: int, total: int) -> tuple[float, float]:
    """Return the interval of a share (Clopper and Pearson)."""
    exact = binomtest(count, total).proportion_ci(LEVEL)
    return float(exact.low), float(exact.high)


def spread(values: "np.ndarray | list[float]") -> tuple[float, float]:
    """Return the range of the middle 95 % of values."""
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def result_line(row: RealRow, training: int | str, test: int, pair: str, **values: Any) -> dict[str, Any]:
    """Return a line of the results; keyword arguments are the metric, its value and its interval."""
    start = {"row": row.name, "split": row.split, "training": training, "test": test, "estimator": pair}
    goal = "" if row.goal is None else row.goal
    better = row.goal is not None and (
        values["value"] >= row.goal if row.higher else values["value"] <= row.goal
    )
    reached = "" if row.goal is None else ("yes" if better else "no")
    return start | {"unit": row.unit} | values | {"goal": goal, "reached": reached}
