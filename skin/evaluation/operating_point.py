"""An operating point: a threshold of the alarm "dangerous", how it was chosen, and what it reaches.

torch is not imported. :mod:`skin.evaluation.alarm` chooses the threshold.
"""

import io
import json
import math
import os
import signal
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy.special import expit, logit

from skin.errors import InputError
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.guarantee import Guarantee
from skin.evaluation.settings import ENOUGH
from skin.touch.labels import ALARM, Task

if TYPE_CHECKING:
    from torch import Tensor

    from skin.device.touches import Touches
    from skin.evaluation.alarm import AlarmSource

LABEL = ALARM
_SURE = 1e-6  # probabilities of a network in single precision hold no more
_FAINT = 1e-3  # N, far below any contact threshold
_RIDGE = 0.01  # as of 100 touches of prior weight: separable touches would need infinite factors


class Predictor(Protocol):
    """The interface that an evaluation needs: a trained learner, an ensemble of runs, or a peer."""

    def probabilities(self, touches: "Touches") -> "Tensor":
        """Return the probability of each label, (B, L); raise InputError for touches that do not fit."""


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
        """Fraction of the dangerous gestures that raise the alarm; NaN if there are none."""
        return self.found / self.dangerous if self.dangerous else math.nan

    @property
    def false_alarm_rate(self) -> float:
        """Fraction of the safe gestures that raise the alarm; NaN if there are none."""
        return self.raised / self.safe if self.safe else math.nan

    @property
    def range(self) -> tuple[float, float]:
        """95 % confidence interval of the false-alarm rate, exact (Clopper and Pearson, 1934)."""
        from scipy.stats import binomtest

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


@dataclass(frozen=True)
class DangerScore:
    """Combines the probability of a model with the largest reading of its window, by a logistic function.

    A network blurs the level of big touches, and a reading alone knows no duration or area: each finds what
    the other misses. Both factors are 0 or more, so a larger reading never lowers the probability.

    Attributes:
        odds: factor of the log odds of the model.
        level: factor of the natural logarithm of the largest reading, N.
        offset: added to both.
    """

    odds: float
    level: float
    offset: float

    @classmethod
    def fit(cls, probability: np.ndarray, reading: np.ndarray, dangerous: np.ndarray) -> "DangerScore":
        """Return the combination of the highest likelihood on some touches, with a small ridge.

        Args:
            probability: (n,), of ``dangerous``, of the model.
            reading: (n,), N.
            dangerous: (n,), bool.
        """
        from scipy.optimize import minimize

        inputs = np.stack([*_inputs(probability, reading), np.ones(len(probability))], axis=1)
        sign = np.where(dangerous, 1.0, -1.0)

        def loss(factors: np.ndarray) -> tuple[float, np.ndarray]:
            margin, ridge = sign * (inputs @ factors), _RIDGE * factors * (1.0, 1.0, 0.0)
            slope = -sign * expit(-margin)
            return np.logaddexp(0.0, -margin).sum() + ridge @ factors / 2, slope @ inputs + ridge

        bounds = [(0.0, None), (0.0, None), (None, None)]
        return cls(*minimize(loss, (1.0, 1.0, 0.0), jac=True, method="L-BFGS-B", bounds=bounds).x.tolist())

    def probability(self, probability: np.ndarray, reading: np.ndarray) -> np.ndarray:
        """Return the combined probability of ``dangerous``, in the shape of both; NaN if the model's is."""
        odds, level = _inputs(probability, reading)
        return expit(self.odds * odds + self.level * level + self.offset)


