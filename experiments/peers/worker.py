"""Fit and apply a model of aeon, in the environment of that library: nothing of ``skin`` is imported here.

Reads requests from standard input, one JSON object per line, and answers each with a line of JSON:

- ``{"do": "fit", "path": ..., "model": settings}`` fits a model to the arrays ``train``, ``train_labels``,
  ``validation`` and ``validation_labels`` of an .npz file.
- ``{"do": "load", "path": ..., "model": settings}`` with the same settings restores the model that
  ``{"do": "save", "path": ...}`` wrote as an .npz file.
- ``{"do": "predict", "path": ..., "to": ...}`` reads inputs (B, ...) from an .npy file and writes
  probabilities (B, L).

The answer to ``fit`` and ``load`` has the keys ``seconds``, ``parameters``, ``shape`` (of one input) and
``labels`` (their number); the answer to a request that fails has the key ``error``.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

Arrays = dict[str, np.ndarray]

ALPHAS = np.logspace(-3, 6, 19)  # aeon stops at 1e3, but stronger ridges are selected here
CHUNK = 1024  # touches that are transformed at a time: 54,000 features each
STORED = ("first", "weights", "bias", "curves")
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

    def fit(self, path: str) -> dict[str, Any]:
        """Fit kernels, ridges and logistic curves, and describe the model.

        Compilation is not part of the duration.
        """
        data = _load_arrays(path)
        x, held = data["train"], data["validation_labels"]
        self.make().fit_transform(x[:32])
        began, self.first = time.perf_counter(), x[:FIRST]
        self.transform = self.make().fit(self.first)
        table = np.concatenate(list(self._parts(x)))
        ridge = RidgeCV(ALPHAS, alpha_per_target=True).fit(table, 2 * data["train_labels"] - 1)
        self.weights, self.bias = ridge.coef_.T, ridge.intercept_
        pairs = zip(self._scores(data["validation"]).T, held.T, strict=True)
        self.curves = np.array([platt(*pair) for pair in pairs])
        return self._describe(time.perf_counter() - began)

    def load(self, path: str) -> dict[str, Any]:
        """Fit the kernels again, set the weights, and describe the model."""
        arrays = _load_arrays(path)
        self.first, self.weights, self.bias, self.curves = (arrays[name] for name in STORED)
        self.transform = self.make().fit(self.first)
        return self._describe(0.0)

    def save(self, path: str) -> None:
        """Write what :meth:`load` needs."""
        np.savez_compressed(path, **{name: getattr(self, name) for name in STORED})

    def predict(self, path: str, to: str) -> None:
        """Write the probability of each label, (B, L), of series (B, C, T)."""
        slope, offset = self.curves.T
        scores = self._scores(np.load(path, allow_pickle=False))
        np.save(to, 1 / (1 + np.exp(-(slope * scores + offset))))

    def _describe(self, seconds: float) -> dict[str, Any]:
        parameters = self.weights.size + self.bias.size + self.curves.size
        shape = self.first.shape[1:]
        return {"seconds": seconds, "parameters": parameters, "shape": shape, "labels": len(self.bias)}

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


def platt(score: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return slope and offset of the logistic curve through scores (B,), with the targets of Platt (1999)."""
    positive = truth.sum()
    target = np.where(truth == 1, (positive + 1) / (positive + 2), 1 / (len(truth) - positive + 2))
    twice = np.concatenate([score, score])[:, None]
    sides = np.repeat([1, 0], len(score))
    curve = LogisticRegression(C=np.inf).fit(twice, sides, sample_weight=np.concatenate([target, 1 - target]))
    return curve.coef_.item(), curve.intercept_.item()


def _load_arrays(path: str) -> Arrays:
    """Return the arrays of an .npz file."""
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def main() -> None:
    """Answer requests until standard input ends."""
    # What libraries print must not be read as an answer.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    model: KernelModel | None = None
    for line in sys.stdin:
        request = json.loads(line)
        try:
            if settings := request.pop("model", None):
                model = KernelModel(**settings)
            answer = getattr(model, request.pop("do"))(**request) or {}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
