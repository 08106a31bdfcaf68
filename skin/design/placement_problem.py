"""The sites of a skin, the sensors that stay, and other layouts for comparison."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skin.body.base import AbstractBody
from skin.design.candidates import candidate_sites
from skin.design.placement import Sites, exchange, greedy, mutual_information, too_near
from skin.design.relaxation import upper_bound
from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.layout.grid import Grid
from skin.rng import Stream, generator
from skin.sensors import Sensors

_RANDOM = 100  # layouts
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
        device: AbstractSimulated,
        forbidden: np.ndarray | None,
        count: int | None,
        keep: str | Sequence[int],
        distance: float,
        raster: float | tuple[float, float] | None,
    ) -> "PlacementProblem":
        """Return the problem for the skin of a device.

        Args:
            device: of the body and of the configured layout.
            forbidden: the keep-out zones (:func:`skin.design.candidates.keep_out`), (h, w), bool; or None.
            count, keep, distance, raster: as in :class:`skin.design.place.Place`.

        Raises:
            InputError: numbers that do not fit the layout or the sites.
        """
        body, old = device.body, device.sensors
        count = len(old) if count is None else count
        kept = _kept(keep, len(old), count)
        depths, numbers = np.unique(old.positions[:, 2], return_counts=True)
        depth = float(depths[numbers.argmax()])
        sites = candidate_sites(body, old.footprint, depth, raster, forbidden)
        if count - len(kept) > len(sites):
            raise InputError(
                f"design.count={count} needs {count - len(kept)} sites, and there are {len(sites)}: lower "
                "design.count, set a finer design.raster, or shrink the zones of design.keep_out"
            )
        every = [sites, old, *_grid(body, count, old.footprint, depth)]
        positions, normals = (
            np.concatenate([getattr(one, name) for one in every]) for name in ("positions", "normals")
        )
        sensors = Sensors(positions, old.footprint, normals)
        layout = len(sites) + np.arange(len(old))
        return cls(body, sensors, len(sites), layout[kept], layout, count, distance)

    def solve(self, signal: np.ndarray, seed: int) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the chosen sensors, in the order of the layout, and what is known of them.

        Args:
            signal: covariance of the readings of all sensors divided by the variance of the noise.
            seed: of the random layouts.
        """
        eligible = np.concatenate([np.arange(self.sites), self.kept])
        fixed = self.sites + np.arange(len(self.kept))
        near = too_near(self.sensors.positions[eligible, :2], self.distance)
        inner = signal[np.ix_(eligible, eligible)]
        found = exchange(inner, greedy(inner, self.count, near, fixed), near, len(fixed))
        value, bound = mutual_information(inner, found), upper_bound(inner, self.count, fixed)
        fresh = eligible[found[len(fixed) :]]
        x, y = self.sensors.positions[fresh, :2].T.round(6)
        chosen = np.concatenate([self.kept, fresh[np.lexsort((x, y))]])
        others = {"configured": self.layout, "grid": np.arange(self.layout[-1] + 1, len(signal))}
        layouts = {
            name: {"sensors": len(rows), "information_nats": mutual_information(signal, rows)}
            for name, rows in others.items()
            if len(rows)
        }
        if drawn := best_of_random(inner, self.count, near, fixed, seed):
            information = mutual_information(inner, drawn)
            layouts["best_of_random"] = {"sensors": self.count, "information_nats": information}
        known = {"sensors": self.count, "information_nats": value, "bound_nats": bound}
        return chosen, known | {"share_of_bound": value / bound, "layouts": layouts}


def best_of_random(
    signal: np.ndarray, count: int, near: np.ndarray, fixed: Sites = (), seed: int = 0
) -> list[int]:
    """Return the most informative of 100 random choices of sites; none if the sites do not fit in any.

    Args:
        signal, count, near, fixed: as of :func:`skin.design.placement.greedy`.
        seed: of the choices.
    """
    draws = (_drawn(near, count, fixed, generator(Stream.PLACEMENT, seed, 0, n)) for n in range(_RANDOM))
    whole = (sites for sites in draws if len(sites) == count)
    return max(whole, key=lambda sites: mutual_information(signal, sites), default=[])


def _kept(keep: str | Sequence[int], sensors: int, count: int) -> np.ndarray:
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


def _drawn(near: np.ndarray, count: int, fixed: Sites, draw: np.random.Generator) -> list[int]:
    """Return sites that are drawn at random, or fewer if no more fit."""
    sites = [int(site) for site in fixed]
    taken = np.asarray(near[sites].any(axis=0))
    for site in map(int, draw.permutation(len(near))):
        if len(sites) < count and not taken[site]:
            sites.append(site)
            taken |= near[site]
    return sites