def _inputs(probability: np.ndarray, reading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log odds of a probability, and the logarithm of a reading, N."""
    return logit(np.clip(probability, _SURE, 1 - _SURE)), np.log(np.maximum(reading, _FAINT))


@dataclass(frozen=True)
class OperatingPoint:
    """An alarm is raised where the probability of ``dangerous`` is greater than the threshold.

    Attributes:
        threshold: exactly representable as float32, so that comparisons do not depend on the precision.
        target: largest wanted false-alarm rate; NaN: unknown.
        safe: number of safe gestures on which it was chosen; 0: it was given, or is a default.
        raised: how many of them raise the alarm.
        seed: of the fresh gestures on which it was chosen; None: it was chosen on a validation split.
        dangerous: number of dangerous gestures among those on which it was chosen.
        found: how many of them raise the alarm.
        rate: of the device, Hz, where the threshold was chosen for the alarm of the live view, which judges
            many windows of a touch; None: it was chosen for one window of each gesture.
        score: gives the probability that is compared; None: it is the model's.
        guarantee: that few dangerous touches are missed, for which the threshold was chosen in place of
            ``target``; ``dangerous`` are those that count.
        provisional: it is a lower limit from few touches, so at least ``target`` of the safe ones raise it.
    """

    threshold: float
    target: float = math.nan
    safe: int = 0
    raised: int = 0
    seed: int | None = None
    dangerous: int = 0
    found: int = 0
    rate: float | None = None
    score: DangerScore | None = None
    guarantee: Guarantee | None = None
    provisional: bool = False

    @property
    def silent(self) -> bool:
        """Whether the threshold is so high, or not a number, that no probability raises the alarm."""
        return not self.threshold < 1

    @property
    def useless(self) -> bool:
        """Whether it is silent, or more than a quarter of the dangerous touches raise no alarm when live."""
        hidden = self.dangerous - self.found
        return self.silent or (self.rate is not None and hidden > 0.25 * self.dangerous)

    def alarm(self, probability: "Tensor") -> "Tensor":
        """Return which probabilities raise the alarm, bool, in the shape of ``probability``."""
        return probability > self.threshold

    def reached(self, probabilities: "Tensor", labels: "Tensor", task: Task) -> Reached:
        """Return the alarms on gestures with probabilities (B, L) and labels (B, L)."""
        probability, dangerous = dangerous_column(probabilities, labels, task)
        alarm = self.alarm(probability)
        counts = dangerous.sum(), (alarm & dangerous).sum(), (~dangerous).sum(), (alarm & ~dangerous).sum()
        return Reached(*(int(count) for count in counts))

    def sentence(self) -> str:
        """Return a sentence with the threshold and how it was chosen."""
        rule = f"alarm above {self.threshold:.4f}"
        if not self.safe:
            return f"{rule}: not chosen on any gestures, its false-alarm rate is unknown"
        if self.guarantee is not None:
            rate = f"{100 * self.raised / self.safe:.1f} % of {self.safe} safe touches raise it"
            return f"{rule}: {self.guarantee.sentence()}; {rate}"
        kind = "safe validation" if self.seed is None else "fresh safe"
        what = "gestures" if self.rate is None else f"touches at {self.rate:.3g} Hz"
        rate = "at least " * self.provisional + f"{100 * self.target:g} % false alarms"
        text = f"{rule}, chosen on {self.safe} {kind} {what} for {rate}"
        if self.dangerous:
            text += f", finds {100 * self.found / self.dangerous:.1f} % of {self.dangerous} dangerous ones"
        return text

    def warning(self) -> str | None:
        """Return a sentence on why this operating point is unreliable, or None."""
        if self.silent:
            return (
                f"no threshold has {100 * self.target:g} % false alarms or fewer: "
                "safe gestures have the highest probabilities too, no alarm will be raised"
            )
        if self.useless:
            return f"{self.sentence()}: it hides dangerous touches"
        if self.safe < ENOUGH:
            return f"{self.sentence()}; {ENOUGH} are needed to rely on that rate"
        return None

    def announced(self, say: Callable[[str], None]) -> float:
        """Return the threshold for a live view; say how it was chosen, if it was chosen now.

        Raises:
            InputError: it hides dangerous touches.
        """
        if self.useless:
            raise InputError(
                f"{self.warning()}: train with more gestures, or give a lower threshold, which has more "
                f"false alarms, such as live.patience.above={min(self.threshold, 1.0) / 2:.1g}"
            )
        if not math.isnan(self.target):  # else it was said where it was read
            say(self.sentence())
        return self.threshold

    def text(self) -> str:
        """Return the operating point as JSON, for :func:`parse_operating_point`."""
        return json.dumps(asdict(self) | {"label": LABEL})


def parse_operating_point(text: str) -> OperatingPoint | None:
    """Return an operating point from its JSON; None for ``null``, of a task without ``dangerous``.

    Raises:
        InputError: the text is not an operating point.
    """
    try:
        stored = json.loads(text)
        if stored is None:
            return None
        point = OperatingPoint(
            float(stored["threshold"]),
            float(stored["target"]),
            int(stored["safe"]),
            int(stored["raised"]),
            None if stored["seed"] is None else int(stored["seed"]),
            int(stored["dangerous"]),
            int(stored["found"]),
        )
        usable = (
            stored["label"] == LABEL and 0 < point.threshold < math.inf and 0 < point.target < 1,
            0 <= point.raised <= point.safe and 0 <= point.found <= point.dangerous,
        )
        if not all(usable):
            raise ValueError(text)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise InputError(
            f"the stored operating point {text[:200]!r} cannot be read: train the run again, or give the "
            "threshold to skin live as live.patience.above=0.5"
        ) from error
    return point


def dangerous_column(probabilities: "Tensor", labels: "Tensor", task: Task) -> "tuple[Tensor, Tensor]":
    """Return probabilities (B',) and truth (B',), bool, of the gestures for which the label is defined."""
    column = task.names.index(LABEL)
    rows = task.counts(labels)[:, column]
    return probabilities[rows, column], labels[rows, column] > 0.5


# The point that follows a provisional one, from all touches, chosen in a process beside a live view.


def start_beside(target: Callable[..., object], name: str, *arguments: Any) -> tuple[BaseProcess, Connection]:
    """Start a process beside a live view; to be called in the main thread.

    Args:
        target: its function, of the arguments and of the other end of the pipe.
        name: of the process.
        arguments: that can be sent to it.

    Returns:
        The process, and the end of the pipe.
    """
    context = get_context("spawn")
    pipe, end = context.Pipe()
    process = context.Process(target=target, args=(*arguments, end), name=name, daemon=True)
    # A process that begins while Ctrl-C is ignored ignores it for good.
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    process.start()
    signal.signal(signal.SIGINT, handler)
    end.close()
    return process, pipe


def _choose(source: "AlarmSource", live: LiveConditions, pipe: Connection) -> None:
    """Send the threshold, or why there is none; low priority keeps verdicts in time."""
    import torch

    from skin.evaluation.alarm import choose_alarm_threshold

    # Ends with the view, also where that is killed.
    Thread(target=lambda: pipe.poll(None) and os._exit(1), daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(10)  # below the estimates of contacts
    torch.set_num_threads(1)
    with redirect_stderr(io.StringIO()):  # of the progress
        try:
            point = choose_alarm_threshold(source, live, say=lambda text: None)
            assert point is not None
            point.announced(lambda text: None)  # refuses one that hides dangerous touches
            pipe.send(point)
        except InputError as error:
            pipe.send(str(error))


class FinalThreshold:
    """The threshold that follows a provisional one, and the process that chooses it.

    Args:
        source: the model and what it is used on.
        live: conditions of the live view.
    """

    def __init__(self, source: "AlarmSource", live: LiveConditions) -> None:
        self.process, self._pipe = start_beside(_choose, "skin-threshold", source, live)

    def take(self) -> OperatingPoint | str | None:
        """Return the threshold, or why there is none, once that is known; None before and afterwards."""
        if self._pipe.closed or not self._pipe.poll():
            return None
        answer: OperatingPoint | str = "the process that chooses the final one has ended"
        with suppress(EOFError, OSError):
            answer = self._pipe.recv()
        self.close()
        return answer

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self._pipe.close()
