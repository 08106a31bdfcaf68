"""Readings of fingertips on a skin, for every position and radius: sampled once, then interpolated."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from typing import NamedTuple

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.mechanics.geometry import Fingertip
from skin.mechanics.simulator.base import AbstractSimulator


@dataclass(frozen=True)
class FingertipPrior:
    """What fingertips are expected before anything is read.

    Places are uniform over the surface, radii uniform, forces log-normal; all independent. The defaults are
    those of fingertips: 5 N within a factor of e^0.5, so that 95 % lie between 1.9 and 13 N.

    Attributes:
        force: median, N.
        spread: standard deviation of the logarithm of the force.
        radii: least and largest radius, m.
        rim: over which the pressure falls at the edge, m (:class:`skin.mechanics.geometry.Fingertip`).
        numbers: probabilities of 0, 1, 2 and 3 fingertips. By default a skin is idle or touched by one
            fingertip more often than by several.
        large: probability of a contact that is larger, such as a hand.
        friction: largest tangential force as a fraction of the force; fractions up to it are equally likely,
            in any direction, and a normal distribution of the same variance stands for them. None: 0.8 for
            sensors of three axes, else 0.

    Raises:
        InputError: a number that has no meaning.
    """

    force: float = 5.0
    spread: float = 0.5
    radii: tuple[float, float] = (0.004, 0.012)
    rim: float = 0.0015
    numbers: tuple[float, float, float, float] = (0.3, 0.4, 0.15, 0.05)
    large: float = 0.1
    friction: float | None = None

    def __post_init__(self) -> None:
        if min(self.numbers) < 0 or not any(self.numbers[1:]) or not self.large >= 0:
            raise InputError(
                "a prior of fingertips needs probabilities of 0 or more, and one above 0 of a contact, got "
                f"numbers={list(self.numbers)} and large={self.large:g}"
            )
        if not (self.friction is None or 0 <= self.friction < math.inf):
            raise InputError(f"a prior of fingertips needs friction of 0 or more, got {self.friction:g}")
        if not (self.force > 0 and self.spread > 0 and self.rim > 0 and 0 < self.radii[0] < self.radii[1]):
            raise InputError(
                "a prior of fingertips needs force, spread and rim above 0 and two rising radii, got "
                f"force={self.force:g}, spread={self.spread:g}, rim={self.rim:g} and radii={list(self.radii)}"
            )

    def peak(self, radius: np.ndarray) -> np.ndarray:
        """Return the pressure in the middle of a fingertip of 1 N and some radius, m, in Pa/N."""
        return np.interp(radius, *self._peaks)

    @cached_property
    def _peaks(self) -> tuple[np.ndarray, np.ndarray]:
        """Radii, m, and the pressure in the middle of fingertips of 1 N, Pa."""
        knots = np.linspace(*self.radii, 33)
        reach = np.linspace(0, 1, 400)[:, None] * (knots + 12 * self.rim)
        fraction = 1 / (1 + np.exp((reach - knots) / self.rim))
        return knots, fraction[0] / np.trapezoid(2 * np.pi * reach * fraction, reach, axis=0)


def disc_readings(
    simulator: AbstractSimulator, body: AbstractBody, discs: np.ndarray, rim: float, friction: float = 0.0
) -> np.ndarray:
    """Return the readings (N, S), N/N, of discs (N, 3) of 1 N: x, y and radius, m.

    The only part of inference that calls the mechanics.

    Args:
        simulator, body: of the skin.
        discs: (N, 3), m.
        rim: of the discs, m.
        friction: if it is above 0, readings (N, 3 S) follow each other: those of the force into the skin,
            and what a tangential force of ``friction`` N along x, then along y, adds.
    """
    touches = torch.from_numpy(np.column_stack([discs, np.ones(len(discs))])).float()
    touches = touches.to(next(simulator.buffers()).device)
    fingertip = Fingertip(body, rim, simulator.smooth)
    sides = (friction * torch.eye(2, device=touches.device))[: 2 if friction else 0]
    # Small results that are kept between large ones would hold the memory of these: up to 1 GB.
    readings = np.empty((len(discs), 0))
    with torch.no_grad():
        for first in range(0, len(discs), _AT_ONCE):
            loads = fingertip(touches[first : first + _AT_ONCE])
            plain = simulator.press(loads).readings
            further = [simulator.press(loads, side).readings - plain for side in sides]
            every = torch.cat([plain, *further], dim=1).cpu().numpy()
            readings = readings if first else np.empty((len(discs), every.shape[1]))
            readings[first : first + _AT_ONCE] = every
    return readings


class Boxes(NamedTuple):
    """Boxes of positions and radii.

    Attributes:
        centre: (N, 3), x, y and radius, m.
        width: (N, 3), m.
    """

    centre: np.ndarray
    width: np.ndarray

    def split(self, along: np.ndarray) -> "Boxes":
        """Return the halves of each box along some axes, (N, 3), bool: up to eight children each."""
        centre, width = self.centre, self.width
        for axis in range(3):
            cut = along[:, axis]
            half = np.where(cut, width[:, axis] / 2, width[:, axis])
            low, high = centre.copy(), centre[cut]
            low[cut, axis] -= half[cut] / 2
            high[:, axis] += half[cut] / 2
            width = width.copy()
            width[:, axis] = half
            centre = np.concatenate([low, high])
            width = np.concatenate([width, width[cut]])
            along = np.concatenate([along, along[cut]])
        return Boxes(centre, width)


# Patches of the surface with a polynomial each.


_POWERS = [(i, j) for i, j in product(range(4), repeat=2) if i + j <= 3]
_EXPONENTS = np.array(_POWERS).T
_RADII = 4  # Chebyshev points over the radii
_PATCH = 0.002  # m, largest side of a patch
_AT_ONCE = 64  # discs


class CandidateReadings:
    """Readings per newton of fingertips anywhere, and their derivatives.

    The surface is divided into patches of at most 2 mm. On each, readings are polynomials of third order in
    position and radius, fitted to samples on the corners of the patch and of its neighbours.

    Args:
        simulator: of the skin; its readings must add up.
        body: the skin.
        prior: radii and rim of fingertips.
        coarse: largest width of the first boxes, m.

    Attributes:
        radii, span: least and largest radius, and their difference, m.
        size: of the body, (2,), m.
        sensors: S, their number.
        friction: standard deviation of the tangential force along x and along y per newton; 0: without.
        boxes: the first boxes, which cover the surface and the radii.
        rows: (N, 4, L, S), float32: readings in their centres, N/N, and their derivatives by position and
            radius, N/N/m; those of the force into the skin (L = 1), followed with friction (L = 3) by those
            of a tangential force of a standard deviation along x, and along y.
        readings: (N, L, S), the first of them.
    """

    def __init__(
        self, simulator: AbstractSimulator, body: AbstractBody, prior: FingertipPrior, coarse: float = 0.004
    ) -> None:
        self.radii, self.size = prior.radii, np.array(body.size)
        self.span = prior.radii[1] - prior.radii[0]
        largest = 0.8 * (simulator.axes > 1) if prior.friction is None else prior.friction
        self.friction = largest / math.sqrt(6)  # of a uniform fraction in a uniform direction
        # An even number, so that two by two of them make a first box.
        self._per_box = max(1, round(coarse / _PATCH))
        self._counts = self._per_box * np.ceil(self.size / coarse - 1e-9).astype(int)
        self._patch = self.size / self._counts
        self._coefficients = self._fit(simulator, body, prior)
        self.boxes = self._first_boxes()
        self._tabulate()

    def _tabulate(self) -> None:
        self.rows = self.at(self.boxes.centre)
        self.readings = np.ascontiguousarray(self.rows[:, 0])
        self.sensors = self.readings.shape[2]

    @staticmethod
    def mixed(parts: "Sequence[CandidateReadings]", weights: np.ndarray) -> "CandidateReadings":
        """Return the weighted sum of the readings of skins of one size; weights (N,), float32."""
        mixed = copy(parts[0])
        weighted = (weight * part._coefficients for weight, part in zip(weights, parts, strict=True))
        mixed._coefficients = reduce(np.add, weighted)
        mixed._tabulate()
        return mixed

    def _fit(self, simulator: AbstractSimulator, body: AbstractBody, prior: FingertipPrior) -> np.ndarray:
        """Return coefficients (patches, K, L S), float32."""
        x, y = (np.linspace(0, side, count + 1) for side, count in zip(self.size, self._counts, strict=True))
        nodes = np.cos(np.pi * (np.arange(_RADII) + 0.5) / _RADII)
        middle, half = sum(self.radii) / 2, (self.radii[1] - self.radii[0]) / 2
        grid = np.stack(np.meshgrid(y, x, middle + half * nodes, indexing="ij"), -1)[..., [1, 0, 2]]
        flat = disc_readings(simulator, body, grid.reshape(-1, 3), prior.rim, self.friction)
        samples = flat.reshape(*grid.shape[:3], -1)
        # Along the radius: Chebyshev points give monomials without error.
        monomials = np.linalg.inv(np.vander(nodes, increasing=True))
        samples = np.einsum("kr,yxrs->yxks", monomials, samples)
        # Beyond the edge the neighbours are continued along a line.
        samples = _extend(_extend(samples, 0), 1)
        fit = _stencil()
        rows, columns = self._counts[1], self._counts[0]
        total = np.zeros((rows, columns, len(_POWERS), _RADII, flat.shape[1]), np.float32)
        for row in range(rows):
            near = [samples[row + down, x : x + columns] for down, x in product(range(4), repeat=2)]
            total[row] = np.einsum("km,mcrs->ckrs", fit, np.array(near), optimize=True)
        return total.reshape(rows * columns, len(_POWERS) * _RADII, flat.shape[1])

    def _first_boxes(self) -> Boxes:
        counts = self._counts // self._per_box
        width = np.array([*(self.size / counts), (self.radii[1] - self.radii[0]) / 2])
        x, y = ((np.arange(count) + 0.5) * side for count, side in zip(counts, width, strict=False))
        radius = self.radii[0] + np.array([0.5, 1.5]) * width[2]
        centre = np.stack(np.meshgrid(y, x, radius, indexing="ij"), -1)[..., [1, 0, 2]].reshape(-1, 3)
        return Boxes(centre, np.broadcast_to(width, centre.shape).copy())

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return rows (N, 4, L, S) at x, y and radius (N, 3), m."""
        patch = np.clip((positions[:, :2] / self._patch).astype(int), 0, self._counts - 1)
        across, down = (2 * (positions[:, :2] / self._patch - patch) - 1).T
        half = self.span / 2
        wide = (positions[:, 2] - self.radii[0]) / half - 1
        scales = (2 / self._patch[0], 2 / self._patch[1], 1 / half)
        powers = _monomials(across, down, wide, scales)
        number = patch[:, 1] * self._counts[0] + patch[:, 0]
        rows = np.empty((len(number), 4, self._coefficients.shape[2]), np.float32)
        # Positions on one patch share its coefficients, which are larger than what is computed.
        order = np.argsort(number, kind="stable")
        for same in np.split(order, np.flatnonzero(np.diff(number[order])) + 1):
            if len(same):
                rows[same] = powers[same] @ self._coefficients[number[same[0]]]
        return rows.reshape(len(rows), 4, 3 if self.friction else 1, -1)


