"""Test a calibration on held-out presses; estimate force from readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from skin.errors import InputError
from skin.hardware.calibration.fit import fit_calibration
from skin.hardware.calibration.presses import BenchData
from skin.sensor_dynamics import first_order_lag
from skin.signal.calibration import Calibration
from skin.signal.imperfection import Imperfection

_RESPONDING = 0.05  # of the press's strongest reading: sensors that count
_LOADED = 0.2  # of a press's peak: frames in which its force is estimated
_CLIPPED = 0.95


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on presses that were not used for the calibration.

    Attributes:
        simulated: RMSE of the simulated true readings (gain 1, no offset), N.
        tared: RMSE with each sensor's offset added, N.
        calibrated: RMSE of the calibrated simulation, N.
        held_out: numbers of these presses.
        force: ratio of estimated force to the gauge's, median over the loading of each held-out press, (n,);
            empty if no sensor could be used.
    """

    simulated: float
    tared: float
    calibrated: float
    held_out: Sequence[int]
    force: np.ndarray

    @property
    def helps(self) -> bool:
        """Whether the calibrated simulation has a smaller error than taring alone."""
        return self.calibrated < min(self.simulated, self.tared)


def hold_out(bench: BenchData, share: float) -> list[int]:
    """Return the held-out presses: a share of all, each with an earlier press at the same strongest sensor.

    Raises:
        InputError: no sensor has two presses.
    """
    strongest = bench.each.argmax(axis=1)
    spare = [n for n in range(len(strongest)) if (strongest[:n] == strongest[n]).any()]
    if not spare:
        raise InputError("no press can be held out: press near every sensor at least twice")
    count = min(len(spare), max(1, round(share * len(strongest))))
    return [spare[n] for n in np.linspace(0, len(spare) - 1, count).round().astype(int)]


def evaluate_held_out(bench: BenchData, share: float) -> HeldOutErrors:
    """Calibrate without some presses, and compare their simulation with the measured readings.

    Args:
        bench: the session.
        share: of the presses that is held out.
    """
    held = hold_out(bench, share)
    found = fit_calibration(bench, [n for n in range(len(bench.gauge)) if n not in held])
    press, each = bench.applied[1], bench.each
    responding = each[press] > _RESPONDING * each[press].max(axis=1, keepdims=True)
    alive = ~found.values()["dead"] & np.isfinite(bench.session.raw)
    counted = bench.of(held)[:, None] & responding & alive
    measured, true = found.newtons(bench.session.raw), bench.true

    def rmse(guess: np.ndarray) -> float:
        return float(np.sqrt(np.mean((guess[counted] - measured[counted]) ** 2)))

    offset = found.values()["offset"]
    return HeldOutErrors(
        rmse(true),
        rmse(true + offset),
        rmse(predict_session(bench, found)),
        held,
        _forces(bench, held, found),
    )


def predict_session(bench: BenchData, calibration: Calibration) -> np.ndarray:
    """Return the simulated readings of a calibrated device without noise, (T, S), N."""
    imperfection = Imperfection(calibration=calibration)
    randomness = np.random.default_rng(0)
    constants = imperfection.constants(bench.each.shape[1], randomness)
    constants = constants._replace(noise=torch.zeros(()))
    time = torch.from_numpy(bench.session.time).float()
    true = torch.from_numpy(bench.true)[None].float()
    return imperfection.raw(true, constants, randomness, time)[0].double().numpy()


def estimate_force(raw: np.ndarray, each: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Estimate the force of a press from readings, (...), N, by least squares over usable sensors.

    Args:
        raw: (..., S), in the session's unit.
        each: (S,), true readings per N of that indenter at that place, as
            :func:`skin.hardware.calibration.bench.per_newton` gives them.
        calibration: of this skin.

    Returns:
        NaN if every sensor that responds to the press is broken or at its limit.
    """
    true, values = calibration.corrected(raw), calibration.values()
    below = calibration.newtons(raw) - values["offset"] < _CLIPPED * values["clip"]
    weights = np.where(below & np.isfinite(true) & (each > _RESPONDING * each.max()), each, 0.0)
    square = (weights**2).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (weights * np.nan_to_num(true)).sum(axis=-1) / np.where(square > 0, square, np.nan)


def _forces(bench: BenchData, presses: Sequence[int], calibration: Calibration) -> np.ndarray:
    """Return the ratio of estimated force to the lagged force of the gauge, of each press."""
    force, press = bench.applied
    lag = torch.tensor([float(np.median(calibration.known("time_constant")))]).double()
    late = first_order_lag(torch.from_numpy(force)[None, :, None], lag, torch.from_numpy(bench.session.time))
    late_force = late[0, :, 0].numpy()
    per_second = calibration.signs * calibration.known("drift") / calibration.scale
    drift = per_second * bench.session.time[:, None]
    raw, shares = bench.session.raw - drift, []
    for number in presses:
        mine = bench.loading & (press == number)
        mine &= force > _LOADED * force[press == number].max()
        shares.append(estimate_force(raw[mine], bench.each[number], calibration) / late_force[mine])
    known = [each[np.isfinite(each)] for each in shares]
    return np.array([np.median(each) for each in known if len(each)])
