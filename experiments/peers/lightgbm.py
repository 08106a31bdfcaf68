"""LightGBM on engineered features."""

from typing import Annotated

import torch
from annotated_types import Ge, Gt
from torch import Tensor

from experiments.peers.base import AbstractPeer
from skin.recording import Touches
from skin.signal.features import engineered_features


class LightGBM(AbstractPeer):
    """Gradient-boosted trees of LightGBM on the features of :class:`skin.learner.boosted_trees.BoostedTrees`.

    Reference: G. Ke et al., LightGBM: a highly efficient gradient boosting decision tree, NeurIPS 2017.

    Args:
        rounds: maximum number of trees per label.
        learning_rate: shrinkage of each tree.
        leaves: maximum number of leaves of a tree.
        samples: minimum number of touches in a leaf.
        patience: number of trees without a lower validation loss before training stops.
        seed: of its random numbers.
    """

    def __init__(
        self,
        rounds: Annotated[int, Ge(1)] = 2000,
        learning_rate: Annotated[float, Gt(0)] = 0.05,
        leaves: Annotated[int, Ge(2)] = 31,
        samples: Annotated[int, Ge(1)] = 20,
        patience: Annotated[int, Ge(1)] = 50,
        seed: int = 0,
    ) -> None:
        settings = {"num_leaves": leaves, "min_child_samples": samples, "learning_rate": learning_rate}
        super().__init__("lightgbm", seed, n_estimators=rounds, patience=patience, **settings)

    def inputs(self, touches: Touches) -> Tensor:
        """Return the features, (B, D)."""
        return torch.stack([column.float() for column in engineered_features(touches).values()], dim=1)
