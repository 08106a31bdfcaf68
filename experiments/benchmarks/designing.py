"""How long the local precision of a skin and the placement of its sensors take."""

from functools import partial

import torch
from torch import Tensor

from experiments.benchmarks.harness import median_seconds, training_config
from skin.build import build_device
from skin.design.placement_problem import PlacementProblem
from skin.design.precision import LocalPrecision
from skin.design.readings import reading_covariance
from skin.device.base import AbstractSimulated
from skin.touch.fingertip import Fingertip

SENSORS, TOUCHES, DISTANCE = 25, 3000, 0.012  # m; defaults of `skin design design=place`
_STEPS = (1e-6, 1e-6, 1e-6, 1e-3)  # m, m, m, N


def measure_design(repeats: int) -> dict[str, float]:
    """Return seconds (medians) on the default sheet with ``simulator=solid``, and the share of the bound.

    ``bound_seconds`` is the time of the local precision, and ``bound_relative_to_differences`` its ratio to
    the time of central differences. ``place_share_of_bound`` is that of the upper bound of the information.
    """
    device = build_device(training_config("simulator=solid", "touch.over_sensors=false")).simulated("design")
    precision = LocalPrecision()
    seconds = median_seconds(lambda: precision.find(device.model, device.body), repeats)
    touches = precision.sample(device.body)
    differences = median_seconds(partial(_differences, device, precision.rim, touches), repeats)
    found: list[dict[str, float]] = []
    placing = median_seconds(lambda: found.append(_place(device)), repeats)
    return {
        "bound_seconds": seconds,
        "bound_relative_to_differences": seconds / differences,
        "place_seconds": placing,
        "place_share_of_bound": found[-1]["share_of_bound"],
    }


def _differences(device: AbstractSimulated, rim: float, touches: Tensor) -> None:
    """Compute the readings of touches and their derivatives by central differences."""
    fingertip = Fingertip(device.body, rim)
    for part in touches.split(64):
        for axis, step in enumerate(_STEPS):
            move = torch.zeros(4, dtype=torch.float64)
            move[axis] = step
            above, below = (device.model(fingertip(part + sign * move)).readings for sign in (1, -1))
            _ = (above - below) / (2 * step)


def _place(device: AbstractSimulated) -> dict[str, float]:
    problem = PlacementProblem.of(device, None, SENSORS, (), DISTANCE, None)
    clip, noise = device.imperfection.clip, float(device.constants.noise.median())
    covariance, _ = reading_covariance(device, problem.sensors, TOUCHES, 0, clip)
    return problem.solve(covariance / noise**2, 0)[1]
