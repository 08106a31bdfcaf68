"""The force at which a touch has its wanted classes, gesture by gesture, by halving towards the limit."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from skin.contact._unilateral import Equilibrium
from skin.contact.base import Ground
from skin.labels import measure

__all__ = ["Found", "seek"]

# A peak is met when it is this near to what is wanted.
_NEAR = 1.03
_STEPS = 24


class Found(NamedTuple):
    """Forces, one per gesture (B,).

    Attributes:
        load: N; nan where none has the wanted classes.
        area: bool, it was the area that could not be had.
        failed: bool, the pressure was not found.
        pressure: (B, N), Pa, at the last load.
    """

    load: np.ndarray
    area: np.ndarray
    failed: np.ndarray
    pressure: torch.Tensor


def seek(
    solve: Callable[[np.ndarray, np.ndarray, torch.Tensor], tuple[Equilibrium, np.ndarray]],
    begin: torch.Tensor,
    peak: np.ndarray,
    wanted: np.ndarray,
    ground: Ground,
) -> Found:
    """Find loads at which single frames are big or small, dangerous or safe, as wanted.

    The load is first sought at which the highest cell has the drawn pressure (by secants of the logarithms).
    If the classes are wrong there, the wanted peak moves half of the way towards the end of its range that
    mends them, again and again; at the end the draw is given up.

    Args:
        solve: from rows (b,), their loads (b,), N, and pressures to begin with, to their equilibrium and
            which of them were not found.
        begin: (B, N), first pressures.
        peak: (B,), drawn highest cell pressure, Pa.
        wanted: (B, 2), bool: big, dangerous.
        ground: what is touched; ranges and thresholds.
    """
    settings, body = ground.settings, ground.shapes.body
    cell = body.cell[0] * body.cell[1]
    ends = np.where(wanted[:, 1:], settings.dangerous_peak, settings.safe_peak)
    least, most = ends[:, 0] * _NEAR, np.maximum(ends[:, 1] / _NEAR, ends[:, 0] * _NEAR)
    target = np.clip(peak, least, most)
    pressure = begin * torch.from_numpy(target / begin.amax(1).double().numpy()).to(begin)[:, None]
    load = pressure.sum(1).double().numpy() * cell
    result = np.full(len(load), np.nan)
    area, failed = np.zeros(len(load), bool), np.zeros(len(load), bool)
    # How the load grows with the peak: by the power of 3 under a ball, in proportion under a flat punch.
    power = np.full(len(load), 1.5)
    last = np.full((2, len(load)), np.nan)
    rows = np.arange(len(load))
    for _ in range(_STEPS):
        found, lost = solve(rows, load[rows], pressure[torch.from_numpy(rows)])
        pressure[torch.from_numpy(rows)] = found.pressure.to(pressure)
        highest, classes = _classes(found.pressure, ground)
        wrong = classes != wanted[rows]
        up, down = ((wrong & side).any(1) for side in (wanted[rows], ~wanted[rows]))
        offset = np.log(highest / target[rows])
        met = np.abs(offset) < np.log(_NEAR)
        done = met & ~up & ~down
        result[rows[done]] = load[rows[done]]
        # Nothing is left to try: both ways at once, or already at the end.
        over = met & (
            (up & down) | (up & (target[rows] >= most[rows])) | (down & (target[rows] <= least[rows]))
        )
        area[rows[over]] = wrong[over, 0]
        failed[rows[lost]] = True
        for side, end in ((met & up, most), (met & down, least)):
            target[rows[side]] = _halfway(target[rows[side]], end[rows[side]])
        goes_on = ~done & ~over & ~lost
        power[rows] = _power(power[rows], np.log(load[rows]), np.log(highest), last[:, rows])
        last[:, rows] = np.log(load[rows]), np.log(highest)
        rows = rows[goes_on]
        if not len(rows):
            break
        step = power[rows] * (np.log(target[rows]) - np.log(highest[goes_on]))
        load[rows] *= np.exp(np.clip(step, -1.5, 1.5))
    result[failed] = np.nan
    return Found(result, area, failed, pressure)


def _classes(pressure: torch.Tensor, ground: Ground) -> tuple[np.ndarray, np.ndarray]:
    """Return the highest cell (b,), Pa, and the classes big and dangerous (b, 2) of frames."""
    body, thresholds = ground.shapes.body, ground.settings.thresholds
    frames = pressure.float().view(-1, *body.shape)
    index, once = torch.arange(len(frames))[:, None], torch.ones(len(frames), 1)
    measures = measure(frames, index, once, ground.footprints, body.cell, thresholds.contact)
    labels = measures.labels(thresholds)[:, [0, 3]].bool()
    return frames.flatten(1).amax(1).double().numpy(), labels.numpy()


def _halfway(target: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the geometric mean, or the end where it is near."""
    return np.where(np.abs(np.log(end / target)) < 0.1, end, np.sqrt(target * end))


def _power(power: np.ndarray, load: np.ndarray, peak: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return d log load / d log peak from the last two points, where they are apart."""
    rise, run = load - last[0], peak - last[1]
    apart = np.abs(run) > 1e-3
    slope = np.divide(rise, run, out=power.copy(), where=apart)
    return np.clip(slope, 0.5, 5.0)
