"""Test a calibration on held-out presses; estimate force from readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from skin.errors import InputError
from skin.hardware.calibration.bench_data import BenchData
from skin.hardware.calibration.fit import fit_calibration
from skin.sensor_dynamics import first_order_lag
from skin.signal.calibration import Calibration
from skin.signal.imperfection import Imperfection

_FELT = 0.05  # of the press's strongest reading: sensors that count
_LOADED = 0.2  # of a press's peak: frames in which its force is estimated
_CLIPPED = 0.95


@dataclass(frozen=True)
class HeldOutErrors:
    """Simulated against real readings of presses that the calibration had not seen.

    Attributes:
        simulated: RMSE of the true readings as they are (gain 1, no offset), N.
        tared: the same with each sensor's offset, N.
        calibrated: RMSE of the calibrated simulation, N.
        held_out: numbers of these presses.
        force: estimated force over the gauge's, the median of each held-out press on its way up, (n,); empty
            where no sensor could tell it.
    """

    simulated: float
    tared: float
    calibrated: float
    held_out: Sequence[int]
    force: np.ndarray

    @property
    def helps(self) -> bool:
        """Whether the calibration is worth more than to tare."""
        return self.calibrated < min(self.simulated, self.tared)


def hold_out(bench: BenchData, share: float) -> list[int]:
    """Return presses to judge by: the last of those that have the same strongest sensor, a share of all.

    Raises:
        InputError: no sensor has two presses, so none can be spared.
    """
    strongest = bench.each.argmax(axis=1)
    spare = [n for n in range(len(strongest)) if (strongest[:n] == strongest[n]).any()]
    if not spare:
        raise InputError("no press can be held out: press the neighbourhood of every sensor at least twice")
    count = min(len(spare), max(1, round(share * len(strongest))))
    return [spare[n] for n in np.linspace(0, len(spare) - 1, count).round().astype(int)]


def evaluate_held_out(bench: BenchData, share: float) -> HeldOutErrors:
    """Fit without some presses, and compare the simulation of these with what was read.

    Args:
        bench: the session.
        share: of the presses that is held out.
    """
    held = hold_out(bench, share)
    found = fit_calibration(bench, [n for n in range(len(bench.gauge)) if n not in held])
    press, each = bench.applied[1], bench.each
    felt = each[press] > _FELT * each[press].max(axis=1, keepdims=True)
    alive = ~found.values()["dead"] & np.isfinite(bench.session.raw)
    counted = bench.of(held)[:, None] & felt & alive
    said, true = found.newtons(bench.session.raw), bench.true

    def rmse(guess: np.ndarray) -> float:
        return float(np.sqrt(np.mean((guess[counted] - said[counted]) ** 2)))

    offset = found.values()["offset"]
    return HeldOutErrors(
        rmse(true),
        rmse(true + offset),
        rmse(predict_session(bench, found)),
        held,
        _forces(bench, held, found),
    )


def predict_session(bench: BenchData, calibration: Calibration) -> np.ndarray:
    """Return what a device of this calibration would say to the presses without noise, (T, S), N."""
    imperfection = Imperfection(calibration=calibration)
    randomness = np.random.default_rng(0)
    constants = imperfection.constants(bench.each.shape[1], randomness)
    constants = constants._replace(noise=torch.zeros(()))
    time = torch.from_numpy(bench.session.time).float()
    true = torch.from_numpy(bench.true)[None].float()
    return imperfection.raw(true, constants, randomness, time)[0].double().numpy()


def estimate_force(raw: np.ndarray, each: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return the force of a press from what was read, (...), N: least squares over sensors that can tell.

    Args:
        raw: (..., S), in the session's unit.
        each: (S,), true readings per N of that indenter at that place, as
            :func:`skin.hardware.calibration.gauge.per_newton` gives them.
        calibration: of this skin.

    Returns:
        NaN where every sensor that feels the press is broken or at its limit.
    """
    true, values = calibration.corrected(raw), calibration.values()
    below = calibration.newtons(raw) - values["offset"] < _CLIPPED * values["clip"]
    weights = np.where(below & np.isfinite(true) & (each > _FELT * each.max()), each, 0.0)
    square = (weights**2).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (weights * np.nan_to_num(true)).sum(axis=-1) / np.where(square > 0, square, np.nan)


def _forces(bench: BenchData, presses: Sequence[int], calibration: Calibration) -> np.ndarray:
    """Return the estimated force over the gauge's, which sensors feel behind their lag, of each press."""
    force, press = bench.applied
    lag = torch.tensor([float(np.median(calibration.known("time_constant")))]).double()
    late = first_order_lag(torch.from_numpy(force)[None, :, None], lag, torch.from_numpy(bench.session.time))
    late_force = late[0, :, 0].numpy()
    drift = calibration.known("drift") / calibration.scale * bench.session.time[:, None]
    raw, shares = bench.session.raw - drift, []
    for number in presses:
        mine = bench.loading & (press == number)
        mine &= force > _LOADED * force[press == number].max()
        shares.append(estimate_force(raw[mine], bench.each[number], calibration) / late_force[mine])
    known = [each[np.isfinite(each)] for each in shares]
    return np.array([np.median(each) for each in known if len(each)])
