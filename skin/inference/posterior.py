"""Where and how hard a skin is touched, and how certain that is, from readings of any layout.

Boxes of positions and radii are refined until they are 1.8 standard deviations long. The likelihood is
averaged over each to second order, with the force integrated. A further contact is tried where the frame fits
badly or the residual supports it: it starts from the residual and from all pairs of positions, is refined by
Gauss-Newton, and importance samples give its evidence. Further ones, around the first, give the regions.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import expit, gammaincc, logsumexp, ndtr
from threadpoolctl import ThreadpoolController

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.inference.candidates import CandidateReadings, FingertipPrior
from skin.inference.contact import Cloud, blur_first, one_contact
from skin.inference.contacts import Mixture, Search
from skin.inference.likelihood import Observation, fit_force
from skin.inference.noise import Noise
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.shapes import load_image

MOST_CONTACTS = 3
"""Largest number of contacts in an estimate."""

_PER_CONTACT = 3  # sensors that a contact takes at least: it has a position and a force
_FITS = 0.01  # a smaller predictive probability says that no contacts give such readings
_POOR, _LIKELY = 1e-3, 0.5  # a further contact is tried below this probability, or above these odds
_CELLS = 160  # of a region, along an axis at most

_THREADS = ThreadpoolController()  # matrices are small: several contacts take twice as long on two threads


# Hands and bars: touches that are no fingertips.


SHAPES = ("bar", "hand", "fist", "square", "disc")
"""Pictures in ``data/shapes`` that large contacts have."""

_COUNT = 3150  # contacts that stand for all
# Part of a reading by which that of a similar contact differs. Of 0.05 to 1.2, and up to a tenth of the root
# mean square of all beside it, 0.4 to 0.6 gave other contacts the highest evidence on five skins of 9 to 36
# sensors.
_TOLERANCE = 0.4
_SPACING = 0.004  # m, between the points of a contact
_SHARE = 0.7  # of the surface, the largest area
_PRESSURE, _SPREAD = 60e3, 1.0  # Pa, median of the highest pressure, and the deviation of its logarithm


class LargeContacts:
    """Evidence of a contact larger than a fingertip: the mean likelihood of many such contacts.

    A drawn contact represents similar ones, with readings within a tolerance.

    Args:
        candidates: whose fingertips add up to larger contacts.
        noise: of the readings.
    """

    def __init__(self, candidates: CandidateReadings, noise: Noise) -> None:
        # In units of the median force of each contact.
        self.prior = FingertipPrior(force=1.0, spread=_SPREAD)
        self._readings = draw_large(candidates, _COUNT, np.random.default_rng(0))
        self._spread = (_TOLERANCE**2 + noise.gain**2) * np.square(self._readings).sum(1)

    def evidence(self, frame: Observation) -> float:
        """Return the log of the mean likelihood of a frame."""
        _, evidence = fit_force(frame, self.prior, self._readings, self._spread)
        return float(logsumexp(evidence)) - math.log(len(evidence))


def draw_large(candidates: CandidateReadings, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the readings (N, L, S), N, of large contacts under their median force, float32.

    Shape, position, angle and the logarithm of the area, from the largest fingertip up, are uniform. A
    contact consists of small fingertips with the pressures of its picture.
    """
    size, radii = candidates.size, candidates.radii
    steps = np.ceil(size / _SPACING).astype(int)
    x, y = ((np.arange(step) + 0.5) * side / step for step, side in zip(steps, size, strict=True))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    small = candidates.at(np.column_stack([points, np.full(len(points), radii[0])]))[:, 0]
    pictures = [load_image(name) for name in SHAPES]
    shape, angle = rng.integers(0, len(SHAPES), count), rng.uniform(0, 2 * np.pi, count)
    minimum, maximum = math.pi * radii[1] ** 2, _SHARE * size.prod()
    area = minimum * (maximum / minimum) ** rng.random(count)
    position = size * rng.random((count, 2))
    readings, cell = np.empty((count, *small.shape[1:]), np.float32), float(size.prod() / len(points))
    for number in range(count):
        pressure = _sample(pictures[shape[number]], area[number], angle[number], points - position[number])
        readings[number] = _PRESSURE * cell * np.tensordot(pressure, small, 1)
    return readings[(readings != 0).any((1, 2))]


