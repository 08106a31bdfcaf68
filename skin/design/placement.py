"""Choose the sites of sensors whose readings tell most.

All functions take the covariance of the readings at C sites divided by the variance of the noise, A (C, C).
The information of the sites S is that between noisy Gaussian readings and true ones, 1/2 log det(I + A_SS),
in nats.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.path import Path as Polygon
from PIL import Image
from scipy.linalg import solve

from skin.body.base import AbstractBody, Sensors, overlaps
from skin.body.layout import Grid, place_sensors
from skin.core.files import candidates
from skin.device.simulated import Simulated
from skin.errors import InputError

Sites = Sequence[int] | np.ndarray
"""Indices of sites."""

_TIE = 1e-9  # relative difference below which two sites are equally good


def mutual_information(signal: np.ndarray, sites: Sites) -> float:
    """Return 1/2 log det(I + A_SS) of some sites, nats.

    Args:
        signal: A, (C, C).
        sites: S.
    """
    chosen = np.asarray(sites, dtype=int)
    return float(np.linalg.slogdet(np.eye(len(chosen)) + signal[np.ix_(chosen, chosen)])[1] / 2)


def too_near(positions: np.ndarray, distance: float) -> np.ndarray:
    """Return which sites cannot both carry a sensor, (C, C), bool; a site is too near to itself.

    Args:
        positions: (C, 2), m.
        distance: least distance of two sensors, m; it is compared to within 1 micrometre.
    """
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return (apart < distance - 1e-6) | np.eye(len(positions), dtype=bool)


def greedy(signal: np.ndarray, count: int, near: np.ndarray, fixed: Sites = ()) -> list[int]:
    """Choose sites one by one, each with the largest gain of information.

    The gain of a site is half the logarithm of its variance given the chosen ones. A pivoted Cholesky
    factorisation updates the variances of all sites in O(C k) per step, so a lazy evaluation of gains would
    save nothing. Of equally good sites, the first is chosen.

    Args:
        signal: A, (C, C).
        count: number of sites, with the fixed ones.
        near: as of :func:`too_near`, (C, C).
        fixed: sites that are chosen first; they may be near each other.

    Returns:
        the fixed sites, then the others in the order of their choice.

    Raises:
        InputError: no site is left that is not too near to a chosen one.
    """
    variance = 1 + np.diag(signal)
    factor = np.empty((count, len(signal)))
    allowed = np.ones(len(signal), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < count:
        staying = len(chosen) < len(fixed)
        if not staying and not allowed.any():
            raise InputError(
                f"only {len(chosen)} of {count} sensors fit, because each other site is too near to one of "
                "them: lower design.count or design.distance, or set a finer design.raster"
            )
        site = int(fixed[len(chosen)]) if staying else _find_best(variance, allowed)
        above = factor[: len(chosen)]
        row = signal[site] - above[:, site] @ above
        row[site] += 1
        factor[len(chosen)] = row / np.sqrt(row[site])
        variance -= factor[len(chosen)] ** 2
        allowed &= ~near[site]
        chosen.append(site)
    return chosen


def exchange(signal: np.ndarray, sites: Sites, near: np.ndarray, fixed: int = 0) -> list[int]:
    """Move one sensor at a time to the best free site until no move gains information.

    Args:
        signal: A, (C, C).
        sites: as of :func:`greedy`.
        near: as of :func:`too_near`, (C, C).
        fixed: number of the first sites that stay.

    Returns:
        the sites, in the same order.
    """
    positions, moved = list(sites), True
    while moved:
        moved = False
        for number in range(fixed, len(positions)):
            others = positions[:number] + positions[number + 1 :]
            variance = _variance(signal, others)
            best = _find_best(variance, np.logical_not(near[others].any(axis=0)))
            if variance[best] > variance[positions[number]] * (1 + _TIE):
                positions[number], moved = best, True
    return positions


def _find_best(variance: np.ndarray, allowed: np.ndarray) -> int:
    """Return the first of the allowed sites with the largest variance (C,), to within rounding."""
    maximum = variance[allowed].max()
    return int(np.flatnonzero(allowed & (variance >= maximum * (1 - _TIE)))[0])


def _variance(signal: np.ndarray, sites: Sites) -> np.ndarray:
    """Return the variance (C,) of each noisy reading given those of some other sites."""
    rows = signal[np.asarray(sites, dtype=int)]
    noisy = np.eye(len(rows)) + rows[:, np.asarray(sites, dtype=int)]
    solved = solve(noisy, rows, assume_a="pos") if len(rows) else rows
    return 1 + np.diag(signal) - (rows * solved).sum(axis=0)


# Candidate sites of sensors on a skin.


Zones = Sequence[Sequence[tuple[float, float]]]
"""Polygons, each of at least three corners (x, y), m."""

_COVERED = 0.02  # fraction of a footprint that a zone may cover, because pixels approximate its outline
_PIXELS = 512
_ASPECT = 0.03
_DARK = 128
_ROUNDING = 1e-9  # m


def candidate_sites(
    body: AbstractBody,
    footprint: tuple[float, float],
    depth: float,
    raster: float | tuple[float, float] | None = None,
    forbidden: np.ndarray | None = None,
) -> Sensors:
    """Return sensors at all sites, row by row, whose footprint lies on the surface and in no keep-out zone.

    Args:
        body: the body.
        footprint: extent (x, y) of a sensor, m.
        depth: of the sensors, m.
        raster: pitch of the sites, or pitches along x and y, m. The raster is centred on the surface. None:
            the cells of the body.
        forbidden: as of :func:`keep_out`, (h, w), bool.

    Raises:
        InputError: no site is left.
    """
    pitches = body.cell if raster is None else raster if isinstance(raster, Sequence) else (raster, raster)
    x, y = (_along(*axis) for axis in zip(body.size, pitches, footprint, strict=True))
    covered = (
        np.zeros((len(y), len(x))) if forbidden is None else _covered(forbidden, body.size, (x, y), footprint)
    )
    rows, columns = np.nonzero(covered <= _COVERED)
    if not len(rows):
        raise InputError(
            f"no site is left for a sensor of {footprint[0]:g} x {footprint[1]:g} m on {body.size[0]:g} x "
            f"{body.size[1]:g} m: shrink the zones of design.keep_out, or lower design.raster or "
            "layout.footprint"
        )
    return place_sensors(body, np.column_stack([x[columns], y[rows]]), depth, footprint)


def keep_out(zones: Zones | str | None, size: tuple[float, float]) -> np.ndarray | None:
    """Return where no sensor may be, (h, w), bool, over the whole surface, row by row from the upper left.

    Args:
        zones: polygons; or the path of a picture of the whole surface, in which dark pixels are forbidden; or
            None.
        size: extent (x, y) of the surface, m.

    Raises:
        InputError: a polygon with fewer than three corners, or a picture that cannot be read or has another
            aspect ratio than the surface.
    """
    if isinstance(zones, str):
        return _picture(zones, size)
    if not zones:
        return None
    scale = max(size) / _PIXELS
    width, height = (max(1, round(extent / scale)) for extent in size)
    x, y = (
        (np.arange(count) + 0.5) / count * extent for count, extent in ((width, size[0]), (height, size[1]))
    )
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(points), dtype=bool)
    for number, zone in enumerate(zones):
        if len(zone) < 3:
            raise InputError(
                f"polygon {number + 1} of design.keep_out has {len(zone)} corners and needs three: as in "
                "design.keep_out=[[[0,0],[0.04,0],[0.04,0.02]]]"
            )
        inside |= Polygon(zone).contains_points(points)
    return inside.reshape(height, width)


def _picture(name: str, size: tuple[float, float]) -> np.ndarray:
    """Return the dark pixels of a picture; transparent ones are not dark."""
    path = next((position for position in candidates(name) if position.is_file()), None)
    if path is None:
        raise InputError(f"no picture {name}: give design.keep_out=FILE.png, or polygons")
    try:
        with Image.open(path) as file:
            cover = file.convert("RGBA")
        pixels = np.asarray(Image.alpha_composite(Image.new("RGBA", cover.size, "white"), cover).convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"cannot read design.keep_out={name}: {error}; give a PNG of the whole surface, dark where no "
            "sensor may be"
        ) from error
    height, width = pixels.shape
    if abs(math.log(width / height * size[1] / size[0])) > _ASPECT:
        raise InputError(
            f"design.keep_out={name} has {width} x {height} pixels, but the surface has {size[0]:g} x "
            f"{size[1]:g} m: give a picture of the whole surface with its aspect ratio"
        )
    return pixels < _DARK


def _along(extent: float, pitch: float, footprint: float) -> np.ndarray:
    """Return the sites along one side, m: centres of equal tiles about its middle."""
    count = int(extent / pitch + 1e-6)
    centres = extent / 2 + pitch * (np.arange(count) - (count - 1) / 2)
    return centres[np.minimum(centres, extent - centres) >= footprint / 2 - _ROUNDING]


def _covered(
    forbidden: np.ndarray,
    size: tuple[float, float],
    sites: tuple[np.ndarray, np.ndarray],
    footprint: tuple[float, float],
) -> np.ndarray:
    """Return the fraction of the footprint that is forbidden, at each y and x of the sites, (n_y, n_x)."""
    fractions = [
        overlaps(np.linspace(0, extent, count + 1), centres, length) / length
        for extent, count, centres, length in zip(size, forbidden.shape[::-1], sites, footprint, strict=True)
    ]
    return fractions[1] @ forbidden @ fractions[0].T


# The sites of a skin, the sensors that stay, and other layouts for comparison.


_TILE = 4.0  # largest aspect ratio of the tiles of a grid


@dataclass(frozen=True)
class PlacementProblem:
    """Sites, then the sensors of the configured layout, then those of a regular grid.

    Attributes:
        body: the body.
        sensors: all of these.
        sites: number of sites.
        kept: (K,), indices of the sensors that stay.
        layout: those of the configured layout.
        count: number of sensors to place, with those that stay.
        distance: least distance of a new sensor from all others, m.
    """

    body: AbstractBody
    sensors: Sensors
    sites: int
    kept: np.ndarray
    layout: np.ndarray
    count: int
    distance: float

    @classmethod
    def of(
        cls,
        device: Simulated,
        forbidden: np.ndarray | None,
        count: int | None,
        keep: str | Sequence[int],
        distance: float,
        raster: float | tuple[float, float] | None,
    ) -> "PlacementProblem":
        """Return the problem for the skin of a device.

        Args:
            device: of the body and of the configured layout.
            forbidden: the keep-out zones (:func:`skin.design.placement.keep_out`), (h, w), bool; or None.
            count, keep, distance, raster: as in :class:`skin.design.place.Place`.

        Raises:
            InputError: numbers that do not fit the layout or the sites.
        """
        body, old = device.body, device.sensors
        if old.axes > 1:
            raise InputError(
                "design=place chooses sensors of one axis, got a layout of three: place them with "
                "layout.axes=normal, then give each position three directions in the file"
            )
        count = len(old) if count is None else count
        staying = _find_staying(keep, len(old), count)
        depths, numbers = np.unique(old.positions[:, 2], return_counts=True)
        depth = float(depths[numbers.argmax()])
        sites = candidate_sites(body, old.footprint, depth, raster, forbidden)
        if count - len(staying) > len(sites):
            raise InputError(
                f"design.count={count} needs {count - len(staying)} sites, and there are {len(sites)}: lower "
                "design.count, set a finer design.raster, or shrink the zones of design.keep_out"
            )
        every = [sites, old, *_grid(body, count, old.footprint, depth)]
        positions, normals = (
            np.concatenate([getattr(group, name) for group in every]) for name in ("positions", "normals")
        )
        sensors = Sensors(positions, old.footprint, normals)
        layout = len(sites) + np.arange(len(old))
        return cls(body, sensors, len(sites), layout[staying], layout, count, distance)

    def solve(self, signal: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the chosen sensors, in the order of the layout, and what is known of them.

        Args:
            signal: covariance of the readings of all sensors divided by the variance of the noise.
        """
        eligible = np.concatenate([np.arange(self.sites), self.kept])
        fixed = self.sites + np.arange(len(self.kept))
        near = too_near(self.sensors.positions[eligible, :2], self.distance)
        inner = signal[np.ix_(eligible, eligible)]
        sites = exchange(inner, greedy(inner, self.count, near, fixed), near, len(fixed))
        fresh = eligible[sites[len(fixed) :]]
        x, y = self.sensors.positions[fresh, :2].T.round(6)
        chosen = np.concatenate([self.kept, fresh[np.lexsort((x, y))]])
        others = {"configured": self.layout, "grid": np.arange(self.layout[-1] + 1, len(signal))}
        layouts = {
            name: {"sensors": len(rows), "information_nats": mutual_information(signal, rows)}
            for name, rows in others.items()
            if len(rows)
        }
        information = mutual_information(inner, sites)
        return chosen, {"sensors": self.count, "information_nats": information, "layouts": layouts}


