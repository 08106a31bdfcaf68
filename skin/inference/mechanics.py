"""What contacts on a watched skin are estimated with; it can be sent to a process. torch is not imported."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from skin.errors import InputError
from skin.inference.noise import Noise

if TYPE_CHECKING:
    from skin.body.base import AbstractBody, Sensors
    from skin.device.simulated import Simulated
    from skin.inference.candidates import CandidateReadings, FingertipPrior
    from skin.inference.posterior import Posterior
    from skin.mechanics.simulator.base import AbstractSimulator

QUIET = 1e-3
"""N, least noise: a device without any would make each reading certain."""


def thicken(body: "AbstractBody", sensors: "Sensors", factor: float) -> "tuple[AbstractBody, Sensors]":
    """Return a body whose layers are thicker, and its sensors, deeper, by a factor."""
    return (
        replace(body, layers=tuple(replace(part, thickness=factor * part.thickness) for part in body.layers)),
        replace(sensors, positions=sensors.positions * [1, 1, factor]),
    )


@dataclass(frozen=True)
class Mechanics:
    """What contacts are estimated with.

    Attributes:
        simulator: ``simulator(body, sensors)`` gives readings that add up. The process builds it, from the
            cache on the disk: its factors cannot be sent.
        body, sensors: the skin.
        noise: of a device of this kind, as far as it is known before its tare.
    """

    simulator: "Callable[[AbstractBody, Sensors], AbstractSimulator]"
    body: "AbstractBody"
    sensors: "Sensors"
    noise: Noise

    @classmethod
    def of(
        cls,
        device: "Simulated | None",
        calibrated: bool,
        gain: float = 0.02,
        placed: float = 0.001,
        thickness: tuple[float, float] = (1.0, 1.0),
    ) -> "Mechanics":
        """Return the mechanics of a run's skin.

        Args:
            device: that simulates the skin; None: it has no mechanics.
            calibrated: the gains of the watched device are known; otherwise they vary as those of the
                training do.
            gain: standard deviation of the gains of a calibrated device.
            placed: m, standard deviation of the positions of sensors, as made by hand.
            thickness: range, relative to the described one (:class:`skin.inference.noise.Noise`).

        Raises:
            InputError: there are no mechanics, or readings of contacts do not add up.
        """
        if device is None or getattr(device.model, "reading", None) == "equation10":
            raise InputError(
                (
                    "this model has no simulated skin"
                    if device is None
                    else "readings of equation 10 do not add up"
                )
                + ": use run=any_skin, or a run of simulator=solid"
            )
        settings = device.imperfection
        nominal = Noise(
            max(float(np.mean(settings.noise)), QUIET),
            gain=gain if calibrated else float(np.mean(settings.gain_spread)),
            offset=0.0 if settings.tare else settings.offset,
            position=placed,
            thickness=thickness,
        )
        return cls(device.simulator, device.body, device.sensors, nominal)

    def thicker(self, factor: float, prior: "FingertipPrior") -> "CandidateReadings":
        """Return the readings of a skin whose layers are thicker, and whose sensors deeper, by a factor."""
        from skin.inference.candidates import CandidateReadings

        body, sensors = thicken(self.body, self.sensors, factor)
        return CandidateReadings(self.simulator(body, sensors), body, prior)

    def posterior(self) -> "Posterior":
        """Return the estimator, for a skin that is watched all the time and therefore idle most of it.

        Touches are ten times less frequent than by default, in the same proportions. By default the prior
        expects a touch, which few sensors that feel nothing cannot rule out between them.

        Raises:
            InputError: readings of the simulator do not add up.
        """
        from skin.inference.candidates import FingertipPrior
        from skin.inference.posterior import Posterior

        return Posterior(
            self.simulator(self.body, self.sensors),
            self.noise,
            self.body,
            FingertipPrior(numbers=(0.93, 0.04, 0.015, 0.005), large=0.01),
        )
