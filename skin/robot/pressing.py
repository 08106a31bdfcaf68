"""Objects that something else moves, such as a simulator of robots: their shape and force are given."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody
from skin.core.settings import option_name
from skin.mechanics.contact.rigid import solve_contact, surface_compliance
from skin.mechanics.simulator.base import AbstractSimulator


class Press(NamedTuple):
    """How a rigid object presses on a skin.

    Attributes:
        gap: (H * W,), m, from each cell to the object, up to a constant; infinite where there is none.
        force: (3,), N, along x and y of the chart, and into the skin.
    """

    gap: np.ndarray
    force: np.ndarray


class Pressing:
    """Pressure and readings of presses on a skin.

    Args:
        simulator: of the skin.
        body: the skin.

    Raises:
        InputError: the simulator has no compliance.
    """

    def __init__(self, simulator: AbstractSimulator, body: AbstractBody) -> None:
        self.simulator, self._body = simulator, body
        self.compliance = surface_compliance(simulator, body)
        if not simulator.feels_shear:
            name = option_name(simulator)
            warnings.warn(f"simulator={name} has normal forces only: friction is left out", stacklevel=3)

    def pressures(self, presses: Sequence[Press]) -> Tensor:
        """Return the pressure of each press alone, (P, H, W), Pa; its sum is the force into the skin."""
        pressure = torch.zeros(len(presses), len(self.compliance))
        if presses:
            gaps = np.stack([press.gap for press in presses])
            near = np.flatnonzero(np.isfinite(gaps).any(axis=0))
            totals = np.array([press.force[2] for press in presses]) / np.prod(self._body.cell)
            compliance = self.compliance[near[:, None], near]
            start = _sink(gaps[:, near], totals * float(compliance.diagonal().mean()))
            gap, total, begin = (torch.from_numpy(values) for values in (gaps[:, near], totals, start))
            solved = solve_contact(compliance, gap, total, begin, iterations=1000)
            pressure[:, near] = solved.pressure
        return pressure.unflatten(1, self._body.shape)

    @torch.no_grad()
    def frames(self, presses: Sequence[Press], numbers: Sequence[int], count: int) -> tuple[Tensor, Tensor]:
        """Return the pressure (F, H, W), Pa, and the readings (F, S), N, of frames; presses add up.

        Friction is a shear in proportion to the pressure, if the simulator feels it.

        Args:
            presses: P of them.
            numbers: (P,), the frame of each.
            count: F, number of frames.
        """
        pressures, index = self.pressures(presses), torch.tensor(numbers, dtype=torch.long)
        forces = torch.from_numpy(np.array([press.force for press in presses]).reshape(-1, 3))
        shear = forces[:, :2] / forces[:, 2:] if self.simulator.feels_shear else None
        readings = self.simulator(pressures, shear).readings
        total, read = (values.new_zeros(count, *values.shape[1:]) for values in (pressures, readings))
        return total.index_add(0, index, pressures), read.index_add(0, index, readings)


def _sink(gap: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Return the depths (P, N), m, to which cells sink that are springs of their own; they sum to ``total``.

    From this pressure, up to a factor, the solution of a round object is found in half the iterations.

    Args:
        gap: (P, N), m; infinite where there is no object.
        total: (P,), m.
    """
    rise = np.sort(gap, axis=1)
    level = (total[:, None] + np.cumsum(rise, axis=1)) / np.arange(1, gap.shape[1] + 1)
    count = ((level >= rise) & np.isfinite(rise)).sum(axis=1, keepdims=True)
    return np.clip(np.take_along_axis(level, count - 1, axis=1) - gap, 0, None)
