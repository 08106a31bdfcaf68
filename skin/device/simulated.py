"""A simulated skin: sampled gestures, a simulator, and the imperfections of a device."""

import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from skin import __version__
from skin.body.sheet import Sheet
from skin.device.base import AbstractDevice, Split
from skin.errors import InputError
from skin.imperfection import Imperfection
from skin.labels import TOUCH
from skin.layout.base import AbstractLayout, Sensors
from skin.recording import Recording, Touches, join
from skin.simulator.base import AbstractSimulator
from skin.streams import Stream, generator
from skin.summary import summarise
from skin.touch.gesture import GestureSettings
from skin.touch.sampler import TouchSampler, balanced

__all__ = ["Simulated"]

_BATCH = 1024


@dataclass(kw_only=True, eq=False)
class Simulated(AbstractDevice):
    """Yields gestures sampled from seeds alone, as a device with imperfections feels them.

    Training, validation and holdout are 80/10/10 of one budget of gestures; test gestures come from a stream
    of randomness that no training seed can draw, and are the same for all of them.

    Args:
        body: the sheet.
        layout: where the sensors are.
        simulator: ``simulator(body, sensors)`` gives the map from pressure to true readings.
        touch: difficulty of the gestures (``conf/touch.yaml``).
        gestures: the budget.
        test_gestures: how many gestures ``test`` has.
        padded: gestures begin at a random frame of the window, not at its first.
        fresh: ``train`` draws new gestures, with new noise, in every epoch.
        data_seed: what the budget is drawn from.
        seed: what the device's constants and the noise are drawn from: another number, another device.
        gain_spread, offset, noise, clip, dead, tare: as in :class:`skin.imperfection.Imperfection`.
        randomise: every gesture is felt by a device of its own.
        position_error: standard deviation of the true sensors' places about the layout along x and y, m; the
            touches report the layout.
        rate: frames per second, Hz.

    Raises:
        InputError: settings that cannot be used.
    """

    body: Sheet
    layout: AbstractLayout
    simulator: Callable[[Sheet, Sensors], AbstractSimulator]
    touch: Mapping[str, Any] | GestureSettings | None = None
    gestures: int = 4038
    test_gestures: int = 4000
    padded: bool = True
    fresh: bool = False
    data_seed: int = 0
    seed: int = 0
    gain_spread: float = 0.05
    offset: float = 0.1
    noise: float = 0.05
    clip: float = 10.0
    dead: int = 0
    position_error: float = 0.0
    tare: bool = False
    randomise: bool = False
    rate: float = 10.0

    def __post_init__(self) -> None:
        for name, least in (("gestures", 10), ("test_gestures", 1), ("position_error", 0)):
            if not getattr(self, name) >= least:
                raise InputError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not self.rate > 0:
            raise InputError(f"device.rate must be above 0 Hz, got {self.rate}: as in device.rate=10")
        self.task, self.size = TOUCH, self.body.size
        self.sensors = self.layout.sensors(self.body)
        true = self._true_sensors()
        self.sampler = TouchSampler(self.body, self.body.footprints(true), self.touch, self.padded)
        self.window = self.sampler.settings.window
        self.model = self.simulator(self.body, true)
        self.imperfection = Imperfection(
            self.gain_spread, self.offset, self.noise, self.clip, self.dead, self.tare
        )
        self.constants = self.imperfection.constants(
            len(self.sensors), generator(Stream.CONSTANTS, self.seed)
        )
        self._kept: dict[str, Recording] = {}

    def _true_sensors(self) -> Sensors:
        moves = generator(Stream.POSITION, self.seed).standard_normal((len(self.sensors), 2))
        positions = self.sensors.positions.copy()
        positions[:, :2] = np.clip(positions[:, :2] + self.position_error * moves, 0, self.size)
        return replace(self.sensors, positions=positions)

    def replace(self, **changes: Any) -> "Simulated":
        """Return a device with other settings, such as ``seed=3`` for another device of the same kind."""
        return replace(self, **changes)

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split; fixed ones are drawn once and kept."""
        return self._split(split, epoch, complete=False).touches

    def recording(self, split: Split | None = None, epoch: int = 0) -> Recording:
        """Return the same touches with the applied force, the displacements and the gestures' parameters.

        Args:
            split: None takes the whole budget.
            epoch: matters to ``train`` with fresh gestures.
        """
        recording = self._split(split, epoch, complete=True)
        return replace(recording, metadata=self._metadata(recording, split, epoch))

    def _split(self, split: Split | None, epoch: int, complete: bool) -> Recording:
        if split == "test":
            return self._keep("test", complete, Stream.TEST, self.test_gestures)
        training = round(0.8 * self.gestures)
        if split == "train" and self.fresh:
            return self._draw(complete, Stream.FRESH, training, self.data_seed, epoch)
        budget = self._keep("budget", complete, Stream.BUDGET, self.gestures, self.data_seed)
        if split is None:
            return budget
        middle = training + (self.gestures - training) // 2
        bounds = {"train": (0, training), "validation": (training, middle), "holdout": (middle, None)}
        order = generator(Stream.SPLIT, self.data_seed).permutation(self.gestures)
        return budget[torch.from_numpy(order[slice(*bounds[split])])]

    def _keep(self, name: str, complete: bool, stream: Stream, count: int, *key: int) -> Recording:
        if complete:
            return self._draw(True, stream, count, *key)
        if name not in self._kept:
            self._kept[name] = self._draw(False, stream, count, *key)
        return self._kept[name]

    def _draw(self, complete: bool, stream: Stream, count: int, *key: int) -> Recording:
        """Draw gestures in batches; ``complete`` adds the displacements."""
        wanted = balanced(count, generator(stream, *key, 0))
        parts = _in_threads(
            lambda number: self._batch(
                wanted[number * _BATCH : (number + 1) * _BATCH], complete, stream, (*key, 1 + number)
            ),
            math.ceil(count / _BATCH),
        )
        return join(parts)

    @torch.no_grad()
    def _batch(self, wanted: np.ndarray, complete: bool, stream: Stream, key: tuple[int, ...]) -> Recording:
        movie = self.sampler.sample(len(wanted), generator(stream, *key), wanted)
        true, displacement = movie.respond(self.model, displacement=complete)
        noise = generator(Stream.NOISE, self.seed, stream, *key)
        constants = self.constants
        if self.randomise:
            constants = self.imperfection.constants(len(self.sensors), noise, len(wanted))
        readings, valid = self.imperfection.apply(true, constants, noise)
        parameters = movie.parameters | {"clipped": self.imperfection.clipped(true, constants).float()}
        positions = torch.from_numpy(self.sensors.positions).float()
        touches = Touches(readings, valid, positions, movie.labels, float(self.rate))
        about = self.task, self.size, self.sensors.footprint
        return Recording(touches, *about, movie.force, displacement, parameters)

    def _metadata(self, recording: Recording, split: Split | None, epoch: int) -> dict[str, Any]:
        return {
            "source": "simulated",
            "simulator": type(self.model).__name__,
            "split": split or "budget",
            "epoch": epoch,
            "device_seed": self.seed,
            "data_seed": self.data_seed,
            "shapes": list(self.sampler.shapes.names),
            "summary": summarise(recording, self.body),
            "versions": {"skin": __version__, "torch": torch.__version__, "numpy": np.__version__},
        }


def _in_threads(work: Callable[[int], Any], count: int) -> list[Any]:
    """Return what ``work`` makes of 0, 1, ... count - 1, on as many threads as torch has.

    Each works alone: batches share nothing, and their many small products lose more by waiting for each
    other than they gain by being split. So the result is the same to the last bit on any number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(work, range(count)))
    finally:
        torch.set_num_threads(threads)
