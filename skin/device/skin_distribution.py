"""Skins drawn at random: body, layout and mechanics."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le, MinLen
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from scipy.spatial import cKDTree

from skin.body.arm import Arm
from skin.body.base import AbstractBody, Layer
from skin.body.layout.base import AbstractLayout, Footprint, place_sensors
from skin.body.layout.grid import Grid
from skin.body.layout.hexagonal import Hexagonal
from skin.body.layout.random import Random
from skin.body.layout.scattered import Scattered
from skin.body.material import Material
from skin.body.sensors import Sensors
from skin.body.sheet import Sheet
from skin.core.settings import RISING, checked
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid

Range = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]
Kind = Literal["grid", "scattered", "hexagonal", "random", "clustered", "spread"]
Make = Callable[[AbstractBody, Sensors], AbstractSimulator]

_POISSON = 0.49
_TRIES = 2000
_LEAST_CELLS = 8
_ROUNDS = 20
_EQUAL = 1e-6


@dataclass(frozen=True)
class DrawnSkin:
    """A skin without touches.

    Attributes:
        body: the body.
        layout: of its sensors.
        simulator: ``simulator(body, sensors)``.
        position_error: standard deviation of the true positions from those of the layout, m.
    """

    body: AbstractBody
    layout: AbstractLayout
    simulator: Make
    position_error: float


@checked("device.skins")
@dataclass(frozen=True, kw_only=True)
class SkinDistribution:
    """Ranges of skins of two layers; all are uniform, moduli and numbers of sensors on a logarithmic scale.

    Attributes:
        length: of the longer side, m.
        aspect: longer over shorter side.
        cell: side of a cell, m.
        sensors: least and largest number.
        layouts: kinds of layouts, each equally likely.
        footprint: side of the square that a sensor feels, m.
        base, top: thickness of the layers, m.
        base_young, top_young: their moduli, Pa.
        depth: of the sensors, as a share of the thickness of the top layer.
        arms: share of skins on a cylinder.
        radius: of the cylinders, m.
        position_error: standard deviation of the sensors' true positions from those of the layout, m.
        divisions: rows of elements in each layer.
        plates: share of sheets with the mechanics of plates on beams (:mod:`skin.mechanics.simulator.fem`);
            their sensors are between the layers.
        naive: share of sheets without mechanics.
    """

    length: Range
    aspect: Range
    cell: PositiveFloat
    sensors: Annotated[tuple[PositiveInt, PositiveInt], RISING]
    layouts: Annotated[tuple[Kind, ...], MinLen(1)]
    footprint: Range
    base: Range
    top: Range
    base_young: Range
    top_young: Range
    depth: Range
    arms: Annotated[float, Ge(0), Le(1)]
    radius: Range
    position_error: Annotated[tuple[NonNegativeFloat, NonNegativeFloat], RISING]
    divisions: PositiveInt
    plates: Annotated[float, Ge(0), Le(1)] = 0.0
    naive: Annotated[float, Ge(0), Le(1)] = 0.0

    def __post_init__(self) -> None:
        if self.plates + self.naive > 1:
            raise InputError(
                "device.skins.plates + device.skins.naive must be at most 1, got "
                f"{self.plates + self.naive:g}: make one of them smaller"
            )

    def draw(self, generator: np.random.Generator, mixed: bool = False) -> DrawnSkin:
        """Return a skin.

        Args:
            generator: of random numbers.
            mixed: with any mechanics; otherwise that of an elastic solid.
        """
        body = self._body(generator)
        count = round(_logarithmic(self.sensors, generator))
        kind, top = str(generator.choice(self.layouts)), body.layers[-1].thickness
        depth = top * generator.uniform(*self.depth)
        side = generator.uniform(*self.footprint)
        simulator: Make = partial(Solid, divisions=self.divisions)
        chance = generator.random()
        if mixed and isinstance(body, Sheet) and chance < self.plates + self.naive:
            plates = chance < self.plates
            simulator = PlatesAndBeams if plates else Naive
            depth = top if plates else depth  # plates on beams know forces between layers only
        layout = _layout(kind, count, body.size, side, depth, generator)
        return DrawnSkin(body, layout, simulator, generator.uniform(*self.position_error))

    def outside(self, body: AbstractBody, sensors: Sensors) -> list[str]:
        """Return what of a skin lies outside the ranges, as "number of sensors 100 (4 to 64)"."""
        shorter, longer = sorted(body.size)
        numbers: list[tuple[str, float, tuple[float, float], str]] = [
            ("longer side", longer, self.length, " m"),
            ("ratio of the sides", longer / shorter, self.aspect, ""),
            ("number of sensors", len(sensors), self.sensors, ""),
            ("side of a footprint", math.sqrt(math.prod(sensors.footprint)), self.footprint, " m"),
        ]
        if isinstance(body, Arm):
            numbers.append(("radius", body.radius, self.radius, " m"))
        if len(body.layers) != 2:
            numbers.append(("number of layers", len(body.layers), (2, 2), ""))
        else:
            (base, top), depths = body.layers, sensors.positions[:, 2]
            numbers += [
                ("thickness of the lower layer", base.thickness, self.base, " m"),
                ("thickness of the upper layer", top.thickness, self.top, " m"),
                ("modulus of the lower layer", base.material.young, self.base_young, " Pa"),
                ("modulus of the upper layer", top.material.young, self.top_young, " Pa"),
                ("least depth over upper layer", float(depths.min()) / top.thickness, self.depth, ""),
                ("largest depth over upper layer", float(depths.max()) / top.thickness, self.depth, ""),
            ]
        return [
            f"{name} {value:.3g}{unit} ({low:g} to {high:g}{unit})"
            for name, value, (low, high), unit in numbers
            if not low * (1 - _EQUAL) <= value <= high * (1 + _EQUAL)
        ]

    def _body(self, generator: np.random.Generator) -> AbstractBody:
        longer = generator.uniform(*self.length)
        shorter = longer / generator.uniform(*self.aspect)
        sides = (longer, shorter) if generator.random() < 0.5 else (shorter, longer)
        base, top = generator.uniform(*self.base), generator.uniform(*self.top)
        stiff, soft = (_logarithmic(limits, generator) for limits in (self.base_young, self.top_young))
        layers = (
            Layer(Material("base", stiff, _POISSON), base),
            Layer(Material("top", soft, _POISSON), top),
        )
        across, along = (max(_LEAST_CELLS, round(side / self.cell)) for side in sides)
        radius = max(generator.uniform(*self.radius), 1.2 * (base + top))
        if generator.random() < self.arms and sides[0] < 1.8 * math.pi * radius:
            cells = (across, along)
            return Arm(cells=cells, layers=layers, radius=radius, length=sides[1], angle=sides[0] / radius)  # type: ignore[misc]
        return Sheet(sides, (across, along), layers)


@dataclass(frozen=True)
class _Places(AbstractLayout):
    """Sensors at given places (S, 2), m."""

    places: np.ndarray
    footprint: Footprint
    depth: float

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return them in their order."""
        x, y = self.places.T
        return place_sensors(body, x, y, self.depth, self.footprint)


