"""Four barometers under a strip of rubber: place from readings, and the simulation against the real skin."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from omegaconf import OmegaConf

from experiments.studies.real_presses import run_places, run_sessions
from experiments.studies.real_rows import (
    RESAMPLES,
    Presses,
    RealRow,
    RealSettings,
    choose,
    interval,
    predict,
    result_line,
    spread,
)
from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.inference.candidates import FingertipPrior, disc_readings
from skin.inference.noise import Noise
from skin.inference.posterior import Posterior
from skin.mechanics.simulator.base import AbstractSimulator

FOLDER = "MTL-BaroTactileSensor/Data_collection/tip1"
STEPS = 480.0  # of the robot, per mm of depth
UNIT = 1e-4  # of the readings, Pa: nominal
EACH = 15  # every so many frames of a press are used
DEEP = 0.9  # of the depth: frames beyond are used
REACH = 14.0  # mm, half a pitch beyond the last sensor in June, which is at 11 mm
_RUNS = ("05_zd5_t0", "05_zd6_t0", "05_zd7_t0", "1_zd6_t0", "1_zd6_t20", "1_zd6_t8")
SLOW = tuple(f"vac_zv{name}" for name in _RUNS)
SLOWER = ("vac_zv3_zd6_t8", "vac_zv3_zd7_t8")
BEFORE, AFTER = (*SLOW, *SLOWER, "testing_20230628_164338"), ("testing_20230629_152536",)
CALIBRATED, REPEATED = "test_full_20230706_175400", "test_20230706_170139"
CALIBRATION = 20  # presses for gains
RIM = 5e-4  # m, of the tip
PITCH, LAST = 0.006, 0.027  # m, between the sensors, and the last of them in the strip
SIMULATED = 1000  # presses to train on
SPREAD = 0.3  # of the logarithm of their force


@dataclass(frozen=True)
class PressFrames:
    """PressFrames of a robot that presses a strip, one place after the other.

    Attributes:
        readings: (N, 4), above those before the press, 10 kPa.
        x: place of the robot, mm, (N,).
        depth: of the robot, mm, (N,).
        press: number of the press, (N,).
    """

    readings: np.ndarray
    x: np.ndarray
    depth: np.ndarray
    press: np.ndarray

    def plateaus(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the place (P,), mm, and the mean readings (P, 4) of each press at its full depth."""
        numbers = np.unique(self.press)
        deep = [(self.press == n) & (self.depth >= 0.98 * self.depth[self.press == n].max()) for n in numbers]
        return np.array([self.x[rows][0] for rows in deep]), np.array(
            [self.readings[rows].mean(0) for rows in deep]
        )


def read_frames(path: Path) -> PressFrames:
    """Return the frames of a file that are in a press; the readings before each press are its baseline.

    Raises:
        InputError: no such file, or none of its form.
    """
    try:
        table = pd.read_csv(path)
        readings = table[[f"Sensor_{number}" for number in range(4)]].to_numpy(float) * UNIT
        x, depth = table["x"].to_numpy(float) / 1e3, table["z"].to_numpy(float) / STEPS
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"cannot read {path} as a recording of four barometers: {error}") from error
    pressed = depth > 0
    press = np.cumsum(np.diff(pressed.astype(int), prepend=0) > 0)
    baseline = np.zeros_like(readings)
    for number in range(1, int(press.max()) + 1):
        inside = np.flatnonzero((press == number) & pressed)
        before = readings[max(0, inside[0] - 5) : inside[0]]
        baseline[inside] = before.mean(axis=0) if len(before) else readings[inside[0]]
    return PressFrames((readings - baseline)[pressed], x[pressed], depth[pressed], press[pressed])