def _find_staying(keep: str | Sequence[int], sensors: int, count: int) -> np.ndarray:
    """Return the indices of the sensors of a layout that stay, in its order; less than ``count``."""
    numbers = range(1, sensors + 1) if isinstance(keep, str) else sorted(set(keep))
    if beyond := [number for number in numbers if number > sensors]:
        raise InputError(
            f"design.keep names sensor {beyond[0]}, but the layout has {sensors}: give numbers from 1 to "
            f"{sensors}, or all"
        )
    if numbers and count <= len(numbers):
        raise InputError(
            f"design.keep keeps {len(numbers)} sensors, and design.count={count} leaves none to place: set "
            f"design.count={len(numbers) + 1} or more, or keep fewer"
        )
    return np.array(numbers, dtype=int) - 1


def _grid(body: AbstractBody, count: int, footprint: tuple[float, float], depth: float) -> list[Sensors]:
    """Return a grid of as many sensors, the one whose tiles are nearest to squares, if one exists."""

    def aspect(rows: int) -> tuple[float, int]:
        sides = body.size[0] * rows / count, body.size[1] / rows
        return round(max(sides) / min(sides), 6), abs(rows - count // rows)

    rows = min((rows for rows in range(1, count + 1) if count % rows == 0), key=aspect)
    if aspect(rows)[0] > _TILE:
        return []
    return [Grid(rows, count // rows, footprint, depth=depth).sensors(body)]
