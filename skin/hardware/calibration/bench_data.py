"""A bench session with the simulated true readings of its presses."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.hardware.calibration.bench_session import BenchSession
from skin.hardware.calibration.gauge import Gauge, per_newton
from skin.hardware.calibration.protocol import true_readings

_BEFORE, _AFTER = 0.2, 1.0  # s around a press that are not idle
_FEWEST = 50  # idle frames
_SUDDEN = 2  # frames that a release may take


@dataclass(frozen=True)
class BenchData:
    """Measured readings and simulated true readings of a bench session, frame by frame.

    Attributes:
        session: the raw readings.
        gauge: force and position of the presses.
        each: true readings per N of every press, (P, S).
    """

    session: BenchSession
    gauge: Gauge
    each: np.ndarray

    @cached_property
    def true(self) -> np.ndarray:
        """Simulated true readings, (T, S), N."""
        return true_readings(self.gauge, self.each, self.session.time)

    @cached_property
    def applied(self) -> tuple[np.ndarray, np.ndarray]:
        """The gauge's force, (T,), N, and the number of the press, (T,), -1 outside."""
        return self.gauge.at(self.session.time)

    @cached_property
    def idle(self) -> np.ndarray:
        """Frames without a press, (T,), bool."""
        time, busy = self.session.time, np.zeros(len(self.session.time), dtype=bool)
        ends = np.append(self.gauge.first[1:], len(self.gauge.time)) - 1
        for start, end in zip(self.gauge.time[self.gauge.first], self.gauge.time[ends], strict=True):
            busy |= (time >= start - _BEFORE) & (time <= end + _AFTER)
        return ~busy

    def of(self, presses: Collection[int]) -> np.ndarray:
        """Frames of some presses, (T,), bool."""
        return np.isin(self.applied[1], list(presses))

    @cached_property
    def _peaks(self) -> np.ndarray:
        """The largest force of the press so far, (T,), N."""
        force, press = self.applied
        highest = np.zeros(len(force))
        for number in range(len(self.gauge)):
            mine = press == number
            highest[mine] = np.maximum.accumulate(force[mine])
        return highest

    @property
    def loading(self) -> np.ndarray:
        """Frames at the largest force of their press so far, (T,), bool."""
        return (self.applied[0] > 0) & (self.applied[0] >= 0.995 * self._peaks)

    @property
    def unloading(self) -> np.ndarray:
        """Frames below the largest force of their press so far, (T,), bool."""
        return (self.applied[0] > 0) & (self.applied[0] < 0.98 * self._peaks)

    @cached_property
    def releases(self) -> list[slice]:
        """Frames from each sudden release to the next press, one slice per such release."""
        force, press = self.applied
        found = []
        for number in range(len(self.gauge)):
            mine = np.flatnonzero(press == number)
            loaded = mine[force[mine] > 0.02 * force[mine].max(initial=0)]
            if not len(loaded) or force[max(loaded[-1] - _SUDDEN, 0)] < 0.2 * force[mine].max():
                continue
            later = np.flatnonzero((press > number) & (force > 0))
            found.append(slice(loaded[-1] + _SUDDEN, later[0] if len(later) else len(force)))
        return found


def build_bench_data(device: AbstractSimulated, session: BenchSession, gauge: Gauge | None) -> BenchData:
    """Simulate the presses of a session on the skin as designed.

    Raises:
        InputError: no gauge, another number of sensors, or times of gauge and session that do not overlap.
    """
    rows = gauge or session.gauge
    if rows is None:
        raise InputError("no force in the session: add presses=gauge.csv with time, force, x_m and y_m")
    channels, sensors = session.raw.shape[1], len(device.sensors)
    if channels != sensors:
        raise InputError(
            f"the session has {channels} channels, the layout {sensors} sensors: give the layout it was "
            "recorded with, as in layout=file layout.path=FILE.csv"
        )
    model = device.simulator(device.body, device.sensors)
    found = BenchData(session, rows, per_newton(model, device.body, rows))
    if not found.loading.any():
        raise InputError("no frame of the session falls into a press: check the clocks, see calibrate.delay")
    if found.idle.sum() < _FEWEST:
        raise InputError(
            f"{found.idle.sum()} idle frames, needed are {_FEWEST}: do not touch the skin for some seconds"
        )
    return found