def _logarithmic(limits: tuple[float, float], generator: np.random.Generator) -> float:
    return math.exp(generator.uniform(*np.log(limits)))


def _layout(
    kind: str,
    count: int,
    size: tuple[float, float],
    side: float,
    depth: float,
    generator: np.random.Generator,
) -> AbstractLayout:
    """Return a layout of about ``count`` sensors that do not overlap.

    Args:
        kind: of the layout.
        count: of sensors.
        size: extent (x, y) of the surface, m.
        side: of the square that a sensor feels, m; smaller where the sensors would overlap.
        depth: of the sensors, m.
        generator: of random places.
    """
    rows = max(1, round(math.sqrt(count * size[1] / size[0])))
    columns = max(1, math.ceil(count / rows))
    pitch = min(size[0] / columns, size[1] / rows)
    seed = int(generator.integers(2**31))
    if kind == "spread":
        places = _spread(count, size, generator)
        apart = np.abs(places[:, None] - places).max(axis=2)[~np.eye(count, dtype=bool)]
        return _Places(places, (min(side, float(apart.min())),) * 2, depth)
    if kind in ("random", "clustered"):
        # Random places fill less than half of the surface.
        footprint = (min(side, 0.6 * math.sqrt(math.prod(size) / count)),) * 2
        if kind == "random":
            return Random(count, seed, footprint, depth)
        return _Places(_clustered(count, size, footprint[0], generator), footprint, depth)
    footprint = (min(side, pitch / 2),) * 2
    if kind == "grid":
        return Grid(rows, columns, footprint, depth=depth)
    if kind == "hexagonal":
        return Hexagonal(rows, columns, footprint, depth)
    return Scattered(rows, columns, 0.25, seed, footprint, depth=depth)


def _clustered(
    count: int, size: tuple[float, float], side: float, generator: np.random.Generator
) -> np.ndarray:
    """Return places (S, 2), m, around a few centres, at least ``side`` apart along x or y."""
    extent = np.array(size)
    centres = generator.random((generator.integers(2, 5), 2)) * extent
    spread, places = 0.15 * extent, np.empty((0, 2))
    for attempt in range(_TRIES):
        wide = spread * (1 + 4 * attempt / _TRIES)
        candidate = centres[generator.integers(len(centres))] + wide * generator.normal(size=2)
        candidate = np.clip(candidate, side / 2, extent - side / 2)
        if (np.abs(places - candidate) >= side).any(axis=1).all():
            places = np.vstack([places, candidate])
        if len(places) == count:
            break
    return places[np.argsort(places[:, 1], kind="stable")]


def _spread(count: int, size: tuple[float, float], generator: np.random.Generator) -> np.ndarray:
    """Return places (S, 2), m, that divide the surface evenly without rows, as informative layouts do.

    Each place is in the middle of the region that is nearer to it than to the others (Lloyd's algorithm).
    """
    extent = np.array(size)
    samples, places = (generator.random((number, 2)) * extent for number in (50 * count, count))
    for _ in range(_ROUNDS):
        nearest = cKDTree(places).query(samples)[1]
        shares = np.bincount(nearest, minlength=count)[:, None]
        sums = np.stack([np.bincount(nearest, values, count) for values in samples.T], axis=1)
        places = np.where(shares > 0, sums / shares.clip(min=1), places)
    return places[np.argsort(places[:, 1], kind="stable")]
