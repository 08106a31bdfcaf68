"""Search, for each gesture, for the force that gives its wanted labels."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from skin.contact._unilateral import Equilibrium
from skin.gesture_measures import measure_gestures
from skin.touch.sampler import ContactProblem

# Relative tolerance of the peak. The tolerance at an end of its range, where a search fails, is tighter, so
# that the result does not depend on the side from which the search has come.
_NEAR = 1.03
_END = 1.0003
_STEPS = 24


class ForceSearch(NamedTuple):
    """Forces, one per gesture (B,).

    Attributes:
        load: N; NaN where no load gives the wanted classes.
        area: bool, whether the area class could not be reached.
        failed: bool, whether the contact did not converge.
        pressure: (B, N), Pa, at the last load.
    """

    load: np.ndarray
    area: np.ndarray
    failed: np.ndarray
    pressure: torch.Tensor


def find_force(
    solve: Callable[[np.ndarray, np.ndarray, torch.Tensor], tuple[Equilibrium, np.ndarray]],
    begin: torch.Tensor,
    peak: np.ndarray,
    labels: np.ndarray,
    problem: ContactProblem,
) -> ForceSearch:
    """Find loads at which single frames are big or small, dangerous or safe, as wanted.

    A secant search on logarithms first finds the load at which the peak pressure is the drawn one. Where the
    classes are wrong there, the wanted peak moves half of the way towards one end of its range, repeatedly.
    At the end of the range the search fails.

    Args:
        solve: takes rows (b,), their loads (b,), N, and initial pressures; returns their equilibrium and
            which of them did not converge.
        begin: (B, N), initial pressures.
        peak: (B,), drawn peak pressure, Pa.
        wanted: (B, 2), bool: big, dangerous.
        problem: the body, ranges and thresholds.
    """
    search = _Search.of(begin, peak, labels, problem)
    rows = np.arange(len(peak))
    for _ in range(_STEPS):
        selected = torch.from_numpy(rows)
        equilibrium, lost = solve(rows, search.load[rows], search.pressure[selected])
        search.pressure[selected] = equilibrium.pressure.to(search.pressure)
        peaks, classes = _classes(equilibrium.pressure, problem)
        rows = search.move(rows, search.judge(rows, peaks, classes != labels[rows], lost), peaks)
        if not len(rows):
            break
    search.result[search.failed] = np.nan
    return ForceSearch(search.result, search.area, search.failed, search.pressure)


@dataclass
class _Search:
    """State of the search, per gesture.

    Attributes:
        wanted: (B, 2), bool: big, dangerous.
        least: (B,), Pa, lower end of the range of the peak pressure.
        most: (B,), Pa, its upper end.
        target: (B,), Pa, peak pressure to find.
        load: (B,), N, next load to try.
        pressure: (B, N), Pa, last solution.
        power: (B,), exponent of the load as a function of the peak: 3 under a sphere, 1 under a flat punch.
        last: (2, B), logarithms of the last load and of its peak.
        result, area, failed: as in :class:`ForceSearch`.
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
        cls, begin: torch.Tensor, peak: np.ndarray, labels: np.ndarray, problem: ContactProblem
    ) -> "_Search":
        """Return a search that begins at the drawn peaks (B,), Pa, clipped to their ranges."""
        settings, cell = problem.settings, problem.shapes.body.cell
        ends = np.where(labels[:, 1:], settings.dangerous_peak, settings.safe_peak)
        least, most = ends[:, 0] * _NEAR, np.maximum(ends[:, 1] / _NEAR, ends[:, 0] * _NEAR)
        target = np.clip(peak, least, most)
        share = torch.from_numpy(target / begin.amax(1).double().numpy()).to(begin)
        pressure = begin * share[:, None]
        load = pressure.sum(1).double().numpy() * (cell[0] * cell[1])
        count = len(peak)
        power, last = np.full(count, 1.5), np.full((2, count), np.nan)
        result = np.full(count, np.nan), np.zeros(count, bool), np.zeros(count, bool)
        return cls(labels, least, most, target, load, pressure, power, last, *result)

    def judge(self, rows: np.ndarray, peak: np.ndarray, wrong: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Store finished searches, and move the target where the classes at it are wrong.

        Args:
            rows: (b,), the gestures that were tried.
            peak: (b,), Pa, their peak pressure.
            wrong: (b, 2), bool, which of their classes are wrong.
            lost: (b,), bool, whether the contact did not converge.

        Returns:
            (b,), bool, which searches continue.
        """
        target, least, most = self.target[rows], self.least[rows], self.most[rows]
        up, down = ((wrong & side).any(1) for side in (self.wanted[rows], ~self.wanted[rows]))
        away = np.abs(np.log(peak / target))
        met = away < np.log(_NEAR)
        done = met & ~up & ~down
        self.result[rows[done]] = self.load[rows[done]]
        # The classes ask for both directions, or the target is already at the end.
        at_end = (away < np.log(_END)) & ((up & (target >= most)) | (down & (target <= least)))
        over = met & up & down | at_end
        self.area[rows[over]] = wrong[over, 0]
        self.failed[rows[lost]] = True
        for side, end in ((met & up, most), (met & down, least)):
            self.target[rows[side]] = _halfway(self.target[rows[side]], end[side])
        return ~done & ~over & ~lost

    def move(self, rows: np.ndarray, goes_on: np.ndarray, peak: np.ndarray) -> np.ndarray:
        """Set the next load of the searches that continue, (b,), and return their rows."""
        tried = np.log(self.load[rows]), np.log(peak)
        self.power[rows] = _power(self.power[rows], *tried, self.last[:, rows])
        self.last[:, rows] = tried
        rows, peak = rows[goes_on], peak[goes_on]
        step = self.power[rows] * (np.log(self.target[rows]) - np.log(peak))
        self.load[rows] *= np.exp(np.clip(step, -1.5, 1.5))
        return rows


def _classes(pressure: torch.Tensor, problem: ContactProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the peak pressure (b,), Pa, and the classes big and dangerous (b, 2) of frames."""
    body, thresholds = problem.shapes.body, problem.settings.thresholds
    frames = pressure.float().view(-1, *body.shape)
    index, once = torch.arange(len(frames))[:, None], torch.ones(len(frames), 1)
    measures = measure_gestures(frames, index, once, problem.footprints, body.cell, thresholds.contact)
    labels = measures.labels(thresholds, problem.settings.rate)[:, [0, 3]].bool()
    return frames.flatten(1).amax(1).double().numpy(), labels.numpy()


def _halfway(target: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the geometric mean of target and end, or the end where they are close."""
    return np.where(np.abs(np.log(end / target)) < 0.1, end, np.sqrt(target * end))


def _power(power: np.ndarray, load: np.ndarray, peak: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return d log load / d log peak from the last two points, where they differ enough."""
    rise, run = load - last[0], peak - last[1]
    apart = np.abs(run) > 1e-3
    slope = np.divide(rise, run, out=power.copy(), where=apart)
    return np.clip(slope, 0.5, 5.0)
