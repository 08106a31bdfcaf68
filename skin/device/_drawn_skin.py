"""Skins drawn at random: body, layout and mechanics."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le, MinLen
from pydantic import PositiveFloat, PositiveInt

from skin.body.arm import Arm
from skin.body.base import AbstractBody, Layer
from skin.body.sheet import Sheet
from skin.layout.base import AbstractLayout, Footprint, place
from skin.layout.grid import Grid
from skin.layout.hexagonal import Hexagonal
from skin.layout.random import Random
from skin.layout.scattered import Scattered
from skin.material import Material
from skin.sensors import Sensors
from skin.settings import RISING, checked
from skin.simulator.base import AbstractSimulator
from skin.simulator.solid import Solid

Range = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]
Kind = Literal["grid", "scattered", "hexagonal", "random", "clustered"]
Make = Callable[[AbstractBody, Sensors], AbstractSimulator]

_POISSON = 0.49
_TRIES = 2000
_LEAST_CELLS = 8


@dataclass(frozen=True)
class DrawnSkin:
    """A skin without touches.

    Attributes:
        body: the body.
        layout: of its sensors.
        simulator: ``simulator(body, sensors)``.
    """

    body: AbstractBody
    layout: AbstractLayout
    simulator: Make


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
        divisions: rows of elements in each layer.
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
    divisions: PositiveInt

    def draw(self, generator: np.random.Generator) -> DrawnSkin:
        """Return a skin."""
        longer = generator.uniform(*self.length)
        shorter = longer / generator.uniform(*self.aspect)
        sides = (longer, shorter) if generator.random() < 0.5 else (shorter, longer)
        base, top = generator.uniform(*self.base), generator.uniform(*self.top)
        stiff, soft = (_logarithmic(one, generator) for one in (self.base_young, self.top_young))
        layers = (
            Layer(Material("base", stiff, _POISSON), base),
            Layer(Material("top", soft, _POISSON), top),
        )
        cells = tuple(max(_LEAST_CELLS, round(side / self.cell)) for side in sides)
        body: AbstractBody = Sheet(sides, cells, layers)
        radius = max(generator.uniform(*self.radius), 1.2 * (base + top))
        if generator.random() < self.arms and sides[0] < 1.8 * math.pi * radius:
            body = Arm(cells=cells, layers=layers, radius=radius, length=sides[1], angle=sides[0] / radius)
        count = round(_logarithmic(self.sensors, generator))
        kind = str(generator.choice(self.layouts))
        depth = top * generator.uniform(*self.depth)
        layout = _layout(kind, count, body.size, generator.uniform(*self.footprint), depth, generator)
        return DrawnSkin(body, layout, partial(Solid, divisions=self.divisions))


@dataclass(frozen=True)
class _Places(AbstractLayout):
    """Sensors at given places (S, 2), m."""

    places: np.ndarray
    footprint: Footprint
    depth: float

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return them in their order."""
        return place(body, *self.places.T, self.depth, self.footprint)


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
        found = centres[generator.integers(len(centres))] + wide * generator.normal(size=2)
        found = np.clip(found, side / 2, extent - side / 2)
        if (np.abs(places - found) >= side).any(axis=1).all():
            places = np.vstack([places, found])
        if len(places) == count:
            break
    return places[np.argsort(places[:, 1], kind="stable")]
