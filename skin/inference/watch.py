"""What touches say of a skin: sensors that have changed since the first ones, and its thickness.

Tests for changes may run for ever. Each touch gives one residual per sensor: its reading, against what the
other sensors say that it should be. A residual is ranked among those of earlier touches, and tests bet on its
rank. While nothing has changed, no way of betting multiplies capital on average, so that the mean capital of
all tests reaches 50 times the first one with a probability of at most 1/50 (Ville 1939), however long the
skin is watched.

That rests on:

1. Touches are exchangeable until a sensor changes: any order of them is equally likely. Hands and several
   fingertips are among the first touches as often as among the later ones.
2. The scores of the sensors of a touch are distributed alike. They are predictive probabilities, which allow
   for noise, gains and positions as far as they are known: a device that is calibrated satisfies it nearly.
3. What drift adds is below the least score that counts, and need not be exchangeable.

A sensor that is wrong from the first touch on is not seen. Nor is a gain where a touch reaches one sensor
alone, as on a thin layer: the force is as unknown as the gain. There, only untouched sensors tell something.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import gammaincc, logsumexp, ndtr, softmax

from skin.inference.candidates import CandidateReadings, FingertipPrior
from skin.inference.contact import blur_first
from skin.inference.likelihood import Observation, blend, fit_force
from skin.inference.mechanics import Mechanics
from skin.inference.noise import Noise
from skin.inference.posterior import Posterior

THRESHOLD = 50.0
"""Mean capital of all tests at which sensors are reported; 1/50 bounds the probability of a false report."""

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
        every = np.exp(forces.mode)[:, None]
        force, spread = every[likely], 1 / forces.curvature[likely]
        predicted = force * blend(table[likely], forces.tangent(every)[0][likely])[:, 0]
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


# The thickness of the skin.


_COMPARED = 9  # thicknesses; a spline joins what is known of them
_TEMPER = 0.25
"""Power of likelihoods: touches repeat, and operators err by up to 1.5 %. On the touches that chose it
(seed 7 of the contact study), the deviation of the thickness is then 1 to 2.5 times its error."""
_FEW = 20  # touches below which no other thickness is stated


class Thickness:
    """Learns from touches how thick a skin is, and tells its posterior.

    Readings of a skin of another thickness are interpolated between operators for the ends of the range and
    the described one, quadratically in the logarithm: within 0.5 % of the largest reading from 0.75 to 1.3.
    The likelihoods of all touches are multiplied. Touches may have any force, which a posterior's prior may
    not know. The ratio of moduli need not be learned: 0.7 and 1.4 change no figure of a contact.

    Args:
        mechanics: of the skin; the range is ``noise.thickness``.
        posterior: of the skin, with the same noise; it takes the thickness to be the most probable one.

    Attributes:
        factor: mean of the thickness, relative to the described one.
        noise: as of the mechanics, with the range of thickness that is left.
        touches: number of touches so far.
    """

    def __init__(self, mechanics: Mechanics, posterior: Posterior) -> None:
        self.factor, self.noise, self.touches = 1.0, mechanics.noise, 0
        self._posterior, self._described = posterior, mechanics.body.thickness
        self._prior = replace(posterior.prior, force=_FORCE, spread=_SPREAD)
        self._strongest: Observation | None = None
        ends = sorted({*mechanics.noise.thickness, 1.0})
        self._ends = np.log(ends)
        self._parts = [
            posterior.candidates if factor == 1 else mechanics.thicker(factor, posterior.prior)
            for factor in ends
        ]
        self._compared = np.linspace(self._ends[0], self._ends[-1], _COMPARED if len(ends) > 1 else 0)
        self._evidence = np.zeros(len(self._compared))
        certain = replace(mechanics.noise, thickness=(1.0, 1.0))
        self._tables = [
            (skin.readings, blur_first(skin, certain)[1]) for skin in map(self._mixed, self._compared)
        ]

    def _mixed(self, logarithm: float) -> CandidateReadings:
        """Return the readings of fingertips on a skin of a thickness, by its logarithm."""
        count = len(self._ends)
        weights = np.linalg.solve(np.vander(self._ends).T, np.vander([logarithm], count)[0])
        return CandidateReadings.mixed(self._parts, weights.astype(np.float32))

    def look(self, moment: Observation, number: int | None) -> None:
        """Take a moment with a number of contacts; None: no fingertips. A touch counts once, when it ends.

        Where several moments of it have one contact, that with the largest readings counts: the mean of a
        contact that slides is that of a thicker skin.
        """
        best = self._strongest
        if number == 1 and (best is None or moment.readings.sum() > best.readings.sum()):
            self._strongest = moment
        elif number == 0 and best is not None:
            self.add(best)
            self._strongest = None

    def add(self, touch: Observation) -> None:
        """Take the readings of a touch of one fingertip."""
        if not self._tables:
            return
        new = [logsumexp(fit_force(touch, self._prior, *table)[1]) for table in self._tables]
        self._evidence = self._evidence + new  # not in place: copies share it
        fine = np.linspace(self._compared[0], self._compared[-1], 201)
        weight = softmax(_TEMPER * CubicSpline(self._compared, self._evidence)(fine))
        mean = float(weight @ fine)
        # A range whose deviation is that of the posterior.
        half = math.sqrt(3 * float(weight @ (fine - mean) ** 2))
        self.factor, self.touches = math.exp(mean), self.touches + 1
        self.noise = replace(self.noise, thickness=(math.exp(-half), math.exp(half)))
        self._posterior.assume(self._mixed(mean), self.noise)

    @property
    def doubt(self) -> tuple[float, float] | None:
        """The thickness that touches fit and the described one, m; None: they fit that one, or are few."""
        low, high = self.noise.thickness
        if self.touches < _FEW or low <= 1 / self.factor <= high:
            return None
        return self.factor * self._described, self._described
