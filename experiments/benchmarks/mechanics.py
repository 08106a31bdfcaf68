"""Time per frame of other solvers for the finite-element skins."""

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU

from experiments.benchmarks.harness import median_seconds, training_config
from skin.build import build_device
from skin.device.base import AbstractSimulated
from skin.simulator import _pynite
from skin.simulator._assembly import Structure
from skin.simulator._factors import factorised
from skin.simulator.solid import hexahedra

FRAMES = 20  # of the direct solve


def direct_seconds_per_frame(simulator: str, gestures_frames: int, repeats: int) -> float:
    """Return the seconds per frame of one factorisation and a solve for every frame of a data set.

    Args:
        simulator: ``fem``, or ``solid``: scikit-fem's elements without an operator.
        gestures_frames: number of frames that share the factorisation.
        repeats: number of repetitions; the median is returned.
    """
    stiffness, load = _system(simulator)
    pressures = _pressures()

    def factorise() -> SuperLU:
        return factorised(stiffness())

    factors = factorise()
    solving = median_seconds(lambda: [factors.solve(load @ frame) for frame in pressures], repeats) / len(
        pressures
    )
    return solving + median_seconds(factorise, repeats) / gestures_frames


def _system(simulator: str) -> tuple[Callable[[], csc_matrix], csc_matrix]:
    """Return a function that assembles the stiffness of the default skin, and the loads of its cells."""
    if simulator == "fem":
        structure = Structure(_device().body)
        return structure.stiffness, structure.load()
    settings = training_config("simulator=solid").simulator
    mesh = hexahedra(_device().body, settings.divisions, settings.poisson)
    free = ~mesh.held
    return lambda: mesh.stiffness()[free][:, free].tocsc(), mesh.loads(2)[free]


def pynite_seconds_per_frame(repeats: int) -> float | None:
    """Return PyNite's seconds per load case on the same mesh (median); building its model is not counted.

    None where PyNite, a development dependency, is not installed.
    """
    if find_spec("Pynite") is None:
        return None
    structure = Structure(_device().body)
    frame = _pressures()[0].reshape(structure.body.shape)
    models = iter([_pynite.model(structure, frame) for _ in range(repeats + 1)])
    return median_seconds(lambda: _pynite.solve(next(models)), repeats)


def _device() -> AbstractSimulated:
    return build_device(training_config("simulator=fem")).simulated("mechanics are simulated")


def _pressures() -> np.ndarray:
    """Return frames of sampled gestures, (FRAMES, H*W), Pa."""
    movie = _device().sampler.sample(FRAMES, np.random.default_rng(0))
    return movie.frames[:FRAMES].flatten(1).double().numpy()
