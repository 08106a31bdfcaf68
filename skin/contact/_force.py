"""Search for the force at which a touch has its wanted labels, gesture by gesture, by bisection."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from skin.contact._unilateral import Equilibrium
from skin.labels import measure_gestures
from skin.touch.problem import ContactProblem

# A peak is met when it is this near to what is wanted; an end of its range must be met better than any other
# before the draw is given up there, so that it does not matter from which side the search has come.
_NEAR = 1.03
_END = 1.0003
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
    problem: ContactProblem,
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
        problem: what is touched; ranges and thresholds.
    """
    search = _Search.of(begin, peak, wanted, problem)
    rows = np.arange(len(peak))
    for _ in range(_STEPS):
        here = torch.from_numpy(rows)
        equilibrium, lost = solve(rows, search.load[rows], search.pressure[here])
        search.pressure[here] = equilibrium.pressure.to(search.pressure)
        highest, classes = _classes(equilibrium.pressure, problem)
        rows = search.move(rows, search.judge(rows, highest, classes != wanted[rows], lost), highest)
        if not len(rows):
            break
    search.result[search.failed] = np.nan
    return Found(search.result, search.area, search.failed, search.pressure)


@dataclass
class _Search:
    """How far the search is, gesture by gesture.

    Attributes:
        wanted: (B, 2), bool: big, dangerous.
        least: (B,), Pa, lower end of the range of the highest cell's pressure.
        most: (B,), Pa, its upper end.
        target: (B,), Pa, the pressure that is sought.
        load: (B,), N, tried next.
        pressure: (B, N), Pa, found last.
        power: (B,), how the load grows with the peak: by the power of 3 under a ball, in proportion under a
            flat punch.
        last: (2, B), logarithms of the load tried last and of the peak that it made.
        result, area, failed: as in :class:`Found`.
    """

    wanted: np.ndarray
    least: np.ndarray
    most: np.ndarray
    target: np.ndarray
    load: np.ndarray
    pressure: torch.Tensor
    power: np.ndarray
    last: np.ndarray
    result: np.ndarray
    area: np.ndarray
    failed: np.ndarray

    @classmethod
    def of(
        cls, begin: torch.Tensor, peak: np.ndarray, wanted: np.ndarray, problem: ContactProblem
    ) -> "_Search":
        """Begin at the drawn peaks (B,), Pa, within their ranges; the rest is as :func:`seek` has it."""
        settings, cell = problem.settings, problem.shapes.body.cell
        ends = np.where(wanted[:, 1:], settings.dangerous_peak, settings.safe_peak)
        least, most = ends[:, 0] * _NEAR, np.maximum(ends[:, 1] / _NEAR, ends[:, 0] * _NEAR)
        target = np.clip(peak, least, most)
        share = torch.from_numpy(target / begin.amax(1).double().numpy()).to(begin)
        pressure = begin * share[:, None]
        load = pressure.sum(1).double().numpy() * (cell[0] * cell[1])
        count = len(peak)
        power, last = np.full(count, 1.5), np.full((2, count), np.nan)
        result = np.full(count, np.nan), np.zeros(count, bool), np.zeros(count, bool)
        return cls(wanted, least, most, target, load, pressure, power, last, *result)

    def judge(self, rows: np.ndarray, highest: np.ndarray, wrong: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Note which searches have ended, and where a met target with wrong classes moves.

        Args:
            rows: (b,), the gestures that were tried.
            highest: (b,), Pa, their highest cell.
            wrong: (b, 2), bool, which of their classes are wrong.
            lost: (b,), bool, whose equilibrium was not found.

        Returns:
            (b,), bool, which of them go on.
        """
        target, least, most = self.target[rows], self.least[rows], self.most[rows]
        up, down = ((wrong & side).any(1) for side in (self.wanted[rows], ~self.wanted[rows]))
        away = np.abs(np.log(highest / target))
        met = away < np.log(_NEAR)
        done = met & ~up & ~down
        self.result[rows[done]] = self.load[rows[done]]
        # Nothing is left to try: both ways at once, or already at the end.
        at_end = (away < np.log(_END)) & ((up & (target >= most)) | (down & (target <= least)))
        over = met & up & down | at_end
        self.area[rows[over]] = wrong[over, 0]
        self.failed[rows[lost]] = True
        for side, end in ((met & up, most), (met & down, least)):
            self.target[rows[side]] = _halfway(self.target[rows[side]], end[side])
        return ~done & ~over & ~lost

    def move(self, rows: np.ndarray, goes_on: np.ndarray, highest: np.ndarray) -> np.ndarray:
        """Set the next load of the searches that go on, (b,), and return their rows."""
        tried = np.log(self.load[rows]), np.log(highest)
        self.power[rows] = _power(self.power[rows], *tried, self.last[:, rows])
        self.last[:, rows] = tried
        rows, highest = rows[goes_on], highest[goes_on]
        step = self.power[rows] * (np.log(self.target[rows]) - np.log(highest))
        self.load[rows] *= np.exp(np.clip(step, -1.5, 1.5))
        return rows


def _classes(pressure: torch.Tensor, problem: ContactProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the highest cell (b,), Pa, and the classes big and dangerous (b, 2) of frames."""
    body, thresholds = problem.shapes.body, problem.settings.thresholds
    frames = pressure.float().view(-1, *body.shape)
    index, once = torch.arange(len(frames))[:, None], torch.ones(len(frames), 1)
    measures = measure_gestures(frames, index, once, problem.footprints, body.cell, thresholds.contact)
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
