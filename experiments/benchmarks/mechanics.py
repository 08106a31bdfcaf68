"""How long the finite-element skin takes to build, and its peers to answer one frame."""

import numpy as np
from scipy.sparse.linalg import splu

from benchmarks.setting import configuration, seconds
from skin.build import build_device
from skin.device.simulated import Simulated
from skin.simulator import _pynite
from skin.simulator._assembly import Structure
from skin.simulator._operator import build
from skin.simulator.naive import Naive

__all__ = ["build_seconds", "direct_seconds_per_frame", "pynite_seconds_per_frame"]

FRAMES = 20  # of the direct solve


def build_seconds(repeats: int) -> dict[str, float]:
    """Return how long each simulator takes to build with nothing cached, s (median)."""
    device = _device()
    structure = Structure(device.body)
    return {
        "naive": seconds(lambda: Naive(device.body, device.sensors), repeats),
        "fem": seconds(lambda: build(structure, device.sensors), repeats),
    }


def direct_seconds_per_frame(gestures_frames: int, repeats: int) -> float:
    """Return the seconds per frame of one factorisation and a solve for every frame of a data set.

    Args:
        gestures_frames: over how many frames the factorisation is shared.
        repeats: of which the median counts.
    """
    structure = Structure(_device().body)
    load = structure.load()
    pressures = _pressures()

    def factorise():
        return splu(
            structure.stiffness(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    factors = factorise()
    solving = seconds(lambda: [factors.solve(load @ frame) for frame in pressures], repeats) / len(pressures)
    return solving + seconds(factorise, repeats) / gestures_frames


def pynite_seconds_per_frame(repeats: int) -> float:
    """Return PyNite's seconds per load case on the same mesh (median); building its model is not counted."""
    structure = Structure(_device().body)
    frame = _pressures()[0].reshape(structure.body.shape)
    models = iter([_pynite.model(structure, frame) for _ in range(repeats + 1)])
    return seconds(lambda: _pynite.solve(next(models)), repeats)


def _device() -> Simulated:
    device = build_device(configuration("simulator=fem"))
    assert isinstance(device, Simulated)
    return device


def _pressures() -> np.ndarray:
    """Return frames of sampled gestures, (FRAMES, H*W), Pa."""
    movie = _device().sampler.sample(FRAMES, np.random.default_rng(0))
    return movie.frames[:FRAMES].flatten(1).double().numpy()