def _sample(picture: np.ndarray, area: float, angle: float, away: np.ndarray) -> np.ndarray:
    """Return the values of a picture of some area, m^2, at points (P, 2) from its middle, m."""
    turned = (away @ [1, 1j]) * np.exp(-1j * angle) / math.sqrt(area / (picture > 0).sum())
    middle = (np.array(picture.shape) - 1) / 2
    rows, columns = turned.imag + middle[0], turned.real + middle[1]
    return map_coordinates(picture, [rows, columns], order=0, mode="grid-constant")


@dataclass(frozen=True)
class Region:
    """The most probable positions of a contact, as cells of a raster.

    Attributes:
        cells: (C, 2), x and y of their centres, m.
        width: (2,), of a cell, m.
        probabilities: (C,), that each holds the position.
    """

    cells: np.ndarray
    width: np.ndarray
    probabilities: np.ndarray

    @property
    def area(self) -> float:
        """Area of all cells, m^2."""
        return float(len(self.cells) * self.width.prod())

    def contains(self, position: np.ndarray) -> bool:
        """Return whether a position (2,), m, lies in a cell."""
        return bool((np.abs(self.cells - position) <= self.width / 2).all(axis=1).any())


@dataclass(frozen=True)
class ContactEstimate:
    """Posterior of one contact; samples are weighted.

    Attributes:
        position, position_deviation: (2,), mean and standard deviation of x and y, m.
        force, force_deviation: into the skin, N.
        tangential, tangential_deviation: (2,), along x and y, N; None where the prior has no friction.
        radius, radius_deviation: m.
        peak: highest pressure of the most probable contact, Pa.
        peak_interval: contains the highest pressure with 90 %, Pa; readings hardly determine the radius.
        positions, widths: (N, 2), boxes that hold the position, m.
        peaks: (N, J), Pa, of the boxes' forces.
        weights: (N, J), probabilities that sum to 1.
    """

    position: np.ndarray
    position_deviation: np.ndarray
    force: float
    force_deviation: float
    tangential: np.ndarray | None
    tangential_deviation: np.ndarray | None
    radius: float
    radius_deviation: float
    peak: float
    peak_interval: tuple[float, float]
    positions: np.ndarray = field(repr=False)
    widths: np.ndarray = field(repr=False)
    peaks: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)

    def exceeds(self, pressure: float) -> float:
        """Return the probability that the highest pressure is above a limit, Pa."""
        return float(self.weights[self.peaks > pressure].sum())

    def to_json(self, probability: float = 0.9, cell: float = 0.002) -> dict[str, Any]:
        """Return the contact as JSON data.

        Args:
            probability: of its region.
            cell: m, least width of its cells: a region of the default skin would have a thousand smaller.
        """
        region = self.region(probability, cell)
        origin = region.cells.min(axis=0)
        position, spread = self.position.round(5).tolist(), self.position_deviation.round(5).tolist()
        return {
            "x": position[0],
            "y": position[1],
            "x_deviation": spread[0],
            "y_deviation": spread[1],
            "force": round(self.force, 4),
            "force_deviation": round(self.force_deviation, 4),
            "radius": round(self.radius, 5),
            "radius_deviation": round(self.radius_deviation, 5),
            "peak": round(self.peak),
            "peak_interval": [round(limit) for limit in self.peak_interval],
            "region": {
                "share": round(float(region.probabilities.sum()), 4),
                "origin": origin.round(6).tolist(),
                "cell": region.width.round(6).tolist(),
                "cells": ((region.cells - origin) / region.width).round().astype(int).tolist(),
                "probabilities": region.probabilities.round(5).tolist(),
            },
        }

    def region(self, fraction: float = 0.9, minimum: float = 0.0) -> Region:
        """Return the smallest set of cells that holds the position with a probability; it may have parts.

        Each sample counts as a normal distribution of the variance of its box: boxes are up to 1.8 standard
        deviations long, and what is uniform over each holds 2 points less than it says.

        Args:
            fraction: the probability.
            minimum: smallest width of a cell, m.
        """
        weight = self.weights.sum(1)
        low, high = (self.positions - self.widths).min(0), (self.positions + self.widths).max(0)
        width = np.maximum(self.widths.min(0), minimum)
        steps = np.clip(np.ceil((high - low) / width - 1e-6), 1, _CELLS).astype(int)
        edges = [np.linspace(low[axis], high[axis], steps[axis] + 1) for axis in (0, 1)]
        parts = [_overlap(edges[axis], self.positions[:, axis], self.widths[:, axis]) for axis in (0, 1)]
        mass = (parts[0] * weight[:, None]).T @ parts[1]
        mass /= mass.sum()
        order = np.argsort(-mass, axis=None, kind="stable")
        total = np.cumsum(mass.ravel()[order])
        # The last cell is included if the probability is nearer to ``fraction`` with it than without.
        chosen = np.unravel_index(order[: np.argmin(np.abs(total - fraction)) + 1], mass.shape)
        middles = [(line[1:] + line[:-1]) / 2 for line in edges]
        cells = np.stack([middles[axis][chosen[axis]] for axis in (0, 1)], axis=1)
        return Region(cells, (high - low) / steps, mass[chosen])


