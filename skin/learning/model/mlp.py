"""A plain multi-layer perceptron on the readings."""

from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

from torch import Tensor, nn

from skin.errors import InputError
from skin.learning.model.base import AbstractModel, Kind
from skin.learning.model.base import activation as activation_of


class Mlp(AbstractModel):
    """Dense layers on the vector of readings, for one layout only.

    Args:
        kind: must be ``readings``.
        shape: (F,).
        widths: of the layers; the last one is the embedding. Empty: the readings are the embedding, for a
            recurrent head of ``fusion=late``.
        activation: relu, elu or silu, after every layer.
    """

    takes: ClassVar[Kind] = "readings"

    def __init__(
        self, kind: Kind, shape: Sequence[int], widths: Sequence[int] = (64, 64), activation: str = "relu"
    ) -> None:
        super().__init__(kind)
        sizes = [*shape, *widths]
        self.layers = nn.Sequential(
            *(layer for pair in pairwise(sizes) for layer in (nn.Linear(*pair), activation_of(activation)))
        )
        self.inputs, self.width = sizes[0], sizes[-1]

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of readings (N, F).

        Raises:
            InputError: the number of readings does not fit the weights.
        """
        if x.shape[-1] != self.inputs:
            raise InputError(
                f"model=mlp is made for {self.inputs} readings per frame, got {x.shape[-1]}: "
                "train with representation=graph or image, which accept other layouts"
            )
        return self.layers(x)
