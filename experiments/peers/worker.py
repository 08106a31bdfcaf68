"""Fit and apply a model of aeon, in the environment of that library: nothing of ``skin`` is imported here.

Reads requests from standard input and answers each on standard output, both as pickles: a request is the name
of a method of :class:`KernelModel` and its arguments, the answer what it returns, or a RuntimeError.
"""

import os
import pickle
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

STORED = ("first", "weights", "bias", "curves")


class KernelModel:
    """Convolution kernels of aeon and a ridge per label, as aeon's classifiers combine them.

    The kernels are computed once for all labels, the ridge may be stronger than aeon's, and Platt's logistic
    curve on the validation split converts scores to probabilities. Kernels, biases and scales are fitted to
    the first touches; the arrays of a model contain these touches, so that the same kernels are fitted again
    from the seed. Inputs are series (B, C, T), N.
    """

    first: np.ndarray
    weights: np.ndarray
    bias: np.ndarray
    curves: np.ndarray

    def begin(self, seed: int, jobs: int, transform: str) -> None:
        """Set the kernels."""
        self.make = partial(make_transform, transform, n_jobs=jobs, random_state=seed)

    def fit(
        self,
        x: np.ndarray,
        labels: np.ndarray,
        held: np.ndarray,
        held_labels: np.ndarray,
        maximum: int = 4096,
    ) -> float:
        """Fit kernels, to the first ``maximum`` touches, ridges and logistic curves; return the duration, s.

        Compilation is not part of the duration.
        """
        self.make().fit_transform(x[:32])
        began, self.first = time.perf_counter(), x[:maximum]
        self.transform = self.make().fit(self.first)
        table = np.concatenate(list(self._parts(x)))
        # aeon's strengths end at 1e3, but stronger ridges are selected here.
        ridge = RidgeCV(np.logspace(-3, 6, 19), alpha_per_target=True).fit(table, 2 * labels - 1)
        self.weights, self.bias = ridge.coef_.T, ridge.intercept_
        pairs = zip(self._scores(held).T, held_labels.T, strict=True)
        self.curves = np.array([platt(*pair) for pair in pairs])
        return time.perf_counter() - began

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what :meth:`load` needs."""
        return {name: getattr(self, name) for name in STORED}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        """Set the weights, and fit the kernels again."""
        for name in STORED:
            setattr(self, name, arrays[name])
        self.transform = self.make().fit(self.first)

    def describe(self) -> tuple[int, tuple[int, ...], int]:
        """Return the numbers of parameters, the shape of an input, and the number of labels."""
        parameters = self.weights.size + self.bias.size + self.curves.size
        return parameters, self.first.shape[1:], len(self.bias)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), of series (B, C, T)."""
        slope, offset = self.curves.T
        return 1 / (1 + np.exp(-(slope * self._scores(x) + offset)))

    def _parts(self, x: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the features of touches, (b, D), in parts: there are 54,000 features of each."""
        for start in range(0, len(x), 1024):
            yield self.transform.transform(x[start : start + 1024])

    def _scores(self, x: np.ndarray) -> np.ndarray:
        return np.concatenate([part @ self.weights + self.bias for part in self._parts(x)])


def make_transform(name: str, **settings: int) -> Pipeline | FeatureUnion:
    """Return the transform of one of aeon's classifiers, with its scaling.

    ``minirocket`` is Dempster et al. 2021, ``multirocket_hydra`` Dempster et al. 2023; ``flat`` gives the
    flattened readings, a baseline for the convolution kernels.
    """
    if name == "flat":
        return make_pipeline(FunctionTransformer(lambda x: x.reshape(len(x), -1)), StandardScaler())

    from aeon.classification.convolution_based._hydra import _SparseScaler
    from aeon.transformations.collection.convolution_based import HydraTransformer, MiniRocket, MultiRocket

    if name == "minirocket":
        return make_pipeline(MiniRocket(**settings), StandardScaler(with_mean=False))
    single = FunctionTransformer(partial(np.asarray, dtype=np.float32))
    hydra = make_pipeline(HydraTransformer(**settings), _SparseScaler(), single)
    return make_union(hydra, make_pipeline(MultiRocket(**settings), StandardScaler(), single))


def platt(score: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return slope and offset of the logistic curve through scores (B,), with the targets of Platt (1999)."""
    positive = truth.sum()
    target = np.where(truth == 1, (positive + 1) / (positive + 2), 1 / (len(truth) - positive + 2))
    twice = np.concatenate([score, score])[:, None]
    sides = np.repeat([1, 0], len(score))
    curve = LogisticRegression(C=np.inf).fit(twice, sides, sample_weight=np.concatenate([target, 1 - target]))
    return curve.coef_.item(), curve.intercept_.item()


def main() -> None:
    """Answer requests until standard input ends."""
    # What libraries print must not be read as an answer.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    model = KernelModel()
    while True:
        try:
            name, *values = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer: Any = getattr(model, name)(*values)
        except Exception as error:
            answer = RuntimeError(f"{type(error).__name__}: {error}")
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    main()