def _overlap(edges: np.ndarray, centre: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the probability of each interval between edges, (N, cells)."""
    return np.diff(ndtr((edges - centre[:, None]) * (math.sqrt(12) / width[:, None])), axis=1)


@dataclass(frozen=True)
class FrameEstimate:
    """Estimate from the readings of a frame.

    Attributes:
        number: the most probable number of contacts.
        probabilities: (4,), of 0, 1, 2 and 3 contacts, if they are fingertips.
        given: (4,), the contacts if there are 0, 1, 2 and 3 of them, the strongest first. Where more are
            improbable, the one contact stands for each further one.
        fit: posterior predictive p-value: how often such contacts would give readings that fit worse.
        large: probability of a larger contact, such as a hand, beside those of fingertips.
        fingertip: whether there are contacts, they fit, and a larger one is less probable.
        unknown: what cannot be known from these sensors, or None.
    """

    number: int
    probabilities: np.ndarray
    given: tuple[tuple[ContactEstimate, ...], ...]
    fit: float
    large: float
    fingertip: bool
    unknown: str | None

    @property
    def contacts(self) -> tuple[ContactEstimate, ...]:
        """``number`` contacts, the strongest first."""
        return self.given[self.number]

    def exceeds(self, pressure: float) -> float:
        """Return the probability that some fingertip's highest pressure is above a limit, Pa."""
        return float(
            self.probabilities
            @ [1 - math.prod(1 - contact.exceeds(pressure) for contact in each) for each in self.given]
        )

    def to_json(self, time: float, noise_fit: float = 1e-4) -> dict[str, Any]:
        """Return the estimate as JSON data, the fields of ``docs/export.md``.

        Args:
            time: s, the device's clock at the latest frame of the readings.
            noise_fit: predictive probability below which readings without contact are not explained by noise.
        """
        none = self.number == 0 and self.fit >= noise_fit and self.large < 0.5
        known = self.fingertip or none
        return {
            "state": "no contact" if none else "contacts" if known else "not a fingertip",
            "reason": self.unknown or "",
            "device_time": time,
            "fit": round(self.fit, 6),
            "large": round(self.large, 6),
            "changed": [],
            "thickness": None,
            "number": self.number if known else None,
            "probability": round(float(self.probabilities[self.number]), 6) if known else None,
            "probabilities": self.probabilities.round(6).tolist() if known else None,
            # The strongest of the fingertips that fit best: a reader must find where a hard touch is.
            "contacts": [contact.to_json() for contact in self.contacts[: None if known else 1]],
        }


class Posterior:
    """Estimates contacts from readings, for any layout on a sheet or an arm, without training.

    Readings of contacts add up, so those of all candidates are one table. Places and radii are refined around
    the best candidates, forces are integrated. A silent sensor informs, too.

    Args:
        simulator: of the skin: ``solid``, ``naive``, or ``fem`` with ``reading=interface``. Readings of
            equation 10 do not add up: it takes ``contacts=1``.
        noise: of the readings.
        body: the skin.
        prior: of fingertips; None: the default.
        contacts: the largest number of contacts, up to three.

    Raises:
        InputError: a simulator whose readings do not add up, or more contacts than three.
    """

    def __init__(
        self,
        simulator: AbstractSimulator,
        noise: Noise,
        body: AbstractBody,
        prior: FingertipPrior | None = None,
        contacts: int = MOST_CONTACTS,
    ) -> None:
        if not 1 <= contacts <= MOST_CONTACTS:
            raise InputError(f"a posterior estimates 1 to {MOST_CONTACTS} contacts, got contacts={contacts}")
        if not isinstance(simulator, AbstractSimulator):
            raise InputError(
                f"a posterior needs the mechanics of a skin, such as skin.Solid, got {simulator!r}"
            )
        if contacts > 1 and getattr(simulator, "reading", None) == "equation10":
            raise InputError(
                "readings of simulator.reading=equation10 do not add up, so that only one contact can be "
                "estimated: give contacts=1, or set simulator.reading=interface or simulator=solid"
            )
        self.prior = prior or FingertipPrior()
        self._maximum = int(np.flatnonzero(self.prior.numbers[: contacts + 1])[-1])
        self.assume(CandidateReadings(simulator, body, self.prior), noise)
        self._large = LargeContacts(self.candidates, noise) if self.prior.large else None
        with np.errstate(divide="ignore"):
            self._numbers = np.log(np.array(self.prior.numbers[: self._maximum + 1]))

    def assume(self, candidates: CandidateReadings, noise: Noise) -> None:
        """Take the readings of fingertips, and the noise of readings, to be these."""
        self.candidates, self.noise = candidates, noise
        self._first, self._search = blur_first(candidates, noise), Search(candidates, self.prior)

    @_THREADS.wrap(limits=1, user_api="blas")
    def estimate(
        self, readings: np.ndarray, valid: np.ndarray | None = None, saturated: np.ndarray | None = None
    ) -> "FrameEstimate | list[FrameEstimate]":
        """Return the estimate of each frame.

        Args:
            readings: (S,), N, or (T, S) of several frames.
            valid: same shape, bool: which have a value; None: those that are finite.
            saturated: same shape, bool: which exceed the largest force; None: those from ``noise.clip`` up.
                Without a finite ``noise.clip``, and along the surface, they do not count.

        Raises:
            InputError: readings of another number of sensors.
        """
        checked = self._checked(readings, valid, saturated)
        values, valued, clips = map(np.atleast_2d, checked)
        estimates = [
            self._frame(Observation.of(*frame, self.noise))
            for frame in zip(values, valued, clips, strict=True)
        ]
        return estimates if checked[0].ndim == 2 else estimates[0]

    def _checked(
        self, readings: np.ndarray, valid: np.ndarray | None, saturated: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return readings, N, which have a value, and which exceed the largest force."""
        values, sensors, axes = np.asarray(readings, float), self.candidates.sensors, self.candidates.axes
        if values.ndim not in (1, 2) or values.shape[-1] != sensors:
            raise InputError(
                f"this skin has {sensors} sensors: give readings ({sensors},) or (T, {sensors}), N, got "
                f"{values.shape}"
            )
        clips = values >= self.noise.clip if saturated is None else np.asarray(saturated, bool)
        # Of a channel along the surface, it is unknown at which of its two limits it is.
        bounded = (np.arange(sensors) % axes == axes - 1) & (self.noise.clip < math.inf)
        # Infinity is more than any limit.
        valued = (np.isfinite(values) | clips & (values > 0)) & (~clips | bounded)
        return values, valued & (True if valid is None else np.asarray(valid, bool)), clips

    @_THREADS.wrap(limits=1, user_api="blas")
    def estimate_touch(
        self, readings: np.ndarray, valid: np.ndarray | None = None, saturated: np.ndarray | None = None
    ) -> FrameEstimate:
        """Return one estimate from the frames of a touch that does not move.

        Readings are proportional to the force, so that the mean of the frames is the reading of the mean
        force. A sensor that is invalid or clips in a frame is so in all, its mean a lower bound.

        Args:
            readings: (T, S), N.
            valid, saturated: as of :meth:`estimate`.
        """
        values, valued, clips = map(np.atleast_2d, self._checked(readings, valid, saturated))
        works, limited = np.logical_and.reduce(valued), np.logical_or.reduce(valued & clips)
        mean, frames = values.mean(0), self.noise.frames * len(values)
        clip = max(float(mean[works & limited].min(initial=self.noise.clip)), self.noise.frame)
        return self._frame(
            Observation.of(mean, works, limited, replace(self.noise, frames=frames, clip=clip))
        )

    def _frame(self, frame: Observation) -> FrameEstimate:
        """Return the estimate of a frame, which depends on nothing else."""
        # A contact that is a tenth as probable as none, or less, is not estimated.
        least = frame.empty() + float(self._numbers[0] - self._numbers[1:].max()) - math.log(10)
        single = one_contact(self.candidates, self.prior, frame, self._first, least)
        sensors = int(frame.counts.sum()) + len(frame.clipped)
        maximum = min(self._maximum, max(1, sensors // _PER_CONTACT))
        evidence, mixtures = self._several(frame, single, maximum)
        logs = np.array(evidence) + self._numbers[: len(evidence)]
        number, total = int(logs.argmax()), float(logsumexp(logs))
        misfit = [
            frame.readings**2 @ frame.counts / frame.noise.floor,  # of no contact
            single.misfit,
            *(mixture.misfit for mixture in mixtures),
        ][number]
        fit = float(gammaincc(max(frame.counts.sum(), 1) / 2, misfit / 2))
        clouds = [[], [single], *map(self._search.clouds, mixtures)]
        if number > 1:
            clouds[number] = self._search.clouds(self._search.walk(frame, mixtures[number - 2]))
        given = [tuple(sorted(map(self._summary, each), key=lambda one: -one.force)) for each in clouds]
        while len(given) < len(self._numbers):
            given.append((*given[-1], *given[1]))
        odds = self._large.evidence(frame) + math.log(self.prior.large) - total if self._large else -math.inf
        large = float(expit(odds))
        return FrameEstimate(
            number,
            np.pad(np.exp(logs - total), (0, len(self._numbers) - len(logs))),
            tuple(given),
            fit,
            large,
            number > 0 and fit >= _FITS and large < 0.5,
            _unknown(sensors, frame, self.prior, given[number][0].force if number else 0.0),
        )

    def _several(self, frame: Observation, single: Cloud, maximum: int) -> tuple[list[float], list[Mixture]]:
        """Return the log evidence of each number of contacts, and the posteriors from two contacts on.

        Those of numbers that are improbable are left out.
        """
        evidence, mixtures, misfit = [frame.empty(), single.evidence], list[Mixture](), single.misfit
        mode, sensors = self._search.guess(single.mode[None]), max(frame.counts.sum(), 1) / 2
        for number in range(2, maximum + 1):
            guesses, factor = self._search.extend(frame, mode)
            # It explains no more than the first contact: where no sensor responds, both are hidden.
            least = evidence[-1] + min(factor, single.evidence - evidence[0])
            odds = least + self._numbers[number:].max() - (evidence + self._numbers[:number]).max()
            if gammaincc(sensors, misfit / 2) > _POOR and odds < math.log(_LIKELY):
                return evidence + [least] * (maximum + 1 - number), mixtures
            mixtures.append(mixture := self._refine(frame, guesses, mode))
            evidence.append(max(least, mixture.evidence))
            mode, misfit = mixture.mode, mixture.misfit
        return evidence, mixtures

    def _refine(self, frame: Observation, guesses: np.ndarray, mode: np.ndarray) -> Mixture:
        """Return the best contacts, one more than a mode (n, P), from several starts."""
        starts = [guesses]
        for index in range(len(mode)):
            others = np.delete(mode, index, 0)
            known = self._search.predict(others[None])[0][0] if len(others) else 0 * frame.readings
            pairs = self._search.pairs(frame, known)
            starts.append(np.concatenate([np.repeat(others[None], len(pairs), 0), pairs], axis=1))
        modes, score = self._search.refine(frame, np.concatenate(starts))
        return self._search.sample(frame, modes, score)

    def _summary(self, cloud: Cloud) -> ContactEstimate:
        """Return the moments of the posterior of a contact."""
        (boxes, widths), force, weight = cloud.boxes, cloud.force, cloud.weight
        total = weight.sum(1)
        # Three radii of the variance of a box, which is up to a third of the range: the peak falls as r^2.
        radii = boxes[:, 2:] + widths[:, 2:] * np.sqrt(1 / 8) * np.array([-1, 0, 1])
        parts = _disc_parts(np.vstack([cloud.mode[:3], boxes]), self.candidates.size)
        peaks = np.einsum("nr,nj->nrj", self.prior.peak(radii) / parts[1:, None], force).reshape(
            len(force), -1
        )
        thirds = np.tile(weight / 3, 3)
        middle = total @ boxes
        deviation = np.sqrt(total @ ((boxes - middle) ** 2 + widths**2 / 12))
        mean, order = float((weight * force).sum()), np.argsort(peaks, axis=None)
        sideways = np.einsum("nj,njk->k", weight, cloud.tangential)
        squares = np.einsum("nj,njk->k", weight, (cloud.tangential - sideways) ** 2 + cloud.variance)
        low, high = np.interp([0.05, 0.95], np.cumsum(thirds.ravel()[order]), peaks.ravel()[order]).tolist()
        return ContactEstimate(
            middle[:2],
            deviation[:2],
            mean,
            math.sqrt(float((weight * (force - mean) ** 2).sum())),
            sideways if len(sideways) else None,
            np.sqrt(squares) if len(sideways) else None,
            float(middle[2]),
            float(deviation[2]),
            float(self.prior.peak(cloud.mode[2]) * cloud.mode[3] / parts[0]),
            (low, high),
            boxes[:, :2],
            widths[:, :2],
            peaks,
            thirds,
        )


def _disc_parts(discs: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return how much of discs (N, 3), m, lies on the surface, which carries the whole force, (N,).

    It is the product of what each edge leaves.
    """
    reach = np.clip(np.hstack([discs[:, :2], size - discs[:, :2]]) / discs[:, 2:], 0, 1)
    return np.prod(0.5 + (reach * np.sqrt(1 - reach**2) + np.arcsin(reach)) / np.pi, axis=1)


def _unknown(sensors: int, frame: Observation, prior: FingertipPrior, force: float) -> str | None:
    """Return what a frame cannot determine, in a sentence."""
    if sensors == 0:
        return "no sensor is valid: nothing is known beyond the prior"
    if sensors < 3:
        return (
            f"{sensors} valid sensor{'s' if sensors > 1 else ''}: position and force cannot be separated; "
            "regions follow the prior, and several contacts look like one"
        )
    if len(frame.clipped):
        return f"beyond the range of sensors {frame.clipped.tolist()}: force and position may be elsewhere"
    if force > prior.force * math.exp(2 * prior.spread):  # the prior draws it towards what it expects
        return f"{force:.3g} N is beyond the range of the prior: force and position may be elsewhere"
    return None
