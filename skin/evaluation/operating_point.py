"""The threshold of the alarm "dangerous" for a given false-alarm rate.

It is chosen for one window of each gesture, or for touches as the live view watches them: the highest score
of the decisions while a touch lasts.
"""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import ceil
from typing import Protocol

import numpy as np
import torch
from scipy.stats import binomtest
from sklearn.metrics import roc_curve
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from skin.core.rng import Stream, generator
from skin.device.base import AbstractDevice, AbstractSimulated
from skin.device.sampling import between_frames, draw_constants
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.decisions import DECISIONS, as_press, held_frames, longest_shown
from skin.evaluation.settings import ENOUGH, Evaluation, check_evaluation
from skin.touch.labels import RELEASE, TOUCH, Task
from skin.touch.movie import Movie

LABEL = "dangerous"
_APART = 1e-6  # scores closer than this may have another order on another processor
_MOST_DRAWS = 6
SAFE_TOUCHES = 2000
"""Safe touches on which a threshold is chosen: where 2 % are wanted, the rate is then 1.4 to 2.7 % (95 %)."""
DANGEROUS_TOUCHES = 400
"""Dangerous touches on which a threshold of the live view is checked: 75 % are then 71 to 79 % (95 %)."""
_HIDDEN = 0.25  # share of dangerous touches that a threshold may hide
_TOUCHES = 50  # touches
_WINDOWS = 500  # windows that are classified at once
_AFTER = 1.0  # s that are simulated behind the window of a touch


class Predictor(Protocol):
    """The interface that an evaluation needs: a trained learner, an ensemble of runs, or a peer."""

    def probabilities(self, touches: Touches) -> Tensor:
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
        """Whether the threshold is so high, or not a number, that no probability raises the alarm."""
        return not self.threshold < 1

    @property
    def useless(self) -> bool:
        """Whether it is silent, or more than a quarter of the dangerous touches raise no alarm when live."""
        return self.silent or (
            self.rate is not None and self.dangerous - self.found > _HIDDEN * self.dangerous
        )

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
        rule = f"alarm above {self.threshold:.4f}"
        if not self.safe:
            return f"{rule}: not chosen on any gestures, its false-alarm rate is unknown"
        kind = "safe validation" if self.seed is None else "fresh safe"
        what = "gestures" if self.rate is None else f"touches at {self.rate:.3g} Hz"
        text = f"{rule}, chosen on {self.safe} {kind} {what} for {100 * self.target:g} % false alarms"
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
        usable = stored["label"] == LABEL and point.threshold > 0 and 0 < point.target < 1
        counted = 0 <= point.raised <= point.safe and 0 <= point.found <= point.dangerous
        if not usable or not counted or not math.isfinite(point.threshold):
            raise ValueError(text)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise InputError(
            f"the stored operating point {text[:200]!r} cannot be read: train the run again, or give the "
            "threshold to skin live as live.patience.above=0.5"
        ) from error
    return point


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
        _, dangerous = _column(touches.known_labels, touches.known_labels, device.task)
        if int((~dangerous).sum()) >= settings.safe_gestures:
            break
        count *= 2
    return touches


