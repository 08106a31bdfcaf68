"""Train one peer in its own environment on exported touches, and answer every set with probabilities.

.venv-peers/bin/python experiments/peers/learn.py minirocket FOLDER

FOLDER is what `skin peers` exports: nothing of this project is imported here, Parquet is all that
comes in and goes out. Trees stop, and scores become probabilities, by the validation split; nothing else is
seen before the answers.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

LEARNT = ("train", "validation")
ALPHAS = np.logspace(-3, 6, 19)  # aeon stops at 1e3; leave-one-out asks for more here
CHUNK = 1000  # touches at a time: 54,000 features each
LIBRARIES = {
    "lightgbm": ("lightgbm",),
    "minirocket": ("aeon", "scikit-learn"),
    "multirocket_hydra": ("aeon", "scikit-learn", "torch"),
    "ridge": ("scikit-learn",),
}

Answer = Callable[[str], np.ndarray]  # of the name of a set


def load_readings(folder: Path, name: str) -> np.ndarray:
    """Return the readings of a set as aeon wants them, (B, S, T), float32, N; what is missing is 0."""
    table = pq.read_table(folder / "touches" / f"{name}.parquet")
    about = json.loads(table.schema.metadata[b"skin"])
    sensors = [key for key in table.column_names if key.startswith("reading_")]
    columns = [table[key].fill_null(0).to_numpy().astype(np.float32) for key in sensors]
    return np.stack([column.reshape(about["gestures"], about["frames"]) for column in columns], axis=1)


def load_features(folder: Path, name: str) -> np.ndarray:
    """Return the engineered features of a set, (B, D), float32."""
    table = pq.read_table(folder / "features" / f"{name}.parquet")
    return np.stack([column.to_numpy() for column in table.columns], axis=1)


def load_labels(folder: Path, name: str) -> dict[str, np.ndarray]:
    """Return label -> (B,), 0 or 1."""
    about = json.loads(pq.read_schema(folder / "touches" / f"{name}.parquet").metadata[b"skin"])
    table = pq.read_table(folder / "touches" / f"{name}.parquet", columns=about["task"]["names"])
    return {key: table[key].to_numpy()[:: about["frames"]].astype(int) for key in table.column_names}


def lightgbm(folder: Path, seed: int, jobs: int) -> tuple[Answer, float, int]:
    """Train gradient-boosted trees on the features, one ensemble per label, with early stopping."""
    from lightgbm import LGBMClassifier, early_stopping

    x, v = (load_features(folder, name) for name in LEARNT)
    truth, held = (load_labels(folder, name) for name in LEARNT)
    began, models = time.perf_counter(), []
    for label in truth:
        print(label, flush=True)
        model = LGBMClassifier(
            n_estimators=2000, learning_rate=0.05, random_state=seed, n_jobs=jobs, verbose=-1
        )
        stop = early_stopping(50, verbose=False)
        models.append(model.fit(x, truth[label], eval_X=v, eval_y=held[label], callbacks=[stop]))
    seconds = time.perf_counter() - began
    # one number per leaf
    trees = [tree for model in models for tree in model.booster_.dump_model()["tree_info"]]

    def answer(name: str) -> np.ndarray:
        table = load_features(folder, name)
        return np.stack([model.predict_proba(table)[:, 1] for model in models], axis=1)

    return answer, seconds, sum(tree["num_leaves"] for tree in trees)


def flat(jobs: int, seed: int) -> Pipeline:
    """Return a transform to the flattened readings, as a baseline for the convolution kernels."""
    return make_pipeline(FunctionTransformer(lambda x: x.reshape(len(x), -1)), StandardScaler())


def minirocket(jobs: int, seed: int) -> Pipeline:
    """Return the transform of aeon's MiniRocketClassifier (Dempster et al. 2021), scaled as there."""
    from aeon.transformations.collection.convolution_based import MiniRocket

    return make_pipeline(MiniRocket(n_jobs=jobs, random_state=seed), StandardScaler(with_mean=False))


