"""Readings of fingertips on a skin, for every position and radius: sampled once, then interpolated."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import expit, spence

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
        known = self.friction is None or 0 <= self.friction < math.inf
        if not (all(value >= 0 for value in (*self.numbers, self.large)) and self.numbers[1] > 0 and known):
            raise InputError(
                "a prior of fingertips needs probabilities of 0 or more, above 0 of one contact, and "
                f"friction of 0 or more, got numbers={list(self.numbers)}, large={self.large:g} and "
                f"friction={self.friction}"
            )
        if not (self.force > 0 and self.spread > 0 and self.rim > 0 and 0 < self.radii[0] < self.radii[1]):
            raise InputError(
                "a prior of fingertips needs force, spread and rim above 0 and two rising radii, got "
                f"force={self.force:g}, spread={self.spread:g}, rim={self.rim:g} and radii={list(self.radii)}"
            )

    def peak(self, radius: np.ndarray) -> np.ndarray:
        """Return the pressure in the middle of a fingertip of 1 N and some radius, m, in Pa/N."""
        # The integral of the pressure, 2 pi r / (1 + exp((r - radius) / rim)), is a dilogarithm.
        steep = radius / self.rim
        integral = np.pi**2 / 6 + steep**2 / 2 + spence(1 + np.exp(-steep))
        return expit(steep) / (2 * np.pi * self.rim**2 * integral)


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
        width = np.where(along, self.width / 2, self.width)
        sides = np.array([*product((-1, 1), repeat=3)])
        centre = self.centre[:, None] + (self.width - width)[:, None] / 2 * sides
        # Along an axis that is not cut, both halves are the box itself.
        which = (along[:, None] | (sides < 0)).all(2)
        return Boxes(centre[which], np.repeat(width, which.sum(1), axis=0))


# Patches of the surface with a polynomial each.


_POWERS = [(i, j) for i, j in product(range(4), repeat=2) if i + j <= 3]
_EXPONENTS = np.array(_POWERS).T
_RADII = 4  # Chebyshev points over the radii
_DEGREES = np.arange(4, dtype=np.float32)[:, None]
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

    Attributes:
        radii, span: least and largest radius, and their difference, m.
        size: of the body, (2,), m.
        sensors: S, their number; of three axes, that of their channels.
        axes: of a sensor, 1 or 3.
        friction: standard deviation of the tangential force along x and along y per newton; 0: without.
        boxes: the first boxes, which cover the surface and the radii.
        rows: (N, 4, L, S), float32: readings in their centres, N/N, and their derivatives by position and
            radius, N/N/m; those of the force into the skin (L = 1), followed with friction (L = 3) by those
            of a tangential force of a standard deviation along x, and along y.
        readings: (N, L, S), the first of them.
    """

    def __init__(self, simulator: AbstractSimulator, body: AbstractBody, prior: FingertipPrior) -> None:
        self.radii, self.size, self.axes = prior.radii, np.array(body.size), simulator.axes
        self.span = prior.radii[1] - prior.radii[0]
        largest = 0.8 * (simulator.axes > 1) if prior.friction is None else prior.friction
        self.friction = largest / math.sqrt(6)  # of a uniform fraction in a uniform direction
        # An even number, so that two by two of them make a first box.
        self._counts = 2 * np.ceil(self.size / (2 * _PATCH) - 1e-9).astype(int)
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
        mixed._coefficients = sum(
            weight * part._coefficients for weight, part in zip(weights, parts, strict=True)
        )
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
        edges = [(1, 1), (1, 1), (0, 0), (0, 0)]
        near = sliding_window_view(np.pad(samples, edges, "reflect", reflect_type="odd"), (4, 4), (0, 1))
        fit = _stencil()
        rows = [np.einsum("mij,xrsij->xmrs", fit, row, optimize=True).astype(np.float32) for row in near]
        return np.concatenate(rows).reshape(-1, len(_POWERS) * _RADII, flat.shape[1])

    def _first_boxes(self) -> Boxes:
        counts = self._counts // 2
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
    powers = np.stack([across, down, wide]).astype(np.float32)[:, None] ** _DEGREES
    slopes = np.pad(powers[:, :-1], [(0, 0), (1, 0), (0, 0)]) * _DEGREES
    slopes *= np.array(scales, np.float32)[:, None, None]
    i, j = _EXPONENTS
    (x, y, r), (dx, dy, dr) = powers, slopes
    terms = np.empty((4, len(_POWERS), _RADII, len(across)), np.float32)
    for term, column, row, radial in zip(terms, (x, dx, x, x), (y, y, dy, y), (r, r, r, dr), strict=True):
        np.multiply((column[i] * row[j])[:, None], radial, out=term)
    return terms.reshape(4, -1, len(across)).transpose(2, 0, 1)


def _stencil() -> np.ndarray:
    """Return what fits the polynomial of a patch to 4 x 4 samples, (terms, 4, 4), most to the inner ones."""
    at = np.array([-3.0, -1.0, 1.0, 3.0])
    down, across = (part.ravel() for part in np.meshgrid(at, at, indexing="ij"))
    design = np.stack([across**i * down**j for i, j in _POWERS], axis=1)
    weight = np.where((np.abs(across) < 2) & (np.abs(down) < 2), 10.0, 1.0)
    return (np.linalg.pinv(design * weight[:, None]) * weight).reshape(-1, 4, 4)