def choose_operating_point(
    learner: Predictor, device: AbstractDevice, settings: Evaluation
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
    labels, chances = touches.known_labels, learner.probabilities(touches)
    chance, dangerous = _column(chances, labels, device.task)
    if dangerous.all():
        return OperatingPoint.default(target)
    seed = None if device.simulation is None else device.simulation.data_seed
    point = OperatingPoint(lowest_threshold(chance[~dangerous], target), target, 0, 0, seed)
    return replace(point, **asdict(point.reached(chances, labels, device.task)))


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


@dataclass(frozen=True)
class Watching:
    """How a live view watches a skin.

    Attributes:
        rate: of the device, Hz.
        contact: N above the baseline that count as contact.
        longest: s, longest touch of the training.
        patience: s for which decisions must be dangerous before the alarm is raised.
        column: of ``dangerous`` among the labels of the learner.
        aligned: a device at the model's rate gives the frames of the model, as the simulator does; otherwise
            it reads at any phase of their intervals.
    """

    rate: float
    contact: float
    longest: float
    patience: float
    column: int
    aligned: bool = False

    def decisions(self, rate: float) -> int:
        """Return how many decisions in a row raise the alarm, for a device of ``rate``, Hz."""
        return max(1, ceil(self.patience * min(DECISIONS, rate) - 1e-6))


@torch.inference_mode()
def choose_for_touches(
    learner: Predictor,
    device: AbstractSimulated,
    watching: Watching,
    target: float,
    count: int = SAFE_TOUCHES,
    dangerous: int = 0,
    report: Callable[[int], None] | None = None,
) -> OperatingPoint:
    """Return the threshold at which a share of safe touches raises the alarm of the live view.

    Args:
        learner: trained.
        device: simulates and measures the touches; with ``randomise``, each with another device.
        watching: how they are watched.
        target: largest share of safe touches that raise the alarm.
        count: number of safe touches.
        dangerous: number of dangerous touches; how many of them raise the alarm is counted.
        report: called with the number of touches that are done.
    """
    labels = device.sampler.balanced(2 * max(count, dangerous), generator(Stream.ALARM, device.data_seed, 1))
    danger = labels[:, TOUCH.names.index(LABEL)]
    safe, others = labels[~danger][:count], labels[danger][:dangerous]
    scores = touch_scores(learner, device, watching, np.concatenate([safe, others]), device.data_seed, report)
    threshold = lowest_threshold(scores[: len(safe)], target)
    point = OperatingPoint(threshold, target, len(safe), 0, device.data_seed, len(others))
    alarms = point.alarm(scores)
    return replace(point, raised=int(alarms[: len(safe)].sum()), found=int(alarms[len(safe) :].sum()))


@torch.inference_mode()
def touch_scores(
    learner: Predictor,
    device: AbstractSimulated,
    watching: Watching,
    labels: np.ndarray,
    seed: int,
    report: Callable[[int], None] | None = None,
) -> Tensor:
    """Return the score of each touch: it raises the alarm at thresholds below.

    Args:
        learner, device, watching: as in :func:`choose_for_touches`.
        labels: (B, 4), bool, of the touches.
        seed: of the touches and their devices.
        report: called with the number of touches that are done.

    Returns:
        (B,), the largest over the decisions of the smallest probability of ``dangerous`` among as many
        decisions in a row as the patience needs; 0 without contact.
    """
    device = device.replace(padded=False, stream=False)
    scores = list[Tensor]()
    for first in range(0, len(labels), _TOUCHES):
        batch, draw = labels[first : first + _TOUCHES], generator(Stream.ALARM, seed, 2, first)
        movie = device.sampler.sample(len(batch), draw, batch)
        readings, valid, contact = _decision_windows(device, movie, watching, draw)
        chances = torch.zeros(contact.shape)
        chances[contact] = _classify_windows(
            learner, device, watching, readings[contact], valid[contact.nonzero()[:, 0]]
        )
        row = watching.decisions(_round_rate(device, watching))
        least = -max_pool1d(-pad(chances, (row - 1, 0)), row, 1) if row > 1 else chances
        scores.append(least.amax(dim=1))
        if report is not None:
            report(first + len(batch))
    return torch.cat(scores)


def _round_rate(device: AbstractSimulated, watching: Watching) -> float:
    """Return the rate of the device, rounded to a multiple of the model's, Hz."""
    return max(1, round(watching.rate / device.model_rate)) * device.model_rate


def _decision_windows(
    device: AbstractSimulated, movie: Movie, watching: Watching, draw: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the windows (B, J, T, S), N, of J decisions about each touch, as the model sees them.

    Returns:
        windows; valid (B, S); contact (B, J), whether something touches the skin at each decision.
    """
    readings, valid = _measure_touches(device, movie, watching, draw)
    rate, window = _round_rate(device, watching), device.window
    ratio = round(rate / device.model_rate)
    # Each place holds the maximum over the interval of the model that begins there.
    highest = max_pool1d(readings.transpose(1, 2), ratio, 1).transpose(1, 2)
    end = _draw_decisions(readings.shape, ratio * window, max(1.0, rate / DECISIONS), draw)
    place = end[:, :, None] - ratio * torch.arange(window, 0, -1) + 1
    windows = highest[torch.arange(len(end))[:, None, None], place]
    risen = (windows >= watching.contact) & valid[:, None, None]
    recent = max(1, ceil(RELEASE * device.model_rate - 1e-9))
    contact = risen[:, :, -recent:].flatten(2).any(dim=2)
    held = held_frames(watching.longest, device.model_rate, window)
    begun = torch.where(contact, end, torch.iinfo(end.dtype).max).amin(dim=1, keepdim=True)
    lasted = (end - begun) / ratio + 1
    for touch, decision in (contact & (lasted > longest_shown(held, recent, window))).nonzero().tolist():
        press = as_press(windows[touch, 0].numpy(), windows[touch, decision].numpy(), held)
        windows[touch, decision] = torch.from_numpy(press)
    return windows * valid[:, None, None], valid, contact


def _measure_touches(
    device: AbstractSimulated, movie: Movie, watching: Watching, draw: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return what devices read of touches after a window of rest, (B, F, S), N, and their valid sensors."""
    force = device.model.respond(movie, displacement=False).readings
    before, after = device.window, ceil(_AFTER * device.model_rate)
    padded, rate = pad(force, (0, 0, before, after)), _round_rate(device, watching)
    if rate > device.model_rate or not watching.aligned:
        padded = between_frames(padded, device.model_rate, rate, draw.random(len(padded)))
    imperfection = replace(device.imperfection, rate=rate)
    gestures = len(padded) if getattr(device, "randomise", False) else None
    constants = draw_constants(imperfection, padded.shape[2], device.model_rate, draw, gestures)
    # A drift is 0 where the touch begins, as in other gestures: the live view follows it without contact.
    time = torch.arange(padded.shape[1]) / rate - before / device.model_rate
    readings, valid, _ = imperfection.apply(padded, constants, draw, time)
    return readings, valid[:, 0]


def _draw_decisions(shape: torch.Size, first: int, step: float, draw: np.random.Generator) -> Tensor:
    """Return the frames at which it is decided about each touch, (B, J): the ticks have any phase to it."""
    begin = first - 1 + step * draw.random(shape[0])
    count = int((shape[1] - first - step) / step)
    ends = np.floor(begin[:, None] + step * np.arange(count)).astype(np.int64)
    return torch.from_numpy(ends)


def _classify_windows(
    learner: Predictor, device: AbstractSimulated, watching: Watching, readings: Tensor, valid: Tensor
) -> Tensor:
    """Return the probability of ``dangerous`` of windows (W, T, S) with valid sensors (W, S), (W,)."""
    positions = torch.from_numpy(device.sensors.positions).float()
    mask = valid[:, None].expand_as(readings)
    parts = [
        learner.probabilities(Touches(*part, positions, None, device.model_rate))[:, watching.column]
        for part in zip(readings.split(_WINDOWS), mask.split(_WINDOWS), strict=True)
    ]
    return torch.cat(parts).nan_to_num(1.0) if parts else torch.zeros(0)


# Contact detection by a threshold (report, section 4.2).


Gate = Callable[[Touches, Tensor], Tensor]
"""Maps windows and their probabilities (B, L) to predicted contact, (B,), bool."""


def rise(touches: Touches, idle: Tensor | float = 0.0) -> Tensor:
    """Return the largest rise of each window above the untouched skin, (B,), N; at least 0.

    The baseline is not taken from the window: a touch held throughout it would become the baseline.

    Args:
        touches: invalid readings are ignored.
        idle: (S,), N, readings of the untouched skin; 0 after a tare.
    """
    return ((touches.readings - idle) * touches.valid).flatten(1).amax(dim=1).clamp(min=0)


@dataclass(frozen=True)
class ContactThreshold:
    """Predicts contact if a reading rises by ``least`` N or more above its baseline.

    Attributes:
        least: N.
        idle: (S,), N, as in :func:`rise`.
    """

    least: float
    idle: Tensor | float = 0.0

    @classmethod
    def tuned(cls, rises: Tensor, touched: Tensor, idle: Tensor | float = 0.0) -> "ContactThreshold":
        """Return the threshold of the highest balanced accuracy.

        Args:
            rises: (B,), N, from :func:`rise`, of windows that are not used for testing.
            touched: (B,), bool.
            idle: (S,), N, as in :func:`rise`.

        Raises:
            InputError: all windows are touched, or none is.
        """
        if touched.all() or not touched.any():
            raise InputError(
                f"{len(touched)} validation windows are all alike, with touch or all without: "
                "give more with data.gestures"
            )
        alarms, detected, levels = roc_curve(touched.numpy(), rises.numpy())
        return cls(float(levels[int((detected - alarms).argmax())]), idle)

    def touched(self, touches: Touches) -> Tensor:
        """Return which windows are touched, (B,), bool."""
        return rise(touches, self.idle) >= self.least


def gates(threshold: ContactThreshold, task: Task) -> dict[str, Gate]:
    """Return the gates by name: ``none`` lets all through; ``learned`` only where the task has a gate."""
    gates: dict[str, Gate] = {
        "none": lambda touches, chances: torch.ones(len(touches), dtype=torch.bool),
        "threshold": lambda touches, chances: threshold.touched(touches),
    }
    if task.gate is not None:
        gate = task.names.index(task.gate)
        gates["learned"] = lambda touches, chances: chances[:, gate] > 0.5
    return gates
