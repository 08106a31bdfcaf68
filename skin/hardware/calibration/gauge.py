"""Force-gauge data: time, position, indenter and force of presses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.hardware.calibration._columns import load_table, numbers
from skin.simulator.base import AbstractSimulator
from skin.touch.shapes import Shapes

GAUGE = ("force", "x_m", "y_m", "indenter", "radius_m", "angle", "press")
"""Columns besides ``time``; the first three are required."""
_PAUSE = 1.0  # s without a row end a press


@dataclass(frozen=True)
class Gauge:
    """Rows of a force gauge, in order of time; one press after the other.

    Attributes:
        time: (N,), s, by the clock of the session.
        force: (N,), N.
        place: (N, 2), m: centre of the indenter, x right and y down from the upper left corner.
        radius: (N,), m: half the larger extent of the indenter.
        angle: (N,), rad: rotation from x towards y.
        indenter: (N,), names as in ``touch.shapes``.
        press: (N,): number of the press.
    """

    time: np.ndarray
    force: np.ndarray
    place: np.ndarray
    radius: np.ndarray
    angle: np.ndarray
    indenter: np.ndarray
    press: np.ndarray

    def __len__(self) -> int:
        return int(self.press.max()) + 1

    @cached_property
    def first(self) -> np.ndarray:
        """The first row of every press, (P,)."""
        return np.searchsorted(self.press, np.arange(len(self)))

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return force, (T,), N, and number of the press, (T,), -1 outside of presses, at times (T,), s."""
        row = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1)
        after = np.minimum(row + 1, len(self.time) - 1)
        press = np.where(self.press[row] == self.press[after], self.press[row], -1)
        press = np.where(time == self.time[row], self.press[row], press)
        press[(time < self.time[0]) | (time > self.time[-1])] = -1
        return np.where(press >= 0, np.interp(time, self.time, self.force), 0.0), press


def read_gauge(path: str | Path, indenter: str, radius: float, delay: float = 0.0) -> Gauge:
    """Read a gauge file with the columns ``time``, ``force``, ``x_m``, ``y_m`` and others of ``GAUGE``.

    Args:
        path: .csv or .parquet.
        indenter: of a file without this column.
        radius: m, of a file without this column.
        delay: s, added to the times of the file to match the session's.

    Raises:
        InputError: the file is invalid.
    """
    table, _ = load_table(path, "gauge file")
    return gauge_from_table(table, str(path), indenter, radius, delay)


def gauge_from_table(table: pa.Table, where: str, indenter: str, radius: float, delay: float = 0.0) -> Gauge:
    """Return a gauge from the complete rows of a table; see :func:`read_gauge`."""
    columns = {name: numbers(table, name, where) for name in ("time", "force", "x_m", "y_m")}
    for name, spare in (("radius_m", radius), ("angle", 0.0), ("press", 0.0)):
        known = name in table.column_names
        columns[name] = numbers(table, name, where) if known else np.full(len(table), spare)
    names = (
        table["indenter"].fill_null("").to_numpy(zero_copy_only=False)
        if "indenter" in table.column_names
        else np.full(len(table), indenter, dtype=object)
    )
    rows = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    if not rows.any():
        raise InputError(f"{where}: no row has a time, a force and a place")
    kept = {name: values[rows] for name, values in columns.items()}
    time, force = kept["time"] + delay, kept["force"]
    if (np.diff(time) <= 0).any():
        raise InputError(f"{where}: time must grow from row to row, in s")
    if force.min() < -0.05 * force.max():
        raise InputError(f"{where}: force must be at least 0 N, got {force.min():g}: zero the gauge")
    place = np.stack([kept["x_m"], kept["y_m"]], axis=1)
    same = np.column_stack([place, kept["radius_m"], kept["angle"], kept["press"]])
    new = (np.diff(same, axis=0) != 0).any(axis=1) | (names[rows][1:] != names[rows][:-1])
    press = np.concatenate([[0], np.cumsum(new | (np.diff(time) > _PAUSE))])
    return Gauge(
        time, np.maximum(force, 0), place, kept["radius_m"], kept["angle"], names[rows].astype(str), press
    )


def per_newton(simulator: AbstractSimulator, body: AbstractBody, gauge: Gauge) -> np.ndarray:
    """Return the true readings of every sensor per N of each press, (P, S).

    Simulators are positively homogeneous, so one frame of 1 N determines a press of any force.

    Raises:
        InputError: a place outside the sheet, a radius that is not above 0, or an unknown indenter.
    """
    rows = gauge.first
    place, radius, angle = gauge.place[rows], gauge.radius[rows], gauge.angle[rows]
    if (place < 0).any() or (place > body.size).any():
        wrong = place[((place < 0) | (place > body.size)).any(axis=1)][0]
        raise InputError(
            f"a press at {wrong.tolist()} m is outside the sheet of {list(body.size)} m: x_m and y_m are "
            "metres from its upper left corner"
        )
    if not (radius > 0).all():
        raise InputError(f"radius_m must be above 0 m, got {radius.min():g}")
    return torch.cat(_answers(simulator, body, gauge.indenter[rows], place, radius, angle)).double().numpy()


@torch.no_grad()
def _answers(
    simulator: AbstractSimulator,
    body: AbstractBody,
    indenter: Sequence[str] | np.ndarray,
    place: np.ndarray,
    radius: np.ndarray,
    angle: np.ndarray,
) -> list[torch.Tensor]:
    names = sorted(set(indenter))
    shapes = Shapes(names, body)
    kind = np.array([names.index(name) for name in indenter])
    # The image has a black border, so its outline is smaller than its texture.
    reach = np.array([np.ptp(hull, axis=0).max() / 2 for hull in shapes.hulls])
    scale = radius / reach[kind]
    area = float(np.prod(body.cell))
    one = (slice(n, n + 1) for n in range(len(kind)))
    return [simulator(shapes.render(kind[n], angle[n], scale[n], place[n]) / area).readings for n in one]
