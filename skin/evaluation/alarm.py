"""The alarm "dangerous" on a stream: detected touches and false alarms."""

import math
from dataclasses import dataclass

import torch
from scipy.stats import binomtest, chi2
from torch import Tensor


@dataclass(frozen=True)
class Alarms:
    """The alarms on sliding windows over a stream.

    Attributes:
        idle_hours: time in which the window showed no touch.
        false: alarms that began in that time; consecutive alarms count once.
        dangerous: number of dangerous touches.
        found: those that raised an alarm while the window showed them.
        safe: number of safe touches.
        raised: those that raised an alarm.
    """

    idle_hours: float
    false: int
    dangerous: int
    found: int
    safe: int
    raised: int

    @property
    def per_hour(self) -> float:
        """False alarms per hour without touch."""
        return self.false / self.idle_hours if self.idle_hours else float("nan")

    @property
    def range(self) -> tuple[float, float]:
        """95 % confidence interval of the rate per hour, exact for independent events (Garwood, 1936)."""
        if not self.idle_hours:
            return float("nan"), float("nan")
        low = chi2.ppf(0.025, 2 * self.false) / 2 if self.false else 0.0
        return float(low) / self.idle_hours, float(chi2.ppf(0.975, 2 * self.false + 2)) / 2 / self.idle_hours


@dataclass(frozen=True)
class Reached:
    """The alarms of an operating point on some gestures.

    Attributes:
        dangerous: dangerous gestures.
        found: those that raise the alarm.
        safe: safe gestures.
        raised: those that raise the alarm.
    """

    dangerous: int
    found: int
    safe: int
    raised: int

    @property
    def recall(self) -> float:
        """Share of the dangerous gestures that raise the alarm; NaN if there are none."""
        return self.found / self.dangerous if self.dangerous else math.nan

    @property
    def false_alarm_rate(self) -> float:
        """Share of the safe gestures that raise the alarm; NaN if there are none."""
        return self.raised / self.safe if self.safe else math.nan

    @property
    def range(self) -> tuple[float, float]:
        """95 % confidence interval of the false-alarm rate, exact (Clopper and Pearson, 1934)."""
        if not self.safe:
            return math.nan, math.nan
        low, high = binomtest(self.raised, self.safe).proportion_ci(0.95)
        return float(low), float(high)

    def sentence(self) -> str:
        """Return the false-alarm rate with its range, and the recall, in words; "-" where undefined."""
        low, high = self.range
        rate = "false alarms: - (no safe gesture)"
        if self.safe:
            rate = (
                f"false alarms: {self.raised} of {self.safe} safe gestures, "
                f"{100 * self.false_alarm_rate:.1f} % (95 %: {100 * low:.1f} to {100 * high:.1f})"
            )
        recall = f"{100 * self.recall:.1f} % of {self.dangerous}" if self.dangerous else "-"
        return f"{rate}; dangerous gestures found: {recall}"


def count_alarms(alarm: Tensor, gesture: Tensor, dangerous: Tensor, hours: float) -> Alarms:
    """Return the alarms of W consecutive windows.

    Args:
        alarm: (W,), bool.
        gesture: (W,), the touch in each window, as an index into ``dangerous``; -1: none.
        dangerous: (G,), bool, of each touch.
        hours: time from one window to the next.
    """
    idle = gesture < 0
    wrong = alarm & idle
    began = wrong & ~torch.cat([torch.zeros(1, dtype=torch.bool), wrong[:-1]])
    shown, raised = torch.zeros(2, len(dangerous), dtype=torch.bool)
    shown[gesture[~idle]] = True
    raised[gesture[alarm & ~idle]] = True
    return Alarms(
        idle_hours=float(idle.sum()) * hours,
        false=int(began.sum()),
        dangerous=int((shown & dangerous).sum()),
        found=int((raised & dangerous).sum()),
        safe=int((shown & ~dangerous).sum()),
        raised=int((raised & ~dangerous).sum()),
    )
