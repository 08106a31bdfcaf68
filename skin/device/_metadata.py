"""Metadata of simulated recordings."""

from typing import Any

import numpy as np
import torch

from skin import __version__
from skin.device.base import AbstractSimulated, Split
from skin.recording import Recording
from skin.summary import summarise
from skin.touch.stream import only_touches

_VERSIONS = {"skin": __version__, "torch": torch.__version__, "numpy": np.__version__}


def describe(
    device: AbstractSimulated, recording: Recording, split: Split | None, epoch: int
) -> dict[str, Any]:
    """Return how a recording was made, and a summary of its touches.

    Args:
        device: that made it.
        recording: the touches.
        split: None: the whole budget.
        epoch: of ``train``.
    """
    return {
        "source": "simulated",
        "simulator": type(device.model).__name__,
        "split": split or "budget",
        "epoch": epoch,
        "device_seed": device.seed,
        "data_seed": device.data_seed,
        "shapes": list(device.sampler.shapes.names),
        "summary": summarise(only_touches(recording), device.body),
        "versions": _VERSIONS,
    }
