"""Watch a skin for sensors that have changed since its first touches, by tests that may run for ever.

Each touch gives one residual per sensor: its reading, against what the other sensors say that it should be. A
residual is ranked among those of earlier touches, and tests bet on its rank. While nothing has changed, no
way of betting multiplies capital on average, so that the mean capital of all tests reaches 20 times the first
one with a probability of at most 1/20 (Ville 1939), however long the skin is watched.

That rests on:

1. Touches are exchangeable until a sensor changes: any order of them is equally likely. Hands and several
   fingertips are among the first touches as often as among the later ones.
2. The scores of the sensors of a touch are distributed alike. They are predictive probabilities, which allow
   for noise, gains and positions as far as they are known: a device that is calibrated satisfies it nearly.
3. What drift adds is below the least score that counts, and need not be exchangeable.

A sensor that is wrong from the first touch on is not seen. Nor is a gain where a touch reaches one sensor
alone, as on a thin layer: the force is as unknown as the gain. There, only untouched sensors tell something.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincc, ndtr

from skin.inference.candidates import CandidateReadings, FingertipPrior
from skin.inference.contact import blur_first
from skin.inference.likelihood import Observation, blend, fit_force
from skin.inference.noise import Noise

THRESHOLD = 20.0
"""Mean capital of all tests at which sensors are reported; 1/20 bounds the probability of a false report."""

_FORCE, _SPREAD = 10.0, 1.2  # N, and of its logarithm: of touches of any kind, 0.9 to 110 N
_RISEN = 5.0  # standard deviations above rest: two such sensors are a touch; one may be broken
_DRIFT = 0.005  # N, what the baseline leaves: it follows 0.3 mN/s, and touches are some 15 s apart
_LIKELY = 12.0  # log of the evidence below the largest one from which a box does not count
_POOR = 1e-4  # predictive probability of the others below which one of them is broken, or it is a hand
_LOADED = 2.0  # expected reading in standard deviations from which a lost gain is sought
_FELT = 6.6  # minus the log of a probability of 0.14 %, of three standard deviations: drift stays below
_HALF = 10  # scores after which about half of the cash is staked
_RANKS = np.array([0.05, 0.2, 0.6])  # ranks up to which bets win: strong evidence in each touch, or weak
_KEPT = 0.4  # fraction of a stake that a bet cannot lose


class Prediction(NamedTuple):
    """How each reading agrees with a fingertip that gives the readings of the others.

    Attributes:
        expected: (S,), in standard deviations.
        less, more: (S,), minus the log of the predictive probability of such a reading or a smaller one, and
            of such a reading or a larger one.
        fits: (S,), bool, the reading is valid, and the others fit one fingertip.
    """

    expected: np.ndarray
    less: np.ndarray
    more: np.ndarray
    fits: np.ndarray


def predict_from_others(
    candidates: CandidateReadings, prior: FingertipPrior, blurred: np.ndarray, frame: Observation
) -> Prediction:
    """Return how each reading of a touch agrees with the others.

    The sensor itself is left out: it would draw the fingertip towards what it says.

    Args:
        candidates: of the skin; the first boxes are fine enough for a sensor that is left out.
        prior: of the fingertip.
        blurred: relative variance of the first boxes (:func:`skin.inference.contact.blur_first`).
        frame: of the touch.
    """
    table = candidates.readings
    expected, less, more, fits = np.zeros((4, len(frame.readings)))
    for sensor in np.flatnonzero(frame.counts):
        others = frame.counts.copy()
        others[sensor] = 0
        forces, evidence = fit_force(replace(frame, counts=others), prior, table, blurred)
        likely = evidence > evidence.max() - _LIKELY
        weight = np.exp(evidence[likely].astype(float) - evidence.max())
        weight /= weight.sum()
        force, spread = np.exp(forces.mode[likely, None]), 1 / forces.curvature[likely]
        tangent, *_ = forces.tangent(np.exp(forces.mode))
        predicted = force * blend(table, tangent)[likely]
        variance = force**2 * blurred[likely] + frame.noise.floor
        misfit = weight @ (((frame.readings - predicted) ** 2 / variance) @ others)
        # Four parameters of a fingertip are fitted.
        fits[sensor] = gammaincc(max(others.sum() - 4, 1) / 2, misfit / 2) > _POOR
        mean = predicted[:, sensor]
        deviation = np.sqrt(mean**2 * spread + variance[:, sensor])
        above = (frame.readings[sensor] - mean) / deviation
        probabilities = [max(float(weight @ ndtr(side)), 1e-300) for side in (above, -above)]
        less[sensor], more[sensor] = -np.log(probabilities)
        middle = weight @ mean
        expected[sensor] = middle / np.sqrt(weight @ ((mean - middle) ** 2 + deviation**2))
    return Prediction(expected, less, more, fits > 0)


class RankTests:
    """A test for each sensor, which bets on the ranks of its scores among those of earlier touches.

    Args:
        sensors: their number.
    """

    def __init__(self, sensors: int) -> None:
        self._cash, self._staked = np.ones(sensors), np.zeros((sensors, len(_RANKS)))
        self._scored, self._touches = np.zeros(sensors), 0
        self._scores, self._weights = np.empty(0), np.empty(0)

    @property
    def capital(self) -> np.ndarray:
        """Capital of each test, (S,); 1 at first."""
        return self._cash + self._staked.sum(1)

    def add(self, scores: np.ndarray, which: np.ndarray) -> None:
        """Bet on the scores of a touch.

        Args:
            scores: (S,), large if a sensor is broken.
            which: (S,), bool, sensors that have a score.
        """
        new = scores[which]
        if not len(new):
            return
        # Each touch counts once, as its sensors are not independent. If they are equal, ranks are uniform and
        # independent of earlier ones (Renyi 1962); if they are independent, these ranks are larger than such
        # ones, against the bet; what lies between is not proven, but tested. Ties count against the bet, too.
        above = self._weights @ (self._scores[:, None] >= new)
        rank = (1 + above) / (1 + self._touches)
        # A stake depends on earlier touches alone. It falls as 1/n, so that cash lasts for late changes.
        stake = self._cash[which] / (_HALF + self._scored[which])
        self._cash[which] -= stake
        # Bets fall with the rank and integrate to 1: their mean over equal ranks 1/n, ..., 1 is less.
        growth = _KEPT + (1 - _KEPT) * 2 / _RANKS * np.maximum(1 - rank[:, None] / _RANKS, 0)
        self._staked[which] = (self._staked[which] + stake[:, None] / len(_RANKS)) * growth
        self._scored[which] += 1
        self._touches += 1
        self._scores = np.append(self._scores, new)
        self._weights = np.append(self._weights, np.full(len(new), 1 / len(new)))


class Watch:
    """Finds sensors that have changed since the first touches. A tare or a calibration needs a new one.

    Args:
        candidates: of the skin.
        prior: of fingertips; their forces may be any.
        noise: of such devices: gains and positions.

    Attributes:
        changed: sensors that have changed; empty at first.
    """

    def __init__(self, candidates: CandidateReadings, prior: FingertipPrior, noise: Noise) -> None:
        self._candidates, self._prior = candidates, replace(prior, force=_FORCE, spread=_SPREAD)
        self._blurred, sensors = blur_first(candidates, noise)[1], candidates.sensors
        # A lost gain or a dead sensor reads too little under load, an offset too much; a frozen sensor one of
        # both, as it was frozen untouched or touched.
        self._less, self._more = RankTests(sensors), RankTests(sensors)
        self.changed: tuple[int, ...] = ()
        self._begin()

    def _begin(self) -> None:
        """Wait for the next touch."""
        self._sum, self._valid, self._moments = np.zeros(1), np.ones(1, dtype=bool), 0

    @property
    def capital(self) -> np.ndarray:
        """Mean capital of the tests of each sensor, (S,)."""
        return (self._less.capital + self._more.capital) / 2

    def look(self, readings: np.ndarray, valid: np.ndarray, noise: Noise) -> tuple[int, ...]:
        """Take the mean readings of a moment; return the sensors that have changed.

        A touch counts once, when it has ended, by its mean: readings are proportional to the force.

        Args:
            readings: (S,), N.
            valid: (S,), bool, neither invalid nor saturated.
            noise: of the moment. Moments overlap by half at most.
        """
        if np.count_nonzero(valid & (readings > _RISEN * noise.floor**0.5)) > 1:
            self._sum, self._valid = self._sum + readings, self._valid & valid
            self._moments += 1
        elif self._moments:
            frames, offset = max(1, noise.frames * self._moments // 2), max(noise.offset, _DRIFT)
            noise = replace(noise, frames=frames, offset=offset)
            mean, none = self._sum / self._moments, np.zeros(len(readings), dtype=bool)
            self.add(Observation.of(mean, self._valid, none, noise))
            self._begin()
        return self.changed

    def add(self, touch: Observation) -> None:
        """Take the mean readings of a touch."""
        self.judge(predict_from_others(self._candidates, self._prior, self._blurred, touch))

    def judge(self, prediction: Prediction) -> None:
        """Take a touch that has been compared with what it should be."""
        expected, less, more, fits = prediction
        self._less.add(less, fits & (expected >= _LOADED))
        self._more.add(np.maximum(more, _FELT), fits)
        capital = self.capital
        if capital.mean() >= THRESHOLD:
            # Those without which there would be no report.
            found = np.flatnonzero(capital >= 0.1 * capital.max())
            self.changed = tuple(sorted({*self.changed, *found.tolist()}))
