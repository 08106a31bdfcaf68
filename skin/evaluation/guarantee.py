"""What an alarm promises: bounds on the fraction of missed touches, and thresholds that keep them.

A touch counts if its pressure is above 1.1 times the limit and it is on a sensor: the area above the limit
contains the centre of a valid sensor. All bounds are exact for the finite number of touches, and suppose that
the touches to come are drawn as these were. torch is not imported.
"""

import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import bdtr, betainc, betaln

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.evaluation.decisions import LiveConditions
from skin.wire.channels import NewtonFrame
from skin.wire.tare import FEWEST, MakeConversion, Tare

MARGIN = 1.1
"""Times the limit, above which a touch counts: nearer to it, gains known to 5 % decide what is dangerous."""
CONFIDENCE = 0.95
SAFE = 0.9
"""Times the limit, below which a press counts as safe."""
_SAME = 0.1  # relative difference of rates: a measured one is never the same twice
_APART = 1e-6  # scores closer than this may have another order on another processor


def counted(peak: np.ndarray, sensed: np.ndarray) -> np.ndarray:
    """Return which touches a guarantee is about, (B,), bool.

    Args:
        peak, sensed: (B,), largest pressure, and largest at a valid sensor, in multiples of the limit, as in
            :class:`skin.evaluation.touch_scores.TouchDecisions`.
    """
    return (peak > MARGIN) & (sensed > 1)


# Touches that are all there before the bound is taken.


def allowed_misses(touches: int, rate: float, confidence: float = CONFIDENCE) -> int:
    """Return the largest number of misses whose bound is at most ``rate``; -1: there are too few touches."""
    chances = bdtr(np.arange(touches + 1), touches, rate)
    return int(np.searchsorted(chances, 1 - confidence, side="right")) - 1


def touches_needed(rate: float, confidence: float = CONFIDENCE) -> int:
    """Return the least number of touches, none of them missed, whose bound is at most ``rate``."""
    return math.ceil(math.log(1 - confidence) / math.log1p(-rate))


def touches_drawn(rate: float) -> int:
    """Return how many dangerous touches to draw for a threshold with a bound of ``rate``.

    Half of them or more count. With three times as many as are needed, some may be missed, so that the
    threshold does not hang on a single touch.
    """
    return 4 * touches_needed(rate)


def threshold_above(scores: np.ndarray, allowed: int) -> float:
    """Return the lowest threshold, a float32 number, that at most ``allowed`` of the scores (n,) exceed.

    Scores that differ by less than 2e-6 count as equal: either all of them exceed it or none.
    """
    scores = np.sort(scores)[::-1]
    gaps = scores[:-1] - scores[1:] > 2 * _APART  # [i]: between the first i + 1 scores and the others
    cuts = np.flatnonzero(gaps[:allowed])
    above = int(cuts[-1]) + 1 if len(cuts) else 0
    return float(np.float32(scores[above] + _APART))


def threshold_for_misses(scores: np.ndarray, rate: float, confidence: float = CONFIDENCE) -> float:
    """Return the highest threshold that misses at most ``rate`` of the touches, with a confidence.

    The thresholds below each score are tested from the lowest on, with the exact binomial p-value of "more
    than ``rate`` are missed", until one is not rejected: Learn then Test with a fixed sequence (Angelopoulos
    et al., 2021). As misses only grow with the threshold, the last that is rejected is an order statistic.

    Args:
        scores: (n,), of touches that count, drawn independently of all that the scores were fitted to.
        rate: largest wanted fraction of missed touches.
        confidence: that it is kept.

    Raises:
        InputError: too few touches, or too many of them without contact.
    """
    allowed, needed = allowed_misses(len(scores), rate, confidence), touches_needed(rate, confidence)
    promise = f"at most {100 * rate:g} % missed, with {100 * confidence:g} %"
    if allowed < 0:
        raise InputError(f"{len(scores)} touches cannot show {promise}: {needed} are needed for this")
    threshold = -threshold_above(-scores, allowed)
    if threshold <= 0:
        raise InputError(
            f"no threshold has {promise}: {(scores < 2 * _APART).sum()} of {len(scores)} dangerous touches "
            "on a sensor are not felt, or look safe; lower live.touch, or use a device with less noise"
        )
    return threshold


