"""The threshold of the alarm "dangerous" for a given false-alarm rate."""

import json
import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from skin.config import Evaluation
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.evaluation.alarm import Reached
from skin.labels import Task
from skin.recording import Touches

if TYPE_CHECKING:
    from skin.evaluation.report import Predictor

LABEL = "dangerous"
ENOUGH = 2000
"""Safe gestures; where 2 % are wanted, the true rate is then 1.4 to 2.7 % (95 %). 5000: 1.6 to 2.4 %."""

_APART = 1e-6  # scores closer than this may have another order on another processor
_MOST_DRAWS = 6


@dataclass(frozen=True)
class OperatingPoint:
    """An alarm is raised where the probability of ``dangerous`` is greater than the threshold.

    Attributes:
        threshold: exactly representable as float32, so that comparisons do not depend on the precision.
        target: largest wanted false-alarm rate.
        safe: number of safe gestures on which it was chosen; 0: the default of 0.5 was not chosen on any.
        raised: how many of them raise the alarm.
        seed: of the fresh gestures on which it was chosen; None: it was chosen on a validation split.
        dangerous: number of dangerous gestures among those on which it was chosen.
        found: how many of them raise the alarm.
        rate: of the device, Hz, where the threshold was chosen for the alarm of the live view, which judges
            many windows of a touch; None: it was chosen for one window of each gesture.
    """

    threshold: float
    target: float
    safe: int
    raised: int
    seed: int | None
    dangerous: int = 0
    found: int = 0
    rate: float | None = None

    @classmethod
    def default(cls, target: float) -> "OperatingPoint":
        """Return a threshold of 0.5, whose false-alarm rate is unknown."""
        return cls(0.5, target, 0, 0, None)

    @property
    def silent(self) -> bool:
        """Whether the threshold is so high that no probability raises the alarm."""
        return self.threshold >= 1

    def alarm(self, chance: Tensor) -> Tensor:
        """Return which probabilities raise the alarm, bool, in the shape of ``chance``."""
        return chance > self.threshold

    def reached(self, chances: Tensor, labels: Tensor, task: Task) -> Reached:
        """Return the alarms on gestures with probabilities (B, L) and labels (B, L)."""
        chance, dangerous = _column(chances, labels, task)
        alarm = self.alarm(chance)
        counts = dangerous.sum(), (alarm & dangerous).sum(), (~dangerous).sum(), (alarm & ~dangerous).sum()
        return Reached(*(int(count) for count in counts))

    def sentence(self) -> str:
        """Return a sentence with the threshold and how it was chosen."""
        wanted = f"alarm above {self.threshold:.4f}"
        if not self.safe:
            return f"{wanted}: not chosen on any gestures, its false-alarm rate is unknown"
        kind = "safe validation" if self.seed is None else "fresh safe"
        what = "gestures" if self.rate is None else f"touches at {self.rate:.3g} Hz"
        text = f"{wanted}, chosen on {self.safe} {kind} {what} for {100 * self.target:g} % false alarms"
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
        if self.safe < ENOUGH:
            return f"{self.sentence()}; {ENOUGH} are needed to rely on that rate"
        return None

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
        known = stored["label"] == LABEL and point.threshold > 0 and 0 < point.target < 1
        counted = 0 <= point.raised <= point.safe and 0 <= point.found <= point.dangerous
        if not known or not counted or not math.isfinite(point.threshold):
            raise ValueError(text)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise InputError(
            f"the stored operating point {text[:200]!r} cannot be read: train the run again, or give the "
            "threshold to skin live as live.patience.above=0.5"
        ) from error
    return point


def check_evaluation(settings: Evaluation) -> None:
    """Raise InputError where the settings of an evaluation cannot be used."""
    for name, least in (("devices", 0), ("layouts", 0)):
        if getattr(settings, name) < least:
            raise InputError(f"evaluation.{name}={getattr(settings, name)} must be at least {least}")
    if not 0 < settings.false_alarm_rate < 1:
        raise InputError(
            f"a false-alarm rate is between 0 and 1, got {settings.false_alarm_rate:g}: "
            "use evaluation.false_alarm_rate=0.02"
        )
    if settings.safe_gestures < 1:
        raise InputError(
            "the alarm's threshold is chosen on 1 safe gesture or more, got "
            f"{settings.safe_gestures}: use evaluation.safe_gestures={ENOUGH}"
        )


def threshold_gestures(device: AbstractDevice, settings: Evaluation) -> Touches:
    """Return the gestures on which the threshold is chosen.

    A simulated device draws fresh gestures until enough of them are safe; other devices give their validation
    split.
    """
    check_evaluation(settings)
    simulation = device.simulation
    if simulation is None or LABEL not in device.task.names:
        return device.touches("validation")
    # Half of the sampled gestures are safe; some windows of streams show no touch.
    count = 2 * settings.safe_gestures
    for _ in range(_MOST_DRAWS):
        touches = simulation.fresh_touches(count)
        assert touches.labels is not None
        _, dangerous = _column(touches.labels, touches.labels, device.task)
        if int((~dangerous).sum()) >= settings.safe_gestures:
            break
        count *= 2
    return touches


def choose_operating_point(
    learner: "Predictor", device: AbstractDevice, settings: Evaluation
) -> OperatingPoint | None:
    """Return the operating point of a trained learner; None if its task has no label ``dangerous``.

    Args:
        learner: trained on ``device``.
        device: gives the gestures; see :func:`threshold_gestures`.
        settings: the target rate and the number of safe gestures.
    """
    if LABEL not in device.task.names:
        return None
    touches, target = threshold_gestures(device, settings), settings.false_alarm_rate
    assert touches.labels is not None  # the learner was trained on them
    chances = learner.probabilities(touches)
    chance, dangerous = _column(chances, touches.labels, device.task)
    if dangerous.all():
        return OperatingPoint.default(target)
    seed = None if device.simulation is None else device.simulation.data_seed
    point = OperatingPoint(lowest_threshold(chance[~dangerous], target), target, 0, 0, seed)
    return replace(point, **asdict(point.reached(chances, touches.labels, device.task)))


def lowest_threshold(safe: Tensor, target: float) -> float:
    """Return the lowest threshold that keeps the false-alarm rate, a float32 number.

    At most k = floor(target (n + 1)) - 1 of n safe gestures raise the alarm. A new safe gesture then raises
    it with a probability of at most (k + 1) / (n + 1) <= target (split conformal prediction; Vovk, Gammerman
    and Shafer 2005). If n < 1 / target - 1, the threshold is above all scores, and the target is not met.
    Scores that differ by less than 2e-6 count as equal: either all of them raise the alarm or none.

    Args:
        safe: (n,), n > 0, probabilities of ``dangerous`` of safe gestures.
        target: largest rate.
    """
    scores = safe.detach().cpu().double().sort(descending=True).values
    # 1e-9 keeps a product such as 0.29 * 100 from rounding below its whole number.
    allowed = max(math.floor(target * (len(scores) + 1) + 1e-9) - 1, 0)
    gaps = scores[:-1] - scores[1:] > 2 * _APART  # [i]: between the first i + 1 scores and the others
    cuts = torch.nonzero(gaps[:allowed]).flatten()
    above = int(cuts[-1]) + 1 if len(cuts) else 0
    return float((scores[above] + _APART).float())


def _column(chances: Tensor, labels: Tensor, task: Task) -> tuple[Tensor, Tensor]:
    """Return probabilities (B',) and truth (B',), bool, of the gestures for which the label is defined."""
    place = task.names.index(LABEL)
    rows = task.counts(labels)[:, place]
    return chances[rows, place], labels[rows, place] > 0.5
