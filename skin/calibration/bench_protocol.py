"""A simulated bench: the protocol of its presses, and the session of a device under them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from pydantic import PositiveFloat

from skin.calibration.bench import BenchSession, Gauge, per_newton, true_readings, write_bench_session
from skin.core.settings import configured
from skin.device.simulated import Simulated
from skin.wire.emulator import Converter


@dataclass(frozen=True)
class Protocol:
    """Idle time, then a staircase at each position: up, down, up to the peak, and a sudden release.

    The upward steps determine gains, the downward steps hysteresis, the release the lag, and idle time
    offset, noise and drift.

    Attributes:
        peak: largest force of every press, N.
        steps: fractions of the peak on the way up, and reversed on the way down.
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

    def gauge(self, positions: np.ndarray) -> Gauge:
        """Return a gauge's rows for presses at positions (P, 2), m."""
        levels = [0.0, *self.steps, *list(self.steps)[-2::-1], self.steps[-1]]
        corners = np.cumsum([0.0, *[self.ramp, self.hold] * (len(levels) - 1)])
        heights = self.peak * np.repeat(levels, 2)[1:]
        inside = np.arange(0, corners[-1], 1 / self.rate)
        press = np.concatenate(
            [np.interp(inside, corners, heights), np.zeros(max(2, round(0.2 * self.rate)))]
        )
        pause, start = round(self.rest * self.rate), round(self.idle * self.rate)
        starts = start + np.arange(len(positions)) * (len(press) + pause)
        frame = (starts[:, None] + np.arange(len(press))).ravel()
        rows = len(frame)
        return Gauge(
            frame / self.rate,
            np.tile(press, len(positions)),
            np.repeat(positions, len(press), axis=0),
            np.full(rows, self.radius),
            np.zeros(rows),
            np.full(rows, self.indenter),
            np.repeat(np.arange(len(positions)), len(press)),
        )

    def positions(self, device: Simulated, generator: np.random.Generator) -> np.ndarray:
        """Return two positions per sensor, on it and up to 3 mm beside it, (2 S, 2), m, inside the sheet."""
        centre = device.sensors.positions[:, :2]
        beside = centre + generator.uniform(-0.003, 0.003, centre.shape)
        return np.clip(np.concatenate([centre, beside]), 0, device.size)


def emulate_session(
    device: Simulated,
    gauge: Gauge,
    protocol: Protocol,
    generator: np.random.Generator,
    bits: int | None = None,
) -> BenchSession:
    """Simulate a session of a device under the presses of a gauge, in N, or in counts of ``bits``."""
    frames = round((gauge.time[-1] + protocol.rest) * protocol.rate)
    time = np.arange(frames) / protocol.rate
    true = true_readings(gauge, per_newton(device.model, device.body, gauge), time)
    return sent_session(device, true, time, generator, bits, gauge)


def sent_session(
    device: Simulated,
    true: np.ndarray,
    time: np.ndarray,
    generator: np.random.Generator,
    bits: int | None,
    gauge: Gauge | None = None,
) -> BenchSession:
    """Return what a device sends of true readings (T, S), N, at times (T,), s: N, or counts of ``bits``."""
    measured = device.imperfection.raw(
        torch.from_numpy(true)[None].float(), device.constants, generator, torch.from_numpy(time).float()
    )[0].numpy() * device.imperfection.signs(true.shape[1])
    sent = Converter(bits, device.imperfection.clip)(measured)
    return BenchSession(time, sent, "N" if bits is None else "adc", gauge, bits)


def write_demo_session(device: Simulated, settings: Mapping[str, Any], path: str) -> str:
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
    rows = protocol.gauge(protocol.positions(device, randomness))
    session = emulate_session(device, rows, protocol, randomness, settings["bits"])
    return f"{write_bench_session(session, path)}: {len(rows)} presses in {session.time[-1]:.0f} s"
