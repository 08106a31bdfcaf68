"""Response curves: the value that a sensor shows under a force, and back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skin.errors import InputError

_LEAST = 1e-9  # of the reference: below, a power law is a line, whose slope is finite

Table = Sequence[Sequence[float]]
"""Linear readings and values of a curve, each rising from 0, N."""


@dataclass(frozen=True)
class Curves:
    """The curves of S sensors: power laws, or tables.

    A linear reading x, the gain times the force, becomes ``at`` (x / ``at``) ^ ``exponent``, or the value of
    a table, interpolated linearly and continued with its last slope. Below 0, curves are those above it with
    both signs changed. The exponent of force-sensitive resistors is about 0.5, where the value is the
    resistance's inverse.

    Attributes:
        exponent: (S,), or (B, 1, S); 1: linear.
        at: reading at which linear reading and value are equal, (S,) or a number, N.
        tables: of sensors, from 0, that follow no power law.
    """

    exponent: Any
    at: Any
    tables: Mapping[int, Table] = field(default_factory=dict)

    def bend(self, linear: Any) -> Any:
        """Return the values of linear readings (..., S), array or tensor, N."""
        values = linear * (abs(linear) / self.at).clip(_LEAST) ** (self.exponent - 1)
        for sensor, (readings, shown) in self.tables.items():
            values[..., sensor] = _interpolate(linear[..., sensor], readings, shown)
        return values

    def straighten(self, values: Any) -> Any:
        """Return the linear readings of values (..., S), array or tensor, N."""
        linear = values * (abs(values) / self.at).clip(_LEAST) ** (1 / self.exponent - 1)
        for sensor, (readings, shown) in self.tables.items():
            linear[..., sensor] = _interpolate(values[..., sensor], shown, readings)
        return linear

    @property
    def slopes(self) -> np.ndarray:
        """Change of the value per change of the linear reading at :attr:`at` within 1 %, (S,); 1: a line."""
        at = np.broadcast_to(self.at, np.shape(self.exponent)).astype(float)
        return np.asarray((self.bend((1 + 0.01) * at) - self.bend((1 - 0.01) * at)) / (2 * 0.01 * at))

    def scaled(self, factor: np.ndarray) -> "Curves":
        """Return these curves for readings and values in another unit; ``factor`` (S,) of that per N."""
        tables = {n: (np.array(table) * factor[n]).tolist() for n, table in self.tables.items()}
        return Curves(self.exponent, self.at * factor, tables)

    def to_json(self) -> dict[str, Any]:
        """Return JSON data from which :meth:`of_json` makes these curves."""
        tables = {str(n): [list(row) for row in table] for n, table in self.tables.items()}
        return {"exponent": self.exponent.tolist(), "at": self.at.tolist(), "tables": tables}

    @classmethod
    def of_json(cls, stored: Mapping[str, Any], sensors: int) -> "Curves":
        """Return the curves of so many sensors.

        Raises:
            ValueError: no curves, or those of another number of sensors.
        """
        exponent, at = (np.array(stored[name], dtype=float) for name in ("exponent", "at"))
        if exponent.shape != (sensors,) or at.shape != (sensors,) or not (exponent > 0).all():
            raise ValueError("curves of other sensors")
        if not (np.isfinite([exponent, at]).all() and (at > 0).all()):
            raise ValueError("curves need finite numbers")
        return cls(exponent, at, read_tables(stored["tables"], sensors))


def read_tables(stored: Mapping[Any, Any], sensors: int) -> dict[int, Table]:
    """Return checked tables by sensor, from 0.

    Raises:
        InputError: no such sensor, or rows that do not rise from 0.
    """
    if not isinstance(stored, Mapping):
        raise InputError(f"tables must hold a table by number of the sensor, got {str(stored)[:80]}")
    tables = {int(number): table for number, table in stored.items()}
    if wrong := [number for number in tables if not 0 <= number < sensors]:
        raise InputError(f"tables takes sensors from 0 to {sensors - 1}, got {wrong[0]}")
    return {number: check_table(table) for number, table in tables.items()}


def check_table(table: Any, maximum: int = 1000) -> Table:
    """Return a table whose rows, linear readings and values, rise from 0.

    Raises:
        InputError: they do not.
    """
    try:
        rows = np.array(table, dtype=float)
    except (TypeError, ValueError):
        rows = np.empty(0)
    fits = rows.ndim == 2 and rows.shape[0] == 2 and 2 <= rows.shape[1] <= maximum
    if not fits or not np.isfinite(rows).all() or (rows[:, 0] != 0).any() or (np.diff(rows) <= 0).any():
        raise InputError(
            "a table of a curve has two rows of numbers, readings and values in N, each rising from 0, as in "
            f"[[0,1,2],[0,1.5,2]], got {str(table)[:80]}"
        )
    return rows.tolist()


def _interpolate(values: Any, given: Sequence[float], result: Sequence[float]) -> Any:
    """Return values of a table, odd, and continued with the last slope."""
    if not isinstance(values, np.ndarray):
        import torch  # only here: settings are checked without it

        return torch.from_numpy(_interpolate(values.cpu().numpy(), given, result)).to(values)
    size = np.abs(values)
    slope = (result[-1] - result[-2]) / (given[-1] - given[-2])
    beyond = np.maximum(size - given[-1], 0.0) * slope
    return np.sign(values) * (np.interp(size, given, result) + beyond)
