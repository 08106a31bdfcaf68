"""Skins drawn at random, and a device that simulates touches on them."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Ge, Le, MinLen
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from rich.console import Console
from rich.progress import track
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import pad

from skin.body.arm import Arm
from skin.body.base import GEOMETRY, AbstractBody, Layer, Sensors
from skin.body.layout import AbstractLayout, Footprint, Grid, Hexagonal, Listed, Random, Scattered
from skin.body.material import Material
from skin.body.sheet import Sheet
from skin.core.rng import Stream, generator
from skin.core.settings import RISING, checked, configured
from skin.device.base import AbstractDevice, Blank, Split, in_threads, split_slices
from skin.device.imperfection import Imperfection, ImperfectionSettings
from skin.device.simulated import Simulated
from skin.device.touches import Touches, join_contacts
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid
from skin.touch.fingertips import read_touch
from skin.touch.labels import TOUCH
from skin.touch.paths import TouchSettings

Range = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]
Kind = Literal["grid", "scattered", "hexagonal", "random", "clustered", "spread"]
Make = Callable[[AbstractBody, Sensors], AbstractSimulator]


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
        depth: of the sensors, as a fraction of the thickness of the top layer.
        arms: fraction of skins on a cylinder.
        radius: of the cylinders, m.
        position_error: standard deviation of the sensors' true positions from those of the layout, m.
        divisions: rows of elements in each layer; None: as few as readings under a fingertip need.
        plates: fraction of sheets with plates on beams (:mod:`skin.mechanics.simulator.fem`);
            their sensors are between the layers.
        naive: fraction of sheets without mechanics.
        interface: fraction of sheets that read the forces between the layers of plates on beams, and are
            described as an elastic solid, because their owner does not know better.
        footprint_error: standard deviation of the logarithm of the true over the layout's side of footprints.
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
    divisions: PositiveInt | None = None
    plates: Annotated[float, Ge(0), Le(1)] = 0.0
    naive: Annotated[float, Ge(0), Le(1)] = 0.0
    interface: Annotated[float, Ge(0), Le(1)] = 0.0
    footprint_error: NonNegativeFloat = 0.0

    def __post_init__(self) -> None:
        if (total := self.plates + self.naive + self.interface) > 1:
            raise InputError(
                "device.skins.plates + device.skins.naive + device.skins.interface must be at most 1, got "
                f"{total:g}: make one of them smaller"
            )

    def draw(self, generator: np.random.Generator, mixed: bool = False) -> dict[str, Any]:
        """Return the settings of a skin, as :class:`skin.device.simulated.Simulated` takes them.

        Args:
            generator: of random numbers.
            mixed: with any mechanics; otherwise those of an elastic solid.
        """
        body = self._body(generator)
        count = round(_logarithmic(self.sensors, generator))
        kind, top = str(generator.choice(self.layouts)), body.layers[-1].thickness
        depth = top * generator.uniform(*self.depth)
        side = generator.uniform(*self.footprint)
        solid: Make = partial(Solid, divisions=self.divisions)
        simulator, described = solid, None
        drawn = generator.random() if mixed and isinstance(body, Sheet) else generator.random() + 1
        if drawn < self.plates:
            simulator = PlatesAndBeams
        elif drawn < self.plates + self.naive:
            simulator = Naive
        elif drawn < self.plates + self.naive + self.interface:
            simulator, described = partial(PlatesAndBeams, reading="interface"), solid
        # Plates on beams know forces between layers only.
        depth = depth if simulator in (solid, Naive) else top
        layout = _layout(kind, count, body.size, side, depth, generator)
        return {
            "body": body,
            "layout": layout,
            "simulator": simulator,
            "position_error": generator.uniform(*self.position_error),
            "footprint_error": self.footprint_error if mixed else 0.0,
            "described": described,
        }

    def outside(self, body: AbstractBody, sensors: Sensors, rounding: float = 1e-6) -> list[str]:
        """Return the quantities of a skin outside the ranges, as "number of sensors 100 (4 to 64)"."""
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
            if not low * (1 - rounding) <= value <= high * (1 + rounding)
        ]

    def _body(
        self, generator: np.random.Generator, poisson: float = 0.49, fewest_cells: int = 8
    ) -> AbstractBody:
        longer = generator.uniform(*self.length)
        shorter = longer / generator.uniform(*self.aspect)
        sides = (longer, shorter) if generator.random() < 0.5 else (shorter, longer)
        base, top = generator.uniform(*self.base), generator.uniform(*self.top)
        stiff, soft = (_logarithmic(limits, generator) for limits in (self.base_young, self.top_young))
        layers = (
            Layer(Material("base", stiff, poisson), base),
            Layer(Material("top", soft, poisson), top),
        )
        across, along = (max(fewest_cells, round(side / self.cell)) for side in sides)
        radius = max(generator.uniform(*self.radius), 1.2 * (base + top))
        if generator.random() < self.arms and sides[0] < 1.8 * math.pi * radius:
            cells = (across, along)
            return Arm(cells=cells, layers=layers, radius=radius, length=sides[1], angle=sides[0] / radius)  # type: ignore[misc]
        return Sheet(sides, (across, along), layers)


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
        generator: of random positions.
    """
    rows = max(1, round(math.sqrt(count * size[1] / size[0])))
    columns = max(1, math.ceil(count / rows))
    pitch = min(size[0] / columns, size[1] / rows)
    seed = int(generator.integers(2**31))
    if kind == "spread":
        positions = _spread(count, size, generator)
        apart = np.abs(positions[:, None] - positions).max(axis=2)[~np.eye(count, dtype=bool)]
        return _listed(positions, (min(side, float(apart.min())),) * 2, depth)
    if kind in ("random", "clustered"):
        # Random positions fill less than half of the surface.
        footprint = (min(side, 0.6 * math.sqrt(math.prod(size) / count)),) * 2
        if kind == "random":
            return Random(count, seed, footprint, depth)
        return _listed(_clustered(count, size, footprint[0], generator), footprint, depth)
    footprint = (min(side, pitch / 2),) * 2
    if kind == "grid":
        return Grid(rows, columns, footprint, depth=depth)
    if kind == "hexagonal":
        return Hexagonal(rows, columns, footprint, depth)
    return Scattered(rows, columns, 0.25, seed, footprint, depth=depth)