def _monomials(
    across: np.ndarray, down: np.ndarray, wide: np.ndarray, scales: tuple[float, float, float]
) -> np.ndarray:
    """Return what coefficients are multiplied by for the value and three derivatives, (N, 4, K), float32."""
    axes = np.stack([across, down, wide]).astype(np.float32)
    powers = np.ones((3, 4, len(across)), np.float32)
    powers[:, 1] = axes
    np.multiply(axes, axes, out=powers[:, 2])
    np.multiply(powers[:, 2], axes, out=powers[:, 3])
    slopes = np.zeros_like(powers)
    slopes[:, 1:] = powers[:, :3] * (np.arange(1, 4)[:, None] * np.array(scales)[:, None, None]).astype(
        np.float32
    )
    i, j = _EXPONENTS
    (x, y, r), (dx, dy, dr) = powers, slopes
    columns = y[j]
    position = x[i] * columns
    terms = np.empty((4, len(_POWERS), _RADII, len(across)), np.float32)
    np.multiply(position[:, None], r, out=terms[0])
    np.multiply((dx[i] * columns)[:, None], r, out=terms[1])
    np.multiply((x[i] * dy[j])[:, None], r, out=terms[2])
    np.multiply(position[:, None], dr, out=terms[3])
    return terms.reshape(4, -1, len(across)).transpose(2, 0, 1)


def _extend(samples: np.ndarray, axis: int) -> np.ndarray:
    """Continue samples by a step at both ends of an axis."""
    first, second = (samples.take([number], axis) for number in (0, 1))
    last, before = (samples.take([number], axis) for number in (-1, -2))
    return np.concatenate([2 * first - second, samples, 2 * last - before], axis)


def _stencil() -> np.ndarray:
    """Return what fits the polynomial of a patch to 4 x 4 samples, (terms, 16); the inner ones count most."""
    at = np.array([-3.0, -1.0, 1.0, 3.0])
    down, across = (part.ravel() for part in np.meshgrid(at, at, indexing="ij"))
    design = np.stack([across**i * down**j for i, j in _POWERS], axis=1)
    weight = np.where((np.abs(across) < 2) & (np.abs(down) < 2), 10.0, 1.0)
    return np.linalg.pinv(design * weight[:, None]) * weight