def multirocket_hydra(jobs: int, seed: int) -> FeatureUnion:
    """Return the transform of aeon's MultiRocketHydraClassifier (Dempster et al. 2023), scaled as there."""
    from aeon.classification.convolution_based._hydra import _SparseScaler
    from aeon.transformations.collection.convolution_based import HydraTransformer, MultiRocket

    single = FunctionTransformer(partial(np.asarray, dtype=np.float32))
    hydra = HydraTransformer(n_jobs=jobs, random_state=seed), _SparseScaler()
    rocket = MultiRocket(n_jobs=jobs, random_state=seed), StandardScaler()
    return make_union(make_pipeline(*hydra, single), make_pipeline(*rocket, single))


def ridge(
    make: Callable[[int, int], Pipeline | FeatureUnion], folder: Path, seed: int, jobs: int
) -> tuple[Answer, float, int]:
    """Fit a ridge per label on transformed readings, each with the strength that leave-one-out likes best.

    What aeon's classifiers do (ridge on -1 and 1), but the kernels are computed once for all labels, and
    scores become probabilities by Platt's logistic curve through the validation split.
    """
    x, truth = load_readings(folder, "train"), load_labels(folder, "train")
    print("compiling", flush=True)
    make(jobs, seed).fit_transform(x[:32])
    print("learning", flush=True)
    began, transform = time.perf_counter(), make(jobs, seed)
    table = transform.fit_transform(x)
    targets = 2.0 * np.stack(list(truth.values()), axis=1) - 1
    model = RidgeCV(ALPHAS, alpha_per_target=True).fit(table, targets)
    del table

    def scores(name: str) -> np.ndarray:
        parts = load_readings(folder, name)
        return np.concatenate(
            [model.predict(transform.transform(parts[i : i + CHUNK])) for i in range(0, len(parts), CHUNK)]
        )

    held = load_labels(folder, "validation").values()
    curves = [platt(*pair) for pair in zip(scores("validation").T, held, strict=True)]
    seconds = time.perf_counter() - began

    def answer(name: str) -> np.ndarray:
        pairs = zip(scores(name).T, curves, strict=True)
        return np.stack([curve.predict_proba(column[:, None])[:, 1] for column, curve in pairs], axis=1)

    return answer, seconds, model.coef_.size + model.intercept_.size + 2 * len(curves)


def platt(score: np.ndarray, truth: np.ndarray) -> LogisticRegression:
    """Return the logistic curve through scores (B,), with Platt's targets: never quite 0 or 1."""
    positive = truth.sum()
    target = np.where(truth == 1, (positive + 1) / (positive + 2), 1 / (len(truth) - positive + 2))
    twice = np.concatenate([score, score])[:, None]
    sides = np.repeat([1, 0], len(score))
    return LogisticRegression(C=np.inf).fit(twice, sides, sample_weight=np.concatenate([target, 1 - target]))


PEERS: dict[str, Callable] = {
    "lightgbm": lightgbm,
    "minirocket": partial(ridge, minirocket),
    "multirocket_hydra": partial(ridge, multirocket_hydra),
    "ridge": partial(ridge, flat),
}


def main() -> None:
    """Train, answer every set, and write ``about.json`` when all answers lie there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    folder, out = arguments.folder, arguments.folder / arguments.peer
    out.mkdir(exist_ok=True)
    answer, seconds, parameters = PEERS[arguments.peer](folder, arguments.seed, arguments.jobs)
    sets = [name for name in json.loads((folder / "sets.json").read_text()) if name not in LEARNT]
    names = list(load_labels(folder, "train"))
    for name in sets:
        print(f"answering {name}", flush=True)
        chances = answer(name)
        pq.write_table(pa.table(dict(zip(names, chances.T, strict=True))), out / f"{name}.parquet")
    about = {
        "seconds": seconds,
        "parameters": int(parameters),
        "versions": {name: version(name) for name in LIBRARIES[arguments.peer]},
    }
    unfinished = out / "about.json.part"
    unfinished.write_text(json.dumps(about, indent=1) + "\n")
    unfinished.replace(out / "about.json")


if __name__ == "__main__":
    main()
