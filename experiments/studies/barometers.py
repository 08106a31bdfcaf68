"""Four barometers under a strip of rubber: the simulation against the real skin."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import pandas as pd
from annotated_types import MinLen

from skin.body.base import AbstractBody, Layer
from skin.body.layout import Listed
from skin.body.material import Material
from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.inference.candidates import FingertipPrior, disc_readings
from skin.inference.noise import Noise
from skin.inference.posterior import Posterior
from skin.mechanics.simulator.base import AbstractSimulator
from skin.mechanics.simulator.solid import Solid

if TYPE_CHECKING:
    from experiments.studies.trials import Subject

STEPS = 480.0  # of the robot, per mm of depth
UNIT = 1e-4  # of the readings, Pa: nominal
CALIBRATION = 20  # presses for gains
RIM = 5e-4  # m, of the tip
PITCH, LAST = 0.006, 0.027  # m, between the sensors, and the last of them in the strip
SPREAD = 0.3  # of the logarithm of the force, in the prior
RESAMPLES = 1000
# What nobody states is chosen on the calibration presses among these: thickness of the strip, radius of the
# tip, and the least and largest x of the strip at x = 0 of the robot, m.
THICKNESS = (0.003, 0.004, 0.005, 0.006)
RADIUS = (0.0015, 0.002, 0.0025, 0.003, 0.0035, 0.0045)
OFFSET = (0.006, 0.012)


@dataclass(frozen=True)
class PressFrames:
    """Frames recorded while a robot presses a strip at one position after another.

    Attributes:
        readings: (N, 4), above those before the press, 10 kPa.
        x: position of the robot, mm, (N,).
        depth: of the robot, mm, (N,).
        press: number of the press, (N,).
    """

    readings: np.ndarray
    x: np.ndarray
    depth: np.ndarray
    press: np.ndarray

    def plateaus(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (P,), mm, and the mean readings (P, 4) of each press at its full depth."""
        frames = pd.DataFrame(self.readings).assign(x=self.x)
        deepest = pd.Series(self.depth).groupby(self.press).transform("max")
        deep = frames[self.depth >= 0.98 * deepest].groupby(self.press[self.depth >= 0.98 * deepest])
        return deep.x.first().to_numpy(), deep[[0, 1, 2, 3]].mean().to_numpy()


def read_frames(folder: Path, name: str) -> PressFrames:
    """Return the frames of a file that are in a press; the readings before each press are its baseline.

    Args:
        folder: of the recordings.
        name: beginning of the name of the file.

    Raises:
        InputError: no such file, or none of its form.
    """
    try:
        (path,) = folder.glob(f"{name}*.csv")
        table = pd.read_csv(path)
        readings = table[[f"Sensor_{number}" for number in range(4)]].to_numpy(float) * UNIT
        x, depth = table["x"].to_numpy(float) / 1e3, table["z"].to_numpy(float) / STEPS
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"cannot read {folder}/{name}*.csv as a recording of four barometers: {error}"
        ) from error
    pressed = depth > 0
    press = np.cumsum(np.diff(pressed.astype(int), prepend=0) > 0)
    baseline = np.zeros_like(readings)
    for number in range(1, int(press.max()) + 1):
        inside = np.flatnonzero((press == number) & pressed)
        before = readings[max(0, inside[0] - 5) : inside[0]]
        baseline[inside] = before.mean(axis=0) if len(before) else readings[inside[0]]
    return PressFrames((readings - baseline)[pressed], x[pressed], depth[pressed], press[pressed])


@dataclass(frozen=True)
class Strip:
    """The simulated strip.

    Attributes:
        body, simulator: of the strip.
        radius: of the tip, m.
        offset: x of the strip at x = 0 of the robot, m.
        gains: (4,), reading per simulated reading of the tip with 1 N.
        error: (4,), rms of what the calibration leaves, in units of the simulated reading.
    """

    body: AbstractBody
    simulator: AbstractSimulator
    radius: float
    offset: float
    gains: np.ndarray
    error: np.ndarray

    def readings(self, x: np.ndarray, radius: float | np.ndarray | None = None) -> np.ndarray:
        """Return simulated readings (N, 4) of the tip with 1 N at positions (N,) of the robot, mm."""
        size = self.radius if radius is None else radius
        return strip_readings(self.body, self.simulator, x / 1e3 + self.offset, size)

    def moved(self, x: np.ndarray, measured: np.ndarray) -> "Strip":
        """Return the strip at the position below the robot with which measured readings (P, 4) agree best."""
        offsets = self.offset + np.arange(-PITCH, PITCH + 1e-6, 1e-4)
        end = self.body.size[0] - 0.001 - x.max() / 1e3
        strips = [replace(self, offset=float(each)) for each in offsets if 0.001 < each < end]
        return min(strips, key=lambda strip: np.square(strip.readings(x) * strip.gains - measured).sum())

    @property
    def words(self) -> str:
        """What the calibration chose."""
        depth = 1e3 * sum(layer.thickness for layer in self.body.layers)
        return f"solid, {depth:g} mm thick, tip of {1e3 * self.radius:g} mm"


