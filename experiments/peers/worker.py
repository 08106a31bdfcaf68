"""Fit and apply a model of another library, in the environment of that library.

Reads requests from standard input, one JSON object per line, and answers each with a line of JSON:

- ``{"do": "fit", "path": ..., "library": ..., "seed": ..., "jobs": ..., settings}`` fits a model to the
  arrays ``train``, ``train_labels``, ``validation`` and ``validation_labels`` of an .npz file.
- ``{"do": "load", "path": ..., ...}`` with the same settings restores the model that
  ``{"do": "save", "path": ...}`` wrote as an .npz file.
- ``{"do": "predict", "path": ..., "to": ...}`` reads inputs (B, ...) from an .npy file and writes
  probabilities (B, L).

The answer to ``fit`` and ``load`` has the keys ``seconds``, ``parameters``, ``shape`` (of one input) and
``labels`` (their number); the answer to a request that fails has the key ``error``.

This script imports nothing of this project. Early stopping, the strength of the ridge on large data, and the
conversion of scores to probabilities use the validation split.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any, Protocol

import numpy as np
from scipy.linalg import solve
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

ALPHAS = np.logspace(-3, 6, 19)  # aeon stops at 1e3, but stronger ridges are selected here
FEW_ALPHAS = np.logspace(0, 6, 7)  # each takes a factorisation of D x D
CHUNK = 1024  # touches that are transformed at a time: 54,000 features each
FIRST = 4096  # touches that kernels and scales are fitted to; they are stored with the model

LEARNT = ("train", "validation")

Arrays = dict[str, np.ndarray]


class Model(Protocol):
    """A model of another library.

    Attributes:
        parameters: number of fitted parameters.
        shape: of one input.
        labels: L.
    """

    parameters: int
    shape: tuple[int, ...]
    labels: int

    def fit(self, data: Arrays) -> float:
        """Fit to the arrays of a request and return the duration, s."""

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L)."""

    def arrays(self) -> Arrays:
        """Return the fitted model as arrays of numbers."""

    def restore(self, arrays: Arrays) -> None:
        """Restore the model that :meth:`arrays` returned."""