def _listed(positions: np.ndarray, footprint: Footprint, depth: float) -> Listed:
    """Return sensors at positions (S, 2), m, in one depth, m."""
    return Listed(np.column_stack([positions, np.full(len(positions), depth)]).tolist(), footprint)


def _clustered(
    count: int, size: tuple[float, float], side: float, generator: np.random.Generator, tries: int = 2000
) -> np.ndarray:
    """Return positions (S, 2), m, around a few centres, at least ``side`` apart along x or y."""
    extent = np.array(size)
    centres = generator.random((generator.integers(2, 5), 2)) * extent
    spread, positions = 0.15 * extent, np.empty((0, 2))
    for attempt in range(tries):
        wide = spread * (1 + 4 * attempt / tries)
        candidate = centres[generator.integers(len(centres))] + wide * generator.normal(size=2)
        candidate = np.clip(candidate, side / 2, extent - side / 2)
        if (np.abs(positions - candidate) >= side).any(axis=1).all():
            positions = np.vstack([positions, candidate])
        if len(positions) == count:
            break
    return positions[np.argsort(positions[:, 1], kind="stable")]


def _spread(
    count: int, size: tuple[float, float], generator: np.random.Generator, rounds: int = 20
) -> np.ndarray:
    """Return positions (S, 2), m, that divide the surface evenly without rows, as informative layouts do.

    Each position is in the middle of the region that is nearer to it than to the others (Lloyd's algorithm).
    """
    extent = np.array(size)
    samples, positions = (generator.random((number, 2)) * extent for number in (50 * count, count))
    for _ in range(rounds):
        nearest = cKDTree(positions).query(samples)[1]
        counts = np.bincount(nearest, minlength=count)[:, None]
        sums = np.stack([np.bincount(nearest, values, count) for values in samples.T], axis=1)
        positions = np.where(counts > 0, sums / counts.clip(min=1), positions)
    return positions[np.argsort(positions[:, 1], kind="stable")]


