"""Random convolution kernels of aeon and a ridge."""

from typing import Annotated, Literal

import torch
from annotated_types import Ge
from torch import Tensor

from experiments.peers.base import AbstractPeer
from skin.recording import Touches
from skin.signal.features import above_idle


class Rocket(AbstractPeer):
    """Convolution kernels on the series of readings, and a ridge per label.

    References: A. Dempster et al., MiniRocket, KDD 2021; C. W. Tan et al., MultiRocket, Data Mining and
    Knowledge Discovery 2022; A. Dempster et al., Hydra, ibid. 2023.

    Args:
        transform: the kernels; ``flat`` are the readings themselves.
        kernels: their number; None: aeon's default.
        channels: ``readings`` of each sensor; or ``sorted``: the readings above idle, from the largest to the
            smallest of each frame, and their sum, which allows any number of sensors.
        largest: number of sorted readings.
        seed: of the kernels.
    """

    def __init__(
        self,
        transform: Literal["flat", "minirocket", "multirocket", "multirocket_hydra"] = "minirocket",
        kernels: Annotated[int, Ge(84)] | None = None,
        channels: Literal["readings", "sorted"] = "readings",
        largest: Annotated[int, Ge(1)] = 10,
        seed: int = 0,
    ) -> None:
        super().__init__("aeon", seed, transform=transform, kernels=kernels)
        self._channels, self._largest = channels, largest

    def inputs(self, touches: Touches) -> Tensor:
        """Return the channels, (B, C, T), N."""
        if self._channels == "readings":
            return touches.readings.where(touches.valid, 0.0).mT
        x = above_idle(touches)
        kept = x.sort(dim=2, descending=True).values[..., : self._largest]
        kept = torch.nn.functional.pad(kept, (0, self._largest - kept.shape[2]))
        return torch.cat([kept, x.sum(dim=2, keepdim=True)], dim=2).mT