def read_places(
    row: RealRow,
    path: Path,
    settings: RealSettings,
    train: Sequence[str],
    test: Sequence[str],
    reach: float = np.inf,
    new: bool = False,
) -> Presses:
    """Return frames near the full depth; each file is a session, and the test files are the last together.

    Args:
        row, settings: not used.
        path: of the folder.
        train, test: beginnings of the names of files.
        reach: mm, largest place.
        new: places, not presses, are held out together.
    """
    parts = list[Presses]()
    names = [*train, *test]
    for number, name in enumerate(names):
        (file,) = path.glob(f"{name}*.csv")
        frames = read_frames(file)
        deep = (frames.depth > DEEP * frames.depth.max()) & (frames.x <= reach)
        deep = np.flatnonzero(deep)[::EACH]
        session = np.full(len(deep), min(number, len(train)))
        place = np.rint(frames.x[deep]).astype(int) if new else frames.press[deep] + 1000 * number
        parts.append(
            Presses(
                press_inputs(frames.readings[deep]),
                frames.x[deep, None],
                session,
                place,
            )
        )
    inputs = {name: np.concatenate([part.inputs[name] for part in parts]) for name in parts[0].inputs}
    return Presses(
        inputs,
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("targets", "session", "place")
        ),
    )


def press_inputs(readings: np.ndarray) -> dict[str, np.ndarray]:
    """Return readings (N, 4), and their shares, which do not depend on the force."""
    size = np.abs(readings).max(axis=1, keepdims=True)
    shares = readings / np.maximum(size, 1e-3)
    return {
        "readings": readings,
        "shares": shares,
        "shares and size": np.hstack([shares, np.log(np.maximum(size, 1e-3))]),
        "compressed": np.arcsinh(readings / 0.02),
    }


# The simulation against the real skin.


