"""A bench session: raw readings at the device's own rate, and the force gauge's rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from skin.errors import InputError
from skin.hardware.calibration import gauge as gauges
from skin.hardware.calibration._columns import load_table, numbers, save_table
from skin.hardware.calibration.gauge import GAUGE, Gauge
from skin.settings import checked

_OTHER = ("time", "t_us", "seq", *GAUGE)


@checked("session")
@dataclass(frozen=True)
class BenchSession:
    """Raw readings of a skin, and the force gauge during the same time.

    Attributes:
        time: (T,), s.
        raw: (T, S), in ``unit``; NaN where a frame was lost.
        unit: ``N``, or ``adc`` for counts of a converter.
        gauge: rows of the force gauge in the same file; None if they are in another file.
        bits: of the converter; None if unknown.
        channels: the device's channel of every column, where skin record has put them into the order of the
            layout; None: columns are in the device's order.

    Raises:
        InputError: another unit, or times that do not increase.
    """

    time: np.ndarray
    raw: np.ndarray
    unit: Literal["N", "adc"]
    gauge: Gauge | None = None
    bits: Annotated[int, Ge(1), Le(64)] | None = None
    channels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if len(self.time) < 2:
            raise InputError(f"a session needs at least two frames, this one has {len(self.time)}")
        if (self.time == self.time[0]).all():
            raise InputError(
                f"the device's clock stood still: all {len(self.time)} frames of the session have the time "
                f"{self.time[0]:g} s; let it send micros() and record again"
            )
        if (back := np.flatnonzero(~(np.diff(self.time) > 0))).size:
            before, after = self.time[back[0] : back[0] + 2]
            raise InputError(
                f"the session's time must grow from frame to frame: after frame {back[0]} it goes from "
                f"{before:.9g} to {after:.9g} s"
            )


def read_bench_session(
    path: str | Path, indenter: str, radius: float, unit: str | None = None
) -> BenchSession:
    """Read a session.

    The file has a column ``time`` (s) or ``t_us`` (microseconds) and one per sensor in the layout's order, of
    any name; ``seq`` is ignored. Columns of a gauge may stand beside them, empty outside the presses. Unit
    and bits may stand in the Parquet schema or in ``x.csv.json``: ``{"unit": "adc", "bits": 10}``.

    Args:
        path: .csv or .parquet.
        indenter: of gauge rows without one.
        radius: m, of gauge rows without one.
        unit: ``N`` or ``adc``; None: the unit in the file, else N.

    Raises:
        InputError: the file is invalid.
    """
    table, about = load_table(path, "session")
    names = [name for name in table.column_names if name not in _OTHER]
    if not names:
        raise InputError(f"{path}: no column of a sensor beside {', '.join(table.column_names)}")
    in_microseconds = "time" not in table.column_names and "t_us" in table.column_names
    time = numbers(table, "t_us" if in_microseconds else "time", str(path))
    time = 1e-6 * time if in_microseconds else time
    raw = np.stack([numbers(table, name, str(path)) for name in names], axis=1)
    inside = "force" in table.column_names
    if inside and in_microseconds:
        table = table.append_column("time", [time])
    rows = gauges.gauge_from_table(table, str(path), indenter, radius) if inside else None
    try:
        known: Any = unit or about.get("unit", "N")
        return BenchSession(time, raw, known, rows, about.get("bits"), about.get("channels"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_bench_session(session: BenchSession, path: str | Path) -> Path:
    """Write a session with its gauge atomically; readings have single precision.

    Raises:
        InputError: another ending than .csv or .parquet, or the file cannot be written.
    """
    digits = max(2, len(str(session.raw.shape[1] - 1)))
    columns = {"time": session.time}
    counts = session.unit == "adc" and np.isfinite(session.raw).all()
    for number, values in enumerate(session.raw.T):
        columns[f"raw_{number:0{digits}d}"] = values.astype(np.int32 if counts else np.float32)
    about = {"unit": session.unit, "bits": session.bits}
    return save_table(columns | _gauge_columns(session), about, path)


def _gauge_columns(session: BenchSession) -> dict[str, np.ndarray]:
    """Return the gauge's columns at the session's times, masked outside of presses."""
    if session.gauge is None:
        return {}
    gauge = session.gauge
    force, press = gauge.at(session.time)
    row = gauge.first[np.maximum(press, 0)]
    columns = {
        "force": force,
        "x_m": gauge.place[row, 0],
        "y_m": gauge.place[row, 1],
        "indenter": gauge.indenter[row],
        "radius_m": gauge.radius[row],
        "angle": gauge.angle[row],
        "press": press,
    }
    return {name: np.ma.masked_array(values, press < 0) for name, values in columns.items()}
