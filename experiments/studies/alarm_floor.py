"""Highest recall of the alarm that unknown gains of the sensors allow."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from annotated_types import Ge, Gt, Lt, MinLen
from scipy.special import log_ndtr

from experiments.studies.subject import Measurement, Subject

if TYPE_CHECKING:
    from torch import Tensor

    from skin.device.base import AbstractSimulated
    from skin.touch.gesture import GestureSettings

_CLEAN = ("gain_spread", "offset", "noise", "drift", "hysteresis", "time_constant", "quantum", "dead")


@dataclass(frozen=True)
class AlarmFloor:
    """Recall of an observer that knows everything about a touch but its pressure and the sensors' gains.

    The observer knows the movie of the touch up to a factor, the distributions that gestures are drawn from
    (the prior) and all imperfections but the gains. It decides by the likelihood ratio, which no classifier
    exceeds (Neyman and Pearson, 1933). Its recall is therefore an upper bound. The same observer with a
    single sensor, the one that feels most, does not know how the pressures on other sensors are related to
    it. A classifier, which has to estimate the touch, lies between the two or below.

    Args:
        gains: standard deviations of the logarithm of the gain.
        noise: standard deviation of the noise in every frame, N.
        gestures: number of test gestures.
        false_alarm_rate: share of safe gestures that raise the alarm.
    """

    gains: Annotated[Sequence[Annotated[float, Gt(0)]], MinLen(1)] = (0.02, 0.05, 0.1, 0.2, 0.4)
    noise: Annotated[float, Ge(0)] = 0.1
    gestures: Annotated[int, Ge(100)] = 20000
    false_alarm_rate: Annotated[float, Gt(0), Lt(1)] = 0.02

    def __call__(self, subject: Subject) -> Measurement:
        from experiments.studies.tables import Page

        device = subject.device.simulated("the pressure of a touch is known in simulation only")
        found = {gain: self.recall(device, gain) for gain in self.gains}
        head = ["gain_spread", "all_sensors", "error", "one_sensor", "error"]
        data = [[f"{gain:g}", *(f"{x:.4f}" for one in each for x in one)] for gain, each in found.items()]
        shown = [
            [f"{100 * gain:g} %", *(f"{100 * recall:.1f} ± {200 * error:.1f}" for recall, error in each)]
            for gain, each in found.items()
        ]
        about = (
            f"{self.gestures} gestures, {100 * self.false_alarm_rate:g} % false alarms, noise "
            f"of {self.noise:g} N in every frame"
        )
        title = "Largest possible recall of dangerous touches, % ± two standard errors"
        tables = {title: [["spread of the gains", "all sensors", "one sensor"], *shown]}
        return Measurement({}, Page(about, tables, [head, *data]))

    def recall(self, device: "AbstractSimulated", gain: float) -> list[tuple[float, float]]:
        """Return the largest recall and its standard error, with all sensors and with one.

        Args:
            device: its gestures are used without imperfections.
            gain: standard deviation of the logarithm of the gain.
        """
        clean = device.replace(
            **dict.fromkeys(_CLEAN, 0), clip=1e6, calibration=None, test_gestures=self.gestures
        )
        drawn = clean.recording("test", complete=False)
        assert drawn.touches.labels is not None
        dangerous = drawn.touches.labels[:, -1].numpy() > 0.5
        # Some safe touches press no sensor.
        true = np.log(drawn.parameters["pressure"].double().clamp(min=1).numpy())
        share = np.exp(true) / drawn.parameters["peak"].double().numpy()
        found = []
        for variance in _variances(drawn.touches.readings, gain, self.noise):
            seen = true + np.sqrt(variance) * np.random.default_rng(0).standard_normal(len(true))
            score = log_likelihood_ratio(seen, variance, share, clean.sampler.settings)
            raised = score[dangerous] > np.quantile(score[~dangerous], 1 - self.false_alarm_rate)
            found.append((float(raised.mean()), float(raised.std() / np.sqrt(len(raised)))))
        return found


def log_likelihood_ratio(
    seen: np.ndarray, variance: np.ndarray, share: np.ndarray, settings: "GestureSettings"
) -> np.ndarray:
    """Return the log-likelihood of a dangerous touch minus that of a safe one, (B,).

    Args:
        seen: (B,), estimates of the logarithm of the pressure in Pa, normal about the true ones.
        variance: (B,), of the estimates.
        share: (B,), known pressure over known peak pressure of a cell.
        settings: their peaks are drawn uniformly from ``safe_peak`` and ``dangerous_peak``.
    """
    least, most = settings.dangerous_peak
    # A touch below the threshold would have been drawn again.
    low = np.maximum(least, settings.thresholds.pressure / share)
    dangerous = _log_density(seen, variance, share * np.minimum(low, most), share * most)
    dangerous = np.where(low < most, dangerous, -np.inf)
    return dangerous - _log_density(seen, variance, *(share * end for end in settings.safe_peak))


def _log_density(seen: np.ndarray, variance: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the log-density of estimates of the log of a pressure that is uniform in (low, high), Pa."""
    spread, width = np.sqrt(variance), np.maximum(high - low, 1e-9)
    below, above = ((np.log(end) - seen - variance) / spread for end in (low, np.maximum(high, low + width)))
    # Where both are in the upper tail, their complements have more digits.
    flip = below > 0
    below, above = np.where(flip, -above, below), np.where(flip, -below, above)
    within = log_ndtr(above) + np.log1p(-np.exp(np.minimum(log_ndtr(below) - log_ndtr(above), -1e-12)))
    return seen + variance / 2 + within - np.log(width)


def _variances(readings: "Tensor", gain: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the variances (B,) of the logarithm of a factor of clean readings (B, T, S), N.

    The first is of an estimate from all sensors, the second from the best one.
    """
    energy = readings.double().square().sum(dim=1)
    # Each sensor gives one estimate, whose error is its gain and the noise of all its frames.
    known = 1 / (gain**2 + noise**2 / energy.clamp(min=1e-12))
    known = torch.where(energy > 0, known, 1e-6)
    return (1 / known.sum(dim=1)).numpy(), (1 / known.amax(dim=1)).numpy()
