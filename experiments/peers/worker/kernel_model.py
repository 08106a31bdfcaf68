"""Convolution kernels of aeon and a ridge."""

import time
from collections.abc import Iterator
from functools import partial

import numpy as np
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from experiments.peers.worker.ridge import normal_equations, platt

ALPHAS = np.logspace(-3, 6, 19)  # aeon stops at 1e3, but stronger ridges are selected here
CHUNK = 1024  # touches that are transformed at a time: 54,000 features each
FIRST = 4096  # touches that kernels and scales are fitted to; they are stored with the model


class KernelModel:
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

    def fit(self, data: dict[str, np.ndarray]) -> float:
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

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what :meth:`restore` needs."""
        return {"first": self.first, "weights": self.weights, "bias": self.bias, "curves": self.curves}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
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
