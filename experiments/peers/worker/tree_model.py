"""Trees of LightGBM."""

import time

import numpy as np


class TreeModel:
    """Gradient-boosted trees of LightGBM, one ensemble per label, with early stopping.

    Inputs are features (B, D). Arrays of a model: ``<label>``, the text format of LightGBM as bytes.
    """

    def __init__(self, seed: int, jobs: int, patience: int, **settings: float) -> None:
        self.patience = patience
        self.settings = {"random_state": seed, "n_jobs": jobs, "verbose": -1, **settings}

    def fit(self, data: dict[str, np.ndarray]) -> float:
        """Grow trees until the validation loss has not improved for ``patience`` trees."""
        from lightgbm import LGBMClassifier, early_stopping

        began, self.trees = time.perf_counter(), []
        for truth, held in zip(
            *(data[f"{split}_labels"].T.copy() for split in ("train", "validation")), strict=True
        ):
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

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the text of each ensemble as bytes."""
        texts = (model.model_to_string() for model in self.trees)
        return {str(label): np.frombuffer(text.encode(), np.uint8) for label, text in enumerate(texts)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Read each ensemble from its text."""
        from lightgbm import Booster

        texts = (arrays[str(label)].tobytes().decode() for label in range(len(arrays)))
        self.trees = [Booster(model_str=text) for text in texts]