@dataclass(frozen=True)
class Strip:
    """The simulated strip, described in ``barometers.yaml``.

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

    def readings(self, x: np.ndarray, radius: "float | np.ndarray | None" = None) -> np.ndarray:
        """Return simulated readings (N, 4) of the tip with 1 N at places (N,) of the robot, mm."""
        return _strip_readings(
            self.body, self.simulator, x / 1e3 + self.offset, self.radius if radius is None else radius
        )


def _strip_readings(
    body: AbstractBody, simulator: AbstractSimulator, x: np.ndarray, radius: "float | np.ndarray"
) -> np.ndarray:
    discs = np.column_stack([x, np.full(len(x), body.size[1] / 2), np.broadcast_to(radius, len(x))])
    return disc_readings(simulator, body, discs, RIM)


def calibrate_strip(x: np.ndarray, measured: np.ndarray) -> Strip:
    """Return the strip whose readings are nearest to measured ones (P, 4) of presses at places (P,), mm."""
    about = OmegaConf.load(Path(__file__).with_name("barometers.yaml"))
    best: tuple[float, Strip] | None = None
    for thickness in about.thickness:
        about.body.layers[0].thickness = thickness
        for place in about.layout.positions:
            place[2] = thickness
        body = instantiate(about.body)
        simulator = instantiate(about.simulator)(body, instantiate(about.layout).sensors(body))
        grid = np.arange(0.001, body.size[0] - 0.001, 2e-4)
        for radius in about.radius:
            table = _strip_readings(body, simulator, grid, radius)
            for offset in np.arange(about.offset[0], about.offset[1], 1e-4):
                felt = np.stack([np.interp(x / 1e3 + offset, grid, column) for column in table.T], axis=1)
                gains = (felt * measured).sum(axis=0) / np.square(felt).sum(axis=0)
                error = np.sqrt(np.square(felt - measured / gains).mean(axis=0))
                loss = float(np.square(felt * gains - measured).mean())
                if best is None or loss < best[0]:
                    best = loss, Strip(body, simulator, radius, float(offset), gains, error)
    assert best is not None
    return best[1]


@dataclass(frozen=True)
class Plateaus:
    """Presses at full depth.

    Attributes:
        strip: calibrated on every third press of a recording.
        x: places of the other presses, mm, (P,).
        measured: their readings, (P, 4).
    """

    strip: Strip
    x: np.ndarray
    measured: np.ndarray


@cache
def _calibrated(path: Path) -> tuple[Strip, np.ndarray, np.ndarray]:
    (file,) = path.glob(f"{CALIBRATED}*.csv")
    x, measured = read_frames(file).plateaus()
    chosen = np.arange(len(x)) % 3 == 1
    return calibrate_strip(x[chosen], measured[chosen]), x[~chosen], measured[~chosen]


def read_plateaus(row: RealRow, path: Path, settings: RealSettings, test: str = "") -> Plateaus:
    """Return a strip calibrated on 20 presses, and the others of the recording, or those of another one.

    The robot begins elsewhere in another recording: every third press tells where, the others are returned.
    """
    strip, x, measured = _calibrated(path)
    if test:
        (file,) = path.glob(f"{test}*.csv")
        x, measured = read_frames(file).plateaus()
        chosen = np.arange(len(x)) % 3 == 1
        strip = _moved(strip, x[chosen], measured[chosen])
        x, measured = x[~chosen], measured[~chosen]
    if row.targets:
        near = x / 1e3 + strip.offset < LAST + PITCH / 2
        x, measured = x[near], measured[near]
    return Plateaus(strip, x, measured)


def _moved(strip: Strip, x: np.ndarray, measured: np.ndarray) -> Strip:
    """Return the strip at the place below the robot with which measured readings (P, 4) agree best."""
    places = strip.offset + np.arange(-PITCH, PITCH + 1e-6, 1e-4)
    inside = [
        place for place in places if place > 0.001 and place + x.max() / 1e3 < strip.body.size[0] - 0.001
    ]
    moved = [replace(strip, offset=float(place)) for place in inside]
    losses = [np.square(each.readings(x) * each.gains - measured).sum() for each in moved]
    return moved[int(np.argmin(losses))]


def run_prediction(row: RealRow, plateaus: Plateaus, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Compare simulated readings with measured ones: root of the squared errors over that of the readings."""
    strip, measured = plateaus.strip, plateaus.measured
    wrong = np.square(strip.readings(plateaus.x) * strip.gains - measured).sum(axis=1)
    whole = np.square(measured).sum(axis=1)
    draw = np.random.default_rng([settings.seed, 8]).integers(len(wrong), size=(RESAMPLES, len(wrong)))
    low, high = spread(100 * np.sqrt(wrong[draw].sum(axis=1) / whole[draw].sum(axis=1)))
    value = 100 * float(np.sqrt(wrong.sum() / whole.sum()))
    yield result_line(
        row,
        CALIBRATION,
        len(wrong),
        _words(strip),
        metric="relative rms",
        value=value,
        low=low,
        high=high,
        over=row.over,
    )


def _words(strip: Strip) -> str:
    """Return what the calibration chose."""
    depth = 1e3 * sum(layer.thickness for layer in strip.body.layers)
    return f"solid, {depth:g} mm thick, tip of {1e3 * strip.radius:g} mm"


def _place_line(
    row: RealRow, errors: np.ndarray, words: str, training: int | str, settings: RealSettings
) -> dict[str, Any]:
    squares = np.square(errors)
    low, high = interval(squares, np.arange(len(squares)), settings.seed)
    value = float(np.sqrt(squares.mean()))
    return result_line(
        row, training, len(errors), words, metric="rms", value=value, low=low, high=high, over=row.over
    )