class LightGBM:
    """Gradient-boosted trees of LightGBM, one ensemble per label, with early stopping.

    Inputs are features (B, D). Arrays of a model: ``<label>``, the text format of LightGBM as bytes.
    """

    def __init__(self, seed: int, jobs: int, patience: int, **settings: float) -> None:
        self.patience = patience
        self.settings = {"random_state": seed, "n_jobs": jobs, "verbose": -1, **settings}

    def fit(self, data: Arrays) -> float:
        """Grow trees until the validation loss has not improved for ``patience`` trees."""
        from lightgbm import LGBMClassifier, early_stopping

        began, self.trees = time.perf_counter(), []
        for truth, held in zip(*(data[f"{split}_labels"].T.copy() for split in LEARNT), strict=True):
            model = LGBMClassifier(**self.settings)
            stop = [early_stopping(self.patience, verbose=False)]
            model.fit(data["train"], truth, eval_X=data["validation"], eval_y=held, callbacks=stop)
            self.trees.append(model.booster_)
        return time.perf_counter() - began

    @property
    def parameters(self) -> int:
        """Number of leaves."""
        return sum(tree["num_leaves"] for model in self.trees for tree in model.dump_model()["tree_info"])

    @property
    def shape(self) -> tuple[int]:
        """(D,)."""
        return (self.trees[0].num_feature(),)

    @property
    def labels(self) -> int:
        """L."""
        return len(self.trees)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L)."""
        return np.stack(
            [model.predict(x, num_threads=self.settings["n_jobs"]) for model in self.trees], axis=1
        )

    def arrays(self) -> Arrays:
        """Return the text of each ensemble as bytes."""
        texts = (model.model_to_string() for model in self.trees)
        return {str(label): np.frombuffer(text.encode(), np.uint8) for label, text in enumerate(texts)}

    def restore(self, arrays: Arrays) -> None:
        """Read each ensemble from its text."""
        from lightgbm import Booster

        texts = (arrays[str(label)].tobytes().decode() for label in range(len(arrays)))
        self.trees = [Booster(model_str=text) for text in texts]


class Rocket:
    """Convolution kernels of aeon and a ridge per label, as aeon's classifiers combine them.

    The kernels are computed once for all labels, the ridge may be stronger than aeon's, and Platt's logistic
    curve on the validation split converts scores to probabilities. Kernels, biases and scales are fitted to
    the first 4096 touches; the arrays of a model contain these touches, so that the same kernels are fitted
    again from the seed. Inputs are series (B, C, T), N.
    """

    def __init__(self, seed: int, jobs: int, kernels: int | None, transform: str) -> None:
        self.make = partial(
            TRANSFORMS[transform], jobs, seed, {} if kernels is None else {"n_kernels": kernels}
        )

    def fit(self, data: Arrays) -> float:
        """Fit kernels, ridges and logistic curves; compilation is not part of the duration."""
        x, held = data["train"], data["validation_labels"]
        self.make().fit_transform(x[:32])
        began, self.first = time.perf_counter(), x[:FIRST]
        self.transform = self.make().fit(self.first)
        truth, outside = 2 * data["train_labels"] - 1, 2 * held - 1
        if len(x) <= self.transform.transform(x[:2]).shape[1]:
            table = np.concatenate(list(self._parts(x)))
            ridge = RidgeCV(ALPHAS, alpha_per_target=True).fit(table, truth)
            self.weights, self.bias = ridge.coef_.T, ridge.intercept_
        else:
            pairs = zip(self._parts(x), np.split(truth, range(CHUNK, len(x), CHUNK)), strict=True)
            validation = np.concatenate(list(self._parts(data["validation"])))
            self.weights, self.bias = normal_equations(pairs, validation, outside)
        self.curves = np.array(
            [platt(*pair) for pair in zip(self._scores(data["validation"]).T, held.T, strict=True)]
        )
        return time.perf_counter() - began

    @property
    def parameters(self) -> int:
        """Number of weights of the ridges and of the logistic curves."""
        return self.weights.size + self.bias.size + self.curves.size

    @property
    def shape(self) -> tuple[int, ...]:
        """(C, T)."""
        return self.first.shape[1:]

    @property
    def labels(self) -> int:
        """L."""
        return len(self.bias)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L)."""
        slope, offset = self.curves.T
        return 1 / (1 + np.exp(-(slope * self._scores(x) + offset)))

    def arrays(self) -> Arrays:
        """Return what :meth:`restore` needs."""
        return {"first": self.first, "weights": self.weights, "bias": self.bias, "curves": self.curves}

    def restore(self, arrays: Arrays) -> None:
        """Fit the kernels again and set the weights."""
        self.first, self.weights, self.bias, self.curves = (
            arrays[name] for name in ("first", "weights", "bias", "curves")
        )
        self.transform = self.make().fit(self.first)

    def _parts(self, x: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the features of touches, (b, D), in parts."""
        for start in range(0, len(x), CHUNK):
            yield self.transform.transform(x[start : start + CHUNK])

    def _scores(self, x: np.ndarray) -> np.ndarray:
        return np.concatenate([part @ self.weights + self.bias for part in self._parts(x)])


def normal_equations(
    parts: Iterator[tuple[np.ndarray, np.ndarray]], validation: np.ndarray, held: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (D, L) and biases (L,) of ridges, from any number of touches in the memory of D x D.

    Args:
        parts: features (b, D) and targets (b, L); the features are read once.
        validation: features (B, D).
        held: targets (B, L); of each label, the strength with the smallest squared error on them is used.
    """
    width, labels = validation.shape[1], held.shape[1]
    count, gram, cross = 0, np.zeros((width, width)), np.zeros((width, labels))
    total, mean = np.zeros(labels), np.zeros(width)
    for table, truth in parts:
        # float32 is precise enough for the products of one part, and not for their sum over all parts.
        gram += table.T @ table
        cross += table.T.astype(float) @ truth
        count, total, mean = count + len(table), total + truth.sum(0), mean + table.sum(0, dtype=float)
    total, mean = total / count, mean / count
    gram -= count * np.outer(mean, mean)
    cross -= count * np.outer(mean, total)
    best, least = np.zeros_like(cross), np.full(len(total), np.inf)
    diagonal = np.einsum("ii->i", gram)
    plain = diagonal.copy()
    for alpha in FEW_ALPHAS:
        diagonal[:] = plain + alpha
        weights = solve(gram, cross, assume_a="pos")
        errors = np.square(validation @ weights.astype(np.float32) + total - mean @ weights - held).mean(0)
        better = errors < least
        best[:, better], least[better] = weights[:, better], errors[better]
    return best, total - mean @ best


def platt(score: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return slope and offset of the logistic curve through scores (B,), with the targets of Platt (1999)."""
    positive = truth.sum()
    target = np.where(truth == 1, (positive + 1) / (positive + 2), 1 / (len(truth) - positive + 2))
    twice = np.concatenate([score, score])[:, None]
    sides = np.repeat([1, 0], len(score))
    curve = LogisticRegression(C=np.inf).fit(twice, sides, sample_weight=np.concatenate([target, 1 - target]))
    return curve.coef_.item(), curve.intercept_.item()


def flat(jobs: int, seed: int, settings: dict[str, int]) -> Pipeline:
    """Return a transform to the flattened readings, a baseline for the convolution kernels."""
    return make_pipeline(FunctionTransformer(lambda x: x.reshape(len(x), -1)), StandardScaler())


def minirocket(jobs: int, seed: int, settings: dict[str, int]) -> Pipeline:
    """Return the transform of aeon's MiniRocketClassifier (Dempster et al. 2021), with its scaling."""
    from aeon.transformations.collection.convolution_based import MiniRocket

    return make_pipeline(
        MiniRocket(n_jobs=jobs, random_state=seed, **settings), StandardScaler(with_mean=False)
    )


def multirocket(jobs: int, seed: int, settings: dict[str, int]) -> Pipeline:
    """Return the transform of aeon's MultiRocketClassifier (Tan et al. 2022), with its scaling."""
    from aeon.transformations.collection.convolution_based import MultiRocket

    single = FunctionTransformer(partial(np.asarray, dtype=np.float32))
    return make_pipeline(MultiRocket(n_jobs=jobs, random_state=seed, **settings), StandardScaler(), single)


def multirocket_hydra(jobs: int, seed: int, settings: dict[str, int]) -> FeatureUnion:
    """Return the transform of aeon's MultiRocketHydraClassifier (Dempster et al. 2023), with its scaling."""
    from aeon.classification.convolution_based._hydra import _SparseScaler
    from aeon.transformations.collection.convolution_based import HydraTransformer

    single = FunctionTransformer(partial(np.asarray, dtype=np.float32))
    hydra = HydraTransformer(n_jobs=jobs, random_state=seed), _SparseScaler(), single
    return make_union(make_pipeline(*hydra), multirocket(jobs, seed, settings))


TRANSFORMS = {
    "flat": flat,
    "minirocket": minirocket,
    "multirocket": multirocket,
    "multirocket_hydra": multirocket_hydra,
}
LIBRARIES = {"lightgbm": LightGBM, "aeon": Rocket}


class Session:
    """Answers requests on one model."""

    model: Model

    def fit(self, path: str, library: str, **settings: Any) -> dict[str, Any]:
        """Fit a model and describe it."""
        self.model = LIBRARIES[library](**settings)
        return self._described(self.model.fit(load_arrays(path)))

    def load(self, path: str, library: str, **settings: Any) -> dict[str, Any]:
        """Restore a model and describe it."""
        self.model = LIBRARIES[library](**settings)
        self.model.restore(load_arrays(path))
        return self._described(0.0)

    def save(self, path: str) -> dict[str, Any]:
        """Write the model."""
        np.savez_compressed(path, **self.model.arrays())  # type: ignore[arg-type]
        return {}

    def predict(self, path: str, to: str) -> dict[str, Any]:
        """Write the probabilities of the labels of touches."""
        np.save(to, self.model.predict(np.load(path, allow_pickle=False)))
        return {}

    def _described(self, seconds: float) -> dict[str, Any]:
        model = self.model
        parameters = int(model.parameters)
        return {"seconds": seconds, "parameters": parameters, "shape": model.shape, "labels": model.labels}


def load_arrays(path: str) -> Arrays:
    """Return the arrays of an .npz file."""
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def main() -> None:
    """Answer requests until standard input ends."""
    # What libraries print must not be read as an answer.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    session = Session()
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = getattr(session, request.pop("do"))(**request)
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
