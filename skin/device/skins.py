"""Touches on many skins, each drawn at random."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge
from rich.console import Console
from rich.progress import track
from torch import Tensor

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout
from skin.body.sensors import GEOMETRY, Sensors
from skin.core.rng import Stream, generator
from skin.core.settings import check_settings, configured
from skin.device.base import AbstractDevice, Blank, Split, in_threads, split_slices
from skin.device.imperfection import Imperfection, ImperfectionSettings
from skin.device.simulated import Simulated
from skin.device.skin_distribution import DrawnSkin, SkinDistribution
from skin.device.touches import Touches
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.gesture import GestureSettings
from skin.touch.labels import TOUCH

_GROUP = 128  # largest number of gestures on one skin at a time; fewer take longer
_DEAD = 4  # at most one of so many sensors is dead
_TRAINING, _TEST = 0, 1
_NUMBERS = {"train": 0, "validation": 1, "holdout": 2, "test": 3}


@dataclass(kw_only=True, eq=False)
class Skins(ImperfectionSettings, AbstractDevice):
    """Yields gestures on skins that differ in body, layout and mechanics, each measured by another device.

    Training, validation and holdout gestures are on the same skins; those of ``test`` are on others, all with
    the mechanics of an elastic solid. Skins with fewer sensors than the largest one get sensors that are
    never valid.

    Args:
        body, layout, simulator: of the skin to use the run on (:attr:`reference`); the drawn skins have their
            own.
        skins: the distribution (:class:`skin.device.skin_distribution.SkinDistribution`).
        count: number of skins to train on.
        test_skins: number of skins to test on.
        skin_seed: of the skins.
        touch, gestures, test_gestures, padded, fresh, data_seed: as in
            :class:`skin.device.simulated.Simulated`.
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
    touch: Mapping[str, Any] | GestureSettings | None = None
    gestures: Annotated[int, Ge(10)] = 40_000
    test_gestures: Annotated[int, Ge(1)] = 4000
    padded: bool = True
    fresh: bool = True
    data_seed: int = 0

    def __post_init__(self) -> None:
        settings = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        check_settings(type(self), settings, "device")
        self.distribution = configured(SkinDistribution, self.skins, "device.skins")
        self.task, self.size, self.sensors = TOUCH, self.body.size, self.layout.sensors(self.body)
        self.window = GestureSettings.of(self.touch).frames.window
        self._kept: dict[str, Touches] = {}

    @cached_property
    def training_skins(self) -> list[Simulated]:
        """The skins to train on; their mechanics are solved at the first use, and cached on disk."""
        return self._prepare(_TRAINING, self.count)

    @cached_property
    def unseen_skins(self) -> list[Simulated]:
        """The skins to test on."""
        return self._prepare(_TEST, self.test_skins)

    @property
    def reference(self) -> Simulated:
        """The skin of body, layout and simulator, with other imperfections in every touch."""
        return self._simulated(DrawnSkin(self.body, self.layout, self.simulator, 0.0), 0)

    def strips(self) -> Iterator[Touches]:
        """Yield test streams on :attr:`reference`, without end."""
        return self.reference.strips()

    def _prepare(self, part: int, count: int) -> list[Simulated]:
        console, terminal = Console(stderr=True), sys.stderr.isatty()
        numbers = track(range(count), "preparing skins", console=console, disable=not terminal)
        for number in numbers:
            # What solves a skin keeps large factors; made again, it reads its operator from the disk.
            self._skin(part, number).geometry  # noqa: B018
        return [self._skin(part, number) for number in range(count)]

    def _skin(self, part: int, number: int) -> Simulated:
        random = generator(Stream.SKIN, self.skin_seed, part, number)
        return self._simulated(self.distribution.draw(random, mixed=part == _TRAINING), number)

    def _simulated(self, skin: DrawnSkin, number: int) -> Simulated:
        imperfections = {entry.name: getattr(self, entry.name) for entry in fields(ImperfectionSettings)}
        sensors = len(skin.layout.sensors(skin.body))
        imperfections["dead"] = [
            min(limit, sensors // _DEAD) for limit in Imperfection.of(self, None).dead_range
        ]
        return Simulated(
            body=skin.body,
            layout=skin.layout,
            simulator=skin.simulator,
            position_error=skin.position_error,
            touch=self.touch,
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

    def _draw(self, skins: Sequence[Simulated], count: int, key: tuple[int, ...]) -> Touches:
        """Return gestures in groups, each on a drawn skin; every skin is drawn once before any again."""
        most = min(_GROUP, -(-count // len(skins)))
        sizes = [min(most, count - first) for first in range(0, count, most)]
        rounds = -(-len(sizes) // len(skins))
        # No skin has the key of the test touches: they keep the order of the published ones.
        order = generator(Stream.SKIN if key[1] == _NUMBERS["test"] else Stream.SKIN_ORDER, *key)
        chosen = np.concatenate([order.permutation(len(skins)) for _ in range(rounds)])

        def draw(number: int) -> Touches:
            skin = skins[chosen[number]]
            return skin.draw(Stream.SKIN, sizes[number], *key, number)

        return join_skins(in_threads(draw, len(sizes)))

    def blank(self) -> AbstractDevice:
        """Return a device with a touch of the same shapes on the skin of body and layout."""
        sensors = len(self.sensors)
        empty = torch.zeros(1, self.window, sensors)
        geometry = torch.ones(sensors, len(GEOMETRY))
        positions = torch.from_numpy(self.sensors.positions).float()
        rate = float(GestureSettings.of(self.touch).rate)
        touches = Touches(empty, empty == 0, positions, None, rate, geometry=geometry)
        return Blank.of(self.task, self.size, touches)


def join_skins(parts: Sequence[Touches]) -> Touches:
    """Return touches on several skins as one; skins with few sensors get more, which are not valid.

    Args:
        parts: each with positions (S, 3) and geometry (S, G) of its own.
    """
    most = max(part.readings.shape[2] for part in parts)
    first = parts[0]

    def together(name: str, axis: int) -> Tensor:
        return torch.cat([_widen(getattr(part, name), most, axis) for part in parts])

    def expanded(name: str) -> Tensor:
        return torch.cat([_widen(getattr(part, name), most, 0).expand(len(part), -1, -1) for part in parts])

    return Touches(
        together("readings", 2),
        together("valid", 2),
        expanded("positions"),
        torch.cat([part.known_labels for part in parts]),
        first.rate,
        saturated=together("saturated", 2),
        geometry=expanded("geometry"),
    )


def _widen(values: Tensor, sensors: int, axis: int) -> Tensor:
    """Return values with zeros, or False, for further sensors along an axis."""
    shape = list(values.shape)
    shape[axis] = sensors - shape[axis]
    return torch.cat([values, values.new_zeros(shape)], dim=axis)
