"""Presses of a bench: their protocol, their simulated true readings, and a simulated session."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from pydantic import PositiveFloat

from skin.core.settings import configured
from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.hardware.calibration.bench import BenchSession, Gauge, per_newton, write_bench_session

_BEFORE, _AFTER = 0.2, 1.0  # s around a press that are not idle
_FEWEST = 50  # idle frames
_SUDDEN = 2  # frames that a release may take


@dataclass(frozen=True)
class Protocol:
    """Idle time, then a staircase at each place: up, down, up to the peak, and a sudden release.

    The upward steps determine gains, the downward steps hysteresis, the release the lag, and idle time
    offset, noise and drift.

    Attributes:
        peak: largest force of every press, N.
        steps: shares of the peak on the way up, and reversed on the way down.
        hold: at every step, s.
        ramp: from one step to the next, s; the release takes none.
        idle: before the first press, s.
        rest: after every press, s.
        indenter: name as in ``touch.shapes``.
        radius: half its larger extent, m.
        rate: of gauge and session, Hz.
    """

    peak: PositiveFloat = 120.0
    steps: Sequence[float] = (0.1, 0.2, 0.4, 0.7, 1.0)
    hold: PositiveFloat = 0.3
    ramp: PositiveFloat = 0.05
    idle: PositiveFloat = 3.0
    rest: PositiveFloat = 2.0
    indenter: str = "blurred_disc"
    radius: PositiveFloat = 0.01
    rate: PositiveFloat = 100.0

    def gauge(self, places: np.ndarray) -> Gauge:
        """Return a gauge's rows for presses at places (P, 2), m."""
        levels = [0.0, *self.steps, *list(self.steps)[-2::-1], self.steps[-1]]
        corners = np.cumsum([0.0, *[self.ramp, self.hold] * (len(levels) - 1)])
        heights = self.peak * np.repeat(levels, 2)[1:]
        inside = np.arange(0, corners[-1], 1 / self.rate)
        press = np.concatenate(
            [np.interp(inside, corners, heights), np.zeros(max(2, round(0.2 * self.rate)))]
        )
        pause, start = round(self.rest * self.rate), round(self.idle * self.rate)
        starts = start + np.arange(len(places)) * (len(press) + pause)
        frame = (starts[:, None] + np.arange(len(press))).ravel()
        rows = len(frame)
        return Gauge(
            frame / self.rate,
            np.tile(press, len(places)),
            np.repeat(places, len(press), axis=0),
            np.full(rows, self.radius),
            np.zeros(rows),
            np.full(rows, self.indenter),
            np.repeat(np.arange(len(places)), len(press)),
        )

    def places(self, device: AbstractSimulated, generator: np.random.Generator) -> np.ndarray:
        """Return two places per sensor, on it and up to 3 mm beside it, (2 S, 2), m, inside the sheet."""
        centre = device.sensors.positions[:, :2]
        beside = centre + generator.uniform(-0.003, 0.003, centre.shape)
        return np.clip(np.concatenate([centre, beside]), 0, device.size)


def emulate_session(
    device: AbstractSimulated,
    gauge: Gauge,
    protocol: Protocol,
    generator: np.random.Generator,
    bits: int | None = None,
) -> BenchSession:
    """Simulate a session of a device under the presses of a gauge, in N, or in counts if ``bits`` is given.

    The middle of the converter is at 0 N and its ends are at twice the device's clip.
    """
    frames = round((gauge.time[-1] + protocol.rest) * protocol.rate)
    time = np.arange(frames) / protocol.rate
    true = true_readings(gauge, per_newton(device.model, device.body, gauge), time)
    measured = device.imperfection.raw(
        torch.from_numpy(true)[None].float(), device.constants, generator, torch.from_numpy(time).float()
    )[0].numpy()
    if bits is None:
        return BenchSession(time, measured.astype(float), "N", gauge)
    middle = 2 ** (bits - 1)
    counts = np.clip(np.round(middle + measured * middle / (2 * device.imperfection.clip)), 0, 2**bits - 1)
    return BenchSession(time, counts, "adc", gauge, bits)


def true_readings(gauge: Gauge, each: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return true readings (T, S), N, of presses that give ``each`` (P, S) per N; 0 outside of them."""
    force, press = gauge.at(time)
    return np.where(press[:, None] >= 0, force[:, None] * each[press], 0.0)


def write_demo_session(device: AbstractSimulated, settings: Mapping[str, Any], path: str) -> str:
    """Write the simulated session of a device under the protocol; return a summary.

    Args:
        device: the simulated device.
        settings: ``conf/calibrate.yaml`` under ``calibrate``.
        path: .csv or .parquet.

    Raises:
        InputError: the protocol is invalid.
    """
    protocol = configured(Protocol, settings["protocol"], "calibrate.protocol")
    randomness = np.random.default_rng(device.seed)
    rows = protocol.gauge(protocol.places(device, randomness))
    session = emulate_session(device, rows, protocol, randomness, settings["bits"])
    return f"{write_bench_session(session, path)}: {len(rows)} presses in {session.time[-1]:.0f} s"


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

    def frames_of(self, presses: Collection[int]) -> np.ndarray:
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
        releases = []
        for number in range(len(self.gauge)):
            mine = np.flatnonzero(press == number)
            loaded = mine[force[mine] > 0.02 * force[mine].max(initial=0)]
            if not len(loaded) or force[max(loaded[-1] - _SUDDEN, 0)] < 0.2 * force[mine].max():
                continue
            later = np.flatnonzero((press > number) & (force > 0))
            releases.append(slice(loaded[-1] + _SUDDEN, later[0] if len(later) else len(force)))
        return releases


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
    bench = BenchData(session, rows, per_newton(model, device.body, rows))
    if not bench.loading.any():
        raise InputError("no frame of the session falls into a press: check the clocks, see calibrate.delay")
    if bench.idle.sum() < _FEWEST:
        raise InputError(
            f"{bench.idle.sum()} idle frames, needed are {_FEWEST}: do not touch the skin for some seconds"
        )
    return bench