def strip_readings(
    body: AbstractBody, simulator: AbstractSimulator, x: np.ndarray, radius: float | np.ndarray
) -> np.ndarray:
    """Return readings (N, 4) of discs with 1 N in the middle of the strip at x (N,), m."""
    discs = np.column_stack([x, np.full(len(x), body.size[1] / 2), np.broadcast_to(radius, len(x))])
    return disc_readings(simulator, body, discs, RIM)


def build_strip(thickness: float) -> tuple[Sheet, Solid]:
    """Return body and simulator of the strip, with the sensors at its surface.

    The pitch of the sensors is known from the board, the width from the moulds.
    """
    body = Sheet((0.048, 0.010), (96, 20), (Layer(Material.of("EcoFlex 00-30"), thickness),))
    positions = [(LAST - number * PITCH, 0.005, thickness) for number in (3, 2, 1, 0)]
    return body, Solid(body, Listed(positions, (0.001, 0.001)).sensors(body))


def calibrate_strip(x: np.ndarray, measured: np.ndarray) -> Strip:
    """Return the strip whose readings are nearest to measured ones (P, 4) at positions (P,), mm."""
    best: tuple[float, Strip] | None = None
    for thickness in THICKNESS:
        body, simulator = build_strip(thickness)
        grid = np.arange(0.001, body.size[0] - 0.001, 2e-4)
        for radius in RADIUS:
            table = strip_readings(body, simulator, grid, radius)
            for offset in np.arange(*OFFSET, 1e-4):
                simulated = np.stack(
                    [np.interp(x / 1e3 + offset, grid, column) for column in table.T], axis=1
                )
                gains = (simulated * measured).sum(axis=0) / np.square(simulated).sum(axis=0)
                error = np.sqrt(np.square(simulated - measured / gains).mean(axis=0))
                loss = float(np.square(simulated * gains - measured).mean())
                if best is None or loss < best[0]:
                    best = loss, Strip(body, simulator, radius, float(offset), gains, error)
    assert best is not None
    return best[1]


@dataclass(frozen=True)
class Barometers:
    """A simulated strip against measured presses: its readings, and positions by its posterior.

    The strip is calibrated on every third press of a recording. In another recording the robot begins
    elsewhere: every third press tells where. The others are the test.

    Args:
        data: folder of the recordings.
        recordings: beginnings of the names of files: the one for gains, and another one to test.
        seed: of the intervals, which resample presses.
    """

    data: str = "."
    recordings: Annotated[Sequence[str], MinLen(1)] = ("test_full_20230706_175400",)
    seed: int = 0

    def __call__(self, subject: "Subject") -> pd.DataFrame:
        strip: Strip | None = None
        for name in self.recordings:
            x, measured = read_frames(Path(self.data).expanduser(), name).plateaus()
            chosen = np.arange(len(x)) % 3 == 1
            known = x[chosen], measured[chosen]
            strip = calibrate_strip(*known) if strip is None else strip.moved(*known)
            x, measured = x[~chosen], measured[~chosen]
        assert strip is not None
        wrong = np.square(strip.readings(x) * strip.gains - measured).sum(axis=1)
        whole = np.square(measured).sum(axis=1)
        close = x / 1e3 + strip.offset < LAST + PITCH / 2
        squares = np.square(posterior_errors(strip, x[close], measured[close]))
        start = {"recording": subject.condition, "training": CALIBRATION, "strip": strip.words}
        rows = [
            {"metric": "relative rms of readings, %", **self._rms(1e4 * wrong, whole, 8)},
            {"metric": "rms of positions, mm", **self._rms(squares, np.ones_like(squares), 4)},
        ]
        return pd.DataFrame([start | row for row in rows]).round(3)

    def _rms(self, squares: np.ndarray, weights: np.ndarray, stream: int) -> dict[str, float]:
        """Return the root of the weighted mean, and its 95 % interval over presses."""
        size = (RESAMPLES, len(squares))
        draw = np.random.default_rng([self.seed, stream]).integers(len(squares), size=size)
        roots = np.sqrt(squares[draw].sum(axis=1) / weights[draw].sum(axis=1))
        low, high = np.quantile(roots, [0.025, 0.975])
        value = float(np.sqrt(squares.sum() / weights.sum()))
        return {"test": len(squares), "value": value, "low": float(low), "high": float(high)}


def posterior_errors(strip: Strip, x: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the errors of positions by the posterior of the simulated strip, mm."""
    radii = 0.8 * strip.radius, 1.25 * strip.radius
    prior = FingertipPrior(1.0, SPREAD, radii, RIM, numbers=(0, 1, 0, 0), large=0)
    noise = Noise(float(np.sqrt(np.square(strip.error).mean())))
    posterior = Posterior(strip.simulator, noise, strip.body, prior, contacts=1)
    estimates = posterior.estimate(measured / strip.gains)
    assert isinstance(estimates, list)
    positions = np.array([estimate.contacts[0].place[0] for estimate in estimates])
    return 1e3 * (positions - strip.offset) - x
