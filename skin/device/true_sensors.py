"""The true sensors of a simulated device and its model of them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from skin.body.base import AbstractBody, Sensors
from skin.core.rng import Stream, generator
from skin.errors import InputError
from skin.mechanics.relaxation import Relaxing, relaxes
from skin.mechanics.simulator.base import AbstractSimulator

_ROUNDING = 1e-9  # m


def misplace(sensors: Sensors, size: tuple[float, float], error: float, seed: int) -> Sensors:
    """Return sensors beside their places.

    Args:
        sensors: as touches report them.
        size: extent (x, y) of the sheet, m, on which they stay.
        error: standard deviation along x and along y, m.
        seed: of the device.
    """
    moves = generator(Stream.POSITION, seed).standard_normal((len(sensors), 2))
    positions = sensors.positions.copy()
    positions[:, :2] = np.clip(positions[:, :2] + error * moves, 0, size)
    return replace(sensors, positions=positions)


def cover_surface(body: AbstractBody, footprint: tuple[float, float]) -> Sensors:
    """Return a sensor at each cell of a body whose footprint lies wholly on it.

    Their footprints are the areas over which a pressure can be dangerous anywhere.
    """
    margins = [max(extent, cell) / 2 for extent, cell in zip(footprint, body.cell, strict=True)]
    x, y = (
        centres[(centres >= margin - _ROUNDING) & (centres <= size - margin + _ROUNDING)]
        for centres, size, margin in zip(_centres(body), body.size, margins, strict=True)
    )
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return Sensors(np.column_stack([places, np.zeros(len(places))]), footprint)


def _centres(body: AbstractBody) -> list[np.ndarray]:
    return [(np.arange(count) + 0.5) * cell for count, cell in zip(body.cells, body.cell, strict=True)]


def build_model(
    simulator: Callable[[AbstractBody, Sensors], AbstractSimulator],
    body: AbstractBody,
    sensors: Sensors,
    rate: float,
) -> AbstractSimulator:
    """Return the simulator of a body with sensors; in time, at ``rate`` in Hz, where a material relaxes."""
    return Relaxing(simulator, body, sensors, rate) if relaxes(body) else simulator(body, sensors)


def refuse_relaxation(body: AbstractBody, setting: str) -> None:
    """Raise an InputError that names a setting with which no material of a body may relax."""
    if relaxes(body):
        raise InputError(
            f"a skin that relaxes is simulated touch by touch from rest, where it stays, got {setting}: "
            "leave that out, or the materials' relaxation"
        )