# Touches on many skins, each drawn at random.


_NUMBERS = {"train": 0, "validation": 1, "holdout": 2, "test": 3}


@checked("device")
@dataclass(kw_only=True, eq=False)
class Skins(ImperfectionSettings, AbstractDevice):
    """Yields gestures on skins that differ in body, layout and mechanics, each measured by another device.

    Training, validation and holdout gestures are on the same skins; those of ``test`` are on others, all with
    the mechanics of an elastic solid. Skins with fewer sensors than the largest one get sensors that are
    never valid.

    Args:
        body, layout, simulator: of the skin to use the run on (:attr:`reference`); the drawn skins have their
            own.
        skins: the distribution (:class:`skin.device.skins.SkinDistribution`).
        count: number of skins to train on.
        test_skins: number of skins to test on.
        skin_seed: of the skins.
        touch, gestures, test_gestures, padded, fresh, data_seed: as in
            :class:`skin.device.simulated.Simulated`.
        training_touch: settings of ``touch`` that differ on the skins to train on.
        gain_spread, offset, noise, ...: as there; every gesture has a device of its own.

    Raises:
        InputError: invalid settings.
    """

    body: AbstractBody
    layout: AbstractLayout
    simulator: Callable[[AbstractBody, Sensors], AbstractSimulator]
    skins: Mapping[str, Any]
    count: Annotated[int, Ge(1)] = 200
    test_skins: Annotated[int, Ge(1)] = 20
    skin_seed: Annotated[int, Ge(0)] = 0
    touch: Mapping[str, Any] | TouchSettings | None = None
    training_touch: Mapping[str, Any] = field(default_factory=dict)
    gestures: Annotated[int, Ge(10)] = 40_000
    test_gestures: Annotated[int, Ge(1)] = 4000
    padded: bool = True
    fresh: bool = True
    data_seed: int = 0

    def __post_init__(self) -> None:
        self.distribution = configured(SkinDistribution, self.skins, "device.skins")
        settings = read_touch(self.touch)
        self.task, self.window = TOUCH.with_labels(tuple(settings.labels)), settings.frames.window
        self.size, self.sensors = self.body.size, self.layout.sensors(self.body)
        self._wider = wider_touch(self.touch, self.training_touch)
        self._kept: dict[str, Touches] = {}

    @cached_property
    def training_skins(self) -> list[Simulated]:
        """The skins to train on; their mechanics are solved at the first use, and cached on disk."""
        return self._prepare(True, self.count)

    @cached_property
    def unseen_skins(self) -> list[Simulated]:
        """The skins to test on."""
        return self._prepare(False, self.test_skins)

    @property
    def reference(self) -> Simulated:
        """The skin of body, layout and simulator, with other imperfections in every touch."""
        return self._simulated(
            {"body": self.body, "layout": self.layout, "simulator": self.simulator}, 0, self.touch
        )

    def strips(self) -> Iterator[Touches]:
        """Yield test streams on :attr:`reference`, without end."""
        return self.reference.strips()

    def _prepare(self, training: bool, count: int) -> list[Simulated]:
        console = Console(stderr=True)
        for number in track(
            range(count), "preparing skins", console=console, disable=not console.is_terminal
        ):
            # What solves a skin keeps large factors; made again, it reads its operator from the disk.
            self._skin(training, number).geometry  # noqa: B018
        return [self._skin(training, number) for number in range(count)]

    def _skin(self, training: bool, number: int) -> Simulated:
        random = generator(Stream.SKIN, self.skin_seed, int(not training), number)
        touch = self._wider if training else self.touch
        return self._simulated(self.distribution.draw(random, mixed=training), number, touch)

    def _simulated(
        self, skin: Mapping[str, Any], number: int, touch: Mapping[str, Any] | TouchSettings | None
    ) -> Simulated:
        imperfections = {entry.name: getattr(self, entry.name) for entry in fields(ImperfectionSettings)}
        sensors = len(skin["layout"].sensors(skin["body"]))
        # At most one of four sensors is dead.
        imperfections["dead"] = [min(limit, sensors // 4) for limit in Imperfection.of(self, None).dead_range]
        return Simulated(
            **skin,
            touch=touch,
            padded=self.padded,
            randomise=True,
            seed=number,
            **imperfections,
        )

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split; those of ``train`` are new in every epoch if ``fresh``."""
        new = split == "train" and self.fresh
        if not new and split in self._kept:
            return self._kept[split]
        skins = self.unseen_skins if split == "test" else self.training_skins
        touches = range(self.gestures)[split_slices(self.gestures).get(split, slice(0))]
        count = self.test_gestures if split == "test" else len(touches)
        seed = 0 if split == "test" else self.data_seed
        drawn = self._draw(skins, count, (seed, _NUMBERS[split], epoch if new else 0))
        if not new:
            self._kept[split] = drawn
        return drawn

    def _draw(
        self, skins: Sequence[Simulated], count: int, key: tuple[int, ...], largest: int = 128
    ) -> Touches:
        """Return gestures in groups, each on a drawn skin; every skin is drawn once before any again.

        Groups of fewer gestures than ``largest`` take longer.
        """
        maximum = min(largest, -(-count // len(skins)))
        sizes = [min(maximum, count - first) for first in range(0, count, maximum)]
        rounds = -(-len(sizes) // len(skins))
        # No skin has the key of the test touches: they keep the order of the published ones.
        order = generator(Stream.SKIN if key[1] == _NUMBERS["test"] else Stream.SKIN_ORDER, *key)
        chosen = np.concatenate([order.permutation(len(skins)) for _ in range(rounds)])

        def draw(number: int) -> Touches:
            return skins[chosen[number]].draw(Stream.SKIN, sizes[number], *key, number)

        return join_skins(in_threads(draw, len(sizes)))

    def blank(self) -> AbstractDevice:
        """Return a device with a touch of the same shapes on the skin of body and layout."""
        empty = torch.zeros(1, self.window, len(self.sensors))
        geometry = torch.ones(len(self.sensors), len(GEOMETRY))
        positions = torch.from_numpy(self.sensors.positions).float()
        rate = float(read_touch(self.touch).rate)
        touches = Touches(empty, empty == 0, positions, None, rate, geometry=geometry)
        return Blank.of(self.task, self.size, touches)


def wider_touch(touch: Mapping[str, Any] | TouchSettings | None, changes: Mapping[str, Any]) -> TouchSettings:
    """Return the settings of touches with other ones of the same window.

    Args:
        touch: as :func:`skin.touch.fingertips.read_touch` takes it.
        changes: settings by name.

    Raises:
        InputError: settings that are not valid, or another window.
    """
    settings = read_touch(touch)
    given = {entry.name: getattr(settings, entry.name) for entry in fields(settings)}
    wider = type(settings).of(given | dict(changes))
    if (wider.frames.window, wider.rate) != (settings.frames.window, settings.rate):
        raise InputError("device.training_touch must keep touch.window and touch.rate: leave these two out")
    return wider


def join_skins(parts: Sequence[Touches]) -> Touches:
    """Return touches on several skins as one; skins with few sensors get more, which are not valid.

    Args:
        parts: each with positions (S, 3) and geometry (S, G) of its own.
    """
    counts = [part.readings.shape[2] for part in parts]

    def joined(name: str, after: int = 0) -> Tensor:
        """Join tensors with so many dimensions after the one of the sensors, as wide as the widest."""
        further = (0, 0) * after
        return torch.cat(
            [
                pad(getattr(part, name), (*further, 0, max(counts) - count)).expand(len(part), -1, -1)
                for part, count in zip(parts, counts, strict=True)
            ]
        )

    return Touches(
        joined("readings"),
        joined("valid"),
        joined("positions", after=1),
        torch.cat([part.known_labels for part in parts]),
        parts[0].rate,
        saturated=joined("saturated"),
        geometry=joined("geometry", after=1),
        contacts=join_contacts([part.contacts for part in parts]),
    )