# Presses recorded one by one on a real skin.


def anytime_bound(misses: int, presses: int, confidence: float = CONFIDENCE) -> float:
    """Return an upper bound of the fraction of missed presses that holds at all times at once.

    Presses may be added one by one, and one may stop when the bound is low enough: the probability that it is
    ever below the true fraction is at most 1 - ``confidence``. The likelihood of the misses, averaged over
    fractions from 0 to p, over that at p is a martingale if p is true, and a supermartingale if more are
    missed (Ville, 1939; Robbins, 1970). The bound is the p at which it reaches 1 / (1 - ``confidence``).
    """
    from scipy.optimize import brentq  # takes half a second to import

    if misses >= presses:
        return 1.0
    ends = misses + 1.0, presses - misses + 1.0

    def excess(p: float) -> float:
        average = math.log(betainc(*ends, p)) + betaln(*ends) - math.log(p)
        likelihood = misses * math.log(p) + (presses - misses) * math.log1p(-p)
        return float(average - likelihood + math.log(1 - confidence))

    return float(brentq(excess, max(misses / presses, 1e-12), 1 - 1e-12))


def presses_needed(rate: float, misses: int = 0) -> int:
    """Return the least number of presses, with some missed, whose anytime-valid bound is at most ``rate``."""
    return bisect_left(
        range(math.ceil(100 * (misses + 1) / rate)),  # the bound of the most is far below the rate
        True,
        key=lambda presses: anytime_bound(misses, presses) <= rate,
    )


def describe_presses(
    peak: np.ndarray, sensed: np.ndarray, alarmed: np.ndarray, rate: float | None = None
) -> list[str]:
    """Return what presses show of an alarm, and how many more show less, as items of a list in Markdown.

    Args:
        peak, sensed: (P,), as in :func:`counted`.
        alarmed: (P,), bool.
        rate: largest fraction of missed presses that they must show; None: any.

    Raises:
        InputError: they do not show it.
    """
    dangerous, safe = counted(peak, sensed), peak < SAFE
    missed = np.flatnonzero(dangerous & ~alarmed)
    k, n = len(missed), int(dangerous.sum())
    if rate is not None and anytime_bound(k, n) > rate:
        raise InputError(
            f"{k} misses of {n} presses above {MARGIN:g} x the limit and on a valid sensor do not show "
            f"at most {100 * rate:g} % missed, with {100 * CONFIDENCE:g} %: {presses_needed(rate, k)} "
            "presses are needed for this, if no more are missed"
        )
    named = f" (numbers {', '.join(map(str, missed[:10]))}{', ...' * (k > 10)})" if k else ""
    more = {wanted: presses_needed(wanted, k) - n for wanted in (0.05, 0.01)}
    shown = [
        f"{100 * wanted:g} % needs {f'{count} more' if count > 0 else 'no more'}"
        for wanted, count in more.items()
    ]
    return [
        f"- presses above {MARGIN:g} x the limit and on a valid sensor: {n} of {len(peak)}, {k} missed"
        f"{named}",
        f"- at most {100 * anytime_bound(k, n):.1f} % missed, with {100 * CONFIDENCE:g} %, however many you "
        f"add; to show {' and '.join(shown)}, none of them missed",
        f"- presses below {SAFE:g} x the limit: {safe.sum()}, {(safe & alarmed).sum()} raise the alarm",
    ]