def run_posterior(row: RealRow, plateaus: Plateaus, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Estimate the place of each press by the posterior of the simulated strip."""
    strip = plateaus.strip
    prior = FingertipPrior(
        1.0, SPREAD, (0.8 * strip.radius, 1.25 * strip.radius), RIM, numbers=(0, 1, 0, 0), large=0
    )
    noise = Noise(float(np.sqrt(np.square(strip.error).mean())))
    posterior = Posterior(strip.simulator, noise, strip.body, prior, contacts=1)
    estimates = posterior.estimate(plateaus.measured / strip.gains)
    assert isinstance(estimates, list)
    places = np.array([estimate.contacts[0].place[0] for estimate in estimates])
    errors = 1e3 * (places - strip.offset) - plateaus.x
    yield _place_line(row, errors, "posterior", f"gains from {CALIBRATION}", settings)


def run_simulated(row: RealRow, plateaus: Plateaus, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Train on simulated presses alone, and estimate the places of the real ones."""
    strip, draw = plateaus.strip, np.random.default_rng([settings.seed, 9])
    x = 1e3 * (draw.uniform(PITCH / 2, LAST + PITCH, SIMULATED) - strip.offset)
    felt = strip.readings(x, strip.radius * draw.uniform(0.8, 1.25, SIMULATED))
    felt *= np.exp(SPREAD * draw.standard_normal((SIMULATED, 1)))
    felt += strip.error * draw.standard_normal(felt.shape)
    size = float(np.abs(felt).max())
    training = Presses(press_inputs(felt / size), x[:, None], np.zeros(SIMULATED, int), np.arange(SIMULATED))
    count = len(plateaus.x)
    tested = Presses(
        press_inputs(plateaus.measured / strip.gains / size),
        plateaus.x[:, None],
        np.zeros(count, int),
        np.arange(count),
    )
    pair = choose(training, settings.seed, by_place=False)
    errors = (predict(pair, training, tested, settings.seed) - tested.targets)[:, 0]
    yield _place_line(row, errors, ", ".join(reversed(pair)), f"{SIMULATED} simulated", settings)


_row = partial(RealRow, path=FOLDER, over="presses")
_x = partial(_row, unit="mm", targets=("x",))
_same = "every third press of 6 July 2023 -> the others"
_other = "gains of 6 July 2023, 17:54 -> presses of 17:01, place of the robot from every third"


def _rows_of_places(
    name: str, split: str, goal: float, train: Sequence[str], test: Sequence[str]
) -> Iterator[RealRow]:
    """Yield the rows for all places and for those near sensors; places are then new, too, in five folds."""
    sessions: dict[str, Any] = {"train": set(range(len(train))), "test": len(train)}
    for words, reach in ((" near sensors", REACH), (" everywhere", np.inf)):
        read = partial(read_places, train=train, test=test, reach=reach)
        place = split if np.isinf(reach) else f"{split}, places up to {reach:g} mm"
        yield _x(name=name + words, split=place, goal=goal, read=read, run=partial(run_sessions, **sessions))
        yield _x(
            name=f"{name} at new places{words}",
            split=f"{place}; 5 folds by place",
            goal=None,
            read=partial(read, new=True),
            run=partial(run_places, **sessions),
        )


ROWS = (
    *_rows_of_places(
        "barometers x other day", "9 runs of 26 and 28 June 2023 -> 29 June 2023", 0.8, BEFORE, AFTER
    ),
    *_rows_of_places("barometers x other speed", "26 June 2023: 6 runs -> 2 slower runs", 1.8, SLOW, SLOWER),
    _row(
        name="barometers simulated, readings",
        split=_same,
        unit="%",
        goal=25.0,
        read=read_plateaus,
        run=run_prediction,
    ),
    _row(
        name="barometers simulated, readings, repeated",
        split=_other,
        unit="%",
        goal=25.0,
        read=partial(read_plateaus, test=REPEATED),
        run=run_prediction,
    ),
    _x(name="barometers posterior, x", split=_same, goal=2.0, read=read_plateaus, run=run_posterior),
    _x(
        name="barometers posterior, x, repeated",
        split=_other,
        goal=2.0,
        read=partial(read_plateaus, test=REPEATED),
        run=run_posterior,
    ),
    _x(
        name="barometers trained on simulated, x",
        split=_same,
        goal=2.0,
        read=read_plateaus,
        run=run_simulated,
    ),
    _x(
        name="barometers trained on simulated, x, repeated",
        split=_other,
        goal=2.0,
        read=partial(read_plateaus, test=REPEATED),
        run=run_simulated,
    ),
)
