"""Viscoelastic skins: elastic solutions at several rates, combined by first-order lags."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from skin.body.base import AbstractBody, Sensors
from skin.mechanics.simulator.base import AbstractSimulator, Response

# First-order lag, hysteresis and rounding of readings in time.


def first_order_lag(readings: Tensor, time_constant: Tensor, time: Tensor) -> Tensor:
    """Return readings (B, T, S) after a first-order lag that starts at rest.

    The result is exact for a force that is constant between frames. The difference decays by
    exp(-dt / time_constant).

    Args:
        readings: N.
        time_constant: s, broadcast with (B, S) or (B, 1, S); 0: none.
        time: of every frame, (T,), s.
    """
    constant = (time_constant[:, 0] if time_constant.ndim == 3 else time_constant).to(readings.dtype)
    steps = time.diff(prepend=2 * time[:1] - time[1:2]).to(readings.dtype)
    # A constant of 0 gives exp(-inf) = 0; the clamp avoids 0 / 0.
    decays = torch.exp(-steps.view(-1, 1, 1) / constant.clamp(min=1e-9))
    state, states = torch.zeros_like(readings[:, 0]), []
    for frame, decay in zip(readings.unbind(1), decays, strict=True):
        state = torch.lerp(frame, state, decay)
        states.append(state)
    return torch.stack(states, dim=1)


def running_peak(readings: Tensor) -> Tensor:
    """Return the largest magnitude of the reading since a sensor was last at rest, (B, T, S), N."""
    size, peaks = readings.abs(), []
    peak, rest = torch.zeros_like(size[:, 0]), ~(size > 0)
    for frame, resting in zip(size.unbind(1), rest.unbind(1), strict=True):
        peak = torch.maximum(peak, frame).masked_fill(resting, 0)
        peaks.append(peak)
    return torch.stack(peaks, dim=1)


def apply_hysteresis(readings: Tensor, hysteresis: Tensor) -> Tensor:
    """Return readings (B, T, S), N, with hysteresis: larger on unloading, by a mean fraction of the peak.

    At a force x after a peak P that is x + 6 hysteresis x (P - x) / P: no gap at rest and none at the peak.
    """
    peak = running_peak(readings)
    left = torch.where(peak > 0, 1 - readings.abs() / torch.where(peak > 0, peak, 1), 0)
    return readings * (1 + 6 * hysteresis * left)


def quantize(readings: Tensor, quantum: Tensor) -> Tensor:
    """Return readings rounded to multiples of ``quantum``, N; 0: not rounded."""
    step = torch.where(quantum > 0, quantum, 1)
    return torch.where(quantum > 0, torch.round(readings / step) * step, readings)


_APART = 1.2


def relaxes(body: AbstractBody) -> bool:
    """Return whether a body has a viscoelastic material."""
    return any(layer.material.relaxation for layer in body.layers)


def make_elastic(body: AbstractBody, speed: float) -> AbstractBody:
    """Return the elastic body with the response of the viscoelastic one to a load exp(``speed`` t), 1/s."""
    return replace(
        body, layers=tuple(replace(layer, material=layer.material.elastic(speed)) for layer in body.layers)
    )


def times(body: AbstractBody) -> list[float]:
    """Return the time constants of the lags, s, ascending: both ends of each material's range.

    All time constants of the exact solution lie between tau and tau (1 + g) of a material: at constant strain
    a layer relaxes with the first, at constant stress it creeps with the second. Values closer than a factor
    of 1.2 are merged, and those of creep take precedence.
    """
    branches = [branch for layer in body.layers if (branch := layer.material.relaxation) is not None]
    creep = [branch.time * (1 + branch.strength) for branch in branches]
    times: list[float] = []
    for time in [*creep, *(branch.time for branch in branches)]:
        if all(max(time / time_before, time_before / time) >= _APART for time_before in times):
            times.append(time)
    return sorted(times)


def speeds(lags: Sequence[float]) -> list[float]:
    """Return the collocation points, 1/s, one per lag: 0, and one between each lag and the next."""
    return [0.0, *(1 / math.sqrt(shorter * longer) for shorter, longer in pairwise(lags))]


class Relaxing(AbstractSimulator):
    """Simulates a body with viscoelastic materials, E(t) = E (1 + g exp(-t / tau)).

    By the correspondence principle the response to exp(s t) is that of the elastic body with the moduli
    E (1 + g s tau / (1 + s tau)). As a function of s it is fitted by R_inf + sum_j D_j / (1 + s theta_j),
    whose terms are first-order lags in time. The fit is exact for very slow and very fast loads and at the
    collocation points in between (Schapery). For nonlinear readings (equation 10: D_s, D_t and F_in) the
    linear quantities pass through the lags, and the reading is computed from the result.

    Between two frames the load is that of the later one.

    Args:
        simulator: ``simulator(body, sensors)`` of an elastic body.
        body: with a viscoelastic material.
        sensors: the sensors.
        rate: frames per second, Hz.

    Raises:
        InputError: a simulator without mechanics.

    Attributes:
        lags: theta_j, s.
    """

    fractions: Tensor

    def __init__(
        self,
        simulator: Callable[[AbstractBody, Sensors], AbstractSimulator],
        body: AbstractBody,
        sensors: Sensors,
        rate: float,
    ) -> None:
        super().__init__()
        self.lags, self.rate = times(body), float(rate)
        at = speeds(self.lags)
        bodies = (make_elastic(body, speed) for speed in [*at, math.inf])
        self.models = nn.ModuleList(simulator(elastic, sensors) for elastic in bodies)
        self.axes = self._relaxed.axes
        self._relaxed.linear(torch.zeros(body.shape))  # raises here instead of in the first batch
        terms = 1 / (1 + np.outer(at, self.lags))
        self.register_buffer("fractions", torch.from_numpy(np.linalg.inv(terms)))

    @property
    def feels_shear(self) -> bool:  # type: ignore[override]
        """That of the elastic body."""
        return self._relaxed.feels_shear

    @property
    def smooth(self) -> bool:  # type: ignore[override]
        """That of the elastic body."""
        return self._relaxed.smooth

    @property
    def _relaxed(self) -> AbstractSimulator:
        return self.models[0]  # type: ignore[return-value]

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the steady-state response to pressure (..., H, W), Pa."""
        return self._relaxed(pressure, shear)

    def loads(self, pressure: Tensor) -> Tensor:
        """Return mean pressures of cells as loads of the elastic body."""
        return self._relaxed.loads(pressure)

    def press(self, loads: Tensor, shear: Tensor | None = None, displacement: bool = False) -> Response:
        """Return the steady-state response to loads (..., H, W), Pa."""
        return self._relaxed.press(loads, shear, displacement)

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the steady-state displacement of sensors, (..., S, 3), m."""
        return self._relaxed.motion(pressure, shear)

    def compliance(self) -> Tensor:
        """Return the steady-state compliance, (H*W, H*W), m/Pa."""
        return self._relaxed.compliance()

    def surface(self, loads: Tensor) -> Tensor | None:
        """Return the steady-state displacement of the surface, (F, H + 1, W + 1), m."""
        return self._relaxed.surface(loads)

    def strain(self, loads: Tensor, shear: Tensor | None = None) -> Tensor | None:
        """Return the largest steady-state strain, (U,), an upper bound for all loads."""
        return self._relaxed.strain(loads, shear)

    def play(
        self,
        frames: Tensor,
        index: Tensor,
        scale: Tensor,
        shear: Tensor | None = None,
        displacement: bool = False,
    ) -> Response:
        """Return the response to movies with a skin that is initially at rest."""
        linear = [model.linear(frames, shear, displacement) for model in self.models]  # type: ignore[operator]
        parts = [part[index] * scale[..., None] for part in linear]
        time = torch.arange(index.shape[1], device=scale.device) / self.rate
        motion = parts[-1]
        # A difference of operators that are alike; in float32 the lags' fractions would magnify its rounding.
        slow = torch.stack(parts[:-1]).double() - motion.double()
        for lag, fraction in zip(self.lags, self.fractions, strict=True):
            term = torch.einsum("i,i...->...", fraction, slow)
            constant = torch.full_like(term[:, 0], lag)
            motion = motion + first_order_lag(term, constant, time).to(motion)
        response = self._relaxed.read(motion)
        return response if displacement else Response(response.readings, None)