def replay_presses(
    alarms: Callable[[Sequence[NewtonFrame], np.ndarray | None], bool],
    convert: MakeConversion,
    rate: float,
    time: np.ndarray,
    raw: np.ndarray,
    press: np.ndarray,
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return which presses raise the alarm, (P,), bool, and which sensors work before them, (P, S), bool.

    Each press begins with an untouched skin, and with a new tare if the pause before it is long enough.

    Args:
        alarms: tells whether a live view raises the alarm during frames, given the noise of the untouched
            skin (S,), N.
        convert: makes the conversion of values to N.
        rate: of the model, Hz.
        time: of T frames, s.
        raw: their values, (T, S); NaN where there is none, a whole row where the frame was lost.
        press: (T,), number of the press at each frame; -1: none.
        count: P.

    Raises:
        InputError: the skin was never at rest before a press.
    """
    tare = Tare(convert, FEWEST / rate, rate)
    streams, noise, latest = defaultdict[int, list[NewtonFrame]](list), dict[int, np.ndarray | None](), -1
    alarmed, works = np.zeros(count, dtype=bool), np.zeros((count, raw.shape[1]), dtype=bool)
    values, begun, received = np.zeros(raw.shape[1]), 0, np.flatnonzero(np.isfinite(raw).any(axis=1))
    for row, lost in zip(received, np.diff(received, prepend=received[:1] - 1) - 1, strict=True):
        number, t, valid = int(press[row]), float(time[row]), np.isfinite(raw[row])
        values = np.where(valid, raw[row], values)
        readings = tare.add(Frame(None, t, t, values, valid, 0, int(lost)), number >= 0)
        if number < 0 <= latest:
            tare.restart()
        latest, begun = number, max(begun, number + 1)
        if number < 0 and readings is not None:  # a press that silences a sensor, or all, counts
            works[begun:] = readings.usable
        if readings is not None and tare.conversion is not None and number >= 0:
            streams[number].append(readings)
            noise[number] = tare.conversion.noise
    if not streams:
        raise InputError(f"no press can be judged: {tare.status or 'none follows a rest of the skin'}")
    alarmed[list(streams)] = [alarms(stream, noise[number]) for number, stream in streams.items()]
    return alarmed, works


@dataclass(frozen=True)
class Guarantee:
    """That an alarm misses few of the touches that count, in simulation.

    Attributes:
        rate: largest fraction of missed touches.
        touches: n that count, on which it was shown.
        misses: k of them.
        conditions: profile of the devices and their rate, in words.
        confidence: of the bound.
        device_rate: of the devices, Hz.
        patience: of the live view, s.
        lapsed: why it does not hold for a live view, in words; empty: it holds, or nobody has looked.
        verified: a second reference has confirmed the scale of the device in use, or it needs none.
    """

    rate: float
    touches: int
    misses: int
    conditions: str
    confidence: float = CONFIDENCE
    device_rate: float = 0.0
    patience: float = 0.0
    lapsed: str = ""
    verified: bool = True

    def on_device(self, as_chosen: bool, in_range: bool, verified: bool) -> "Guarantee":
        """Return the guarantee for a device: it lapses with another contact threshold or a short range."""
        lapsed = "live.touch or live.drift is another than it was made for" * (not as_chosen)
        short = f"a range ends below {MARGIN:g} x the limit" * (not in_range)
        return replace(self, lapsed=self.lapsed or lapsed or short, verified=verified)

    def state(self, changed: Sequence[int]) -> Literal["valid", "unverified", "lapsed"]:
        """Return whether it holds for a live view; ``changed``: sensors that a watch reports."""
        return "lapsed" if self.lapsed or changed else "valid" if self.verified else "unverified"

    def at(self, rate: float) -> "Guarantee":
        """Return the guarantee for a device of ``rate``, Hz: it lapses at another than its own."""
        other = f"the device sends {rate:.3g} frames a second, and not {self.device_rate:.3g}"
        return replace(
            self, lapsed=self.lapsed or ("" if abs(self.device_rate / rate - 1) <= _SAME else other)
        )

    def under(self, live: LiveConditions) -> "Guarantee":
        """Return the guarantee for a live view: it lapses at another rate or patience than its own."""
        lapsed = f"live.patience.alarm is {live.patience:g} s, and not {self.patience:g}"
        return replace(self, lapsed=lapsed * (live.patience != self.patience)).at(live.rate)

    def sentence(self) -> str:
        """Return the promise in words, with its conditions."""
        lapsed = f"; lapsed, as {self.lapsed}" if self.lapsed else ""
        return (
            f"in simulation, above {MARGIN:g} x the limit and on a sensor: at most {100 * self.rate:g} % "
            f"missed, {100 * self.confidence:g} %, {self.touches:,} touches, {self.conditions}{lapsed}"
        )
