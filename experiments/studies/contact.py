"""The posterior of contacts, against layers that are solved exactly and against a real strip of barometers.

Fingertips press the layered solution of :mod:`experiments.laws.references`, which shares no code with the
simulator and is endless in the plane; contacts therefore keep away from the rim. Hands and bars press the
simulator of the configuration. Touches that raise no sensor above three standard deviations of a frame are
left out.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache
from itertools import compress, product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from annotated_types import Ge, Gt, MinLen
from scipy.optimize import linear_sum_assignment
from scipy.special import softmax
from scipy.stats import t

from experiments.laws.references import Discs, Slab
from experiments.studies.measures import Subject
from skin.body.base import AbstractBody, Layer, Sensors
from skin.body.layout import Listed
from skin.body.material import Material
from skin.body.sheet import Sheet
from skin.core.settings import RISING
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.inference.candidates import FingertipPrior, disc_readings
from skin.inference.likelihood import Forces, Observation, fit_force, integrate_force
from skin.inference.mechanics import Mechanics
from skin.inference.noise import Noise
from skin.inference.posterior import FrameEstimate, Posterior
from skin.inference.watch import Thickness
from skin.mechanics.simulator.base import AbstractSimulator
from skin.mechanics.simulator.solid import Solid
from skin.touch.gestures import GestureSettings, draw_bodies
from skin.touch.shapes import Shapes

_COLUMNS = (
    "rms_mm", "median_mm", "force_median_%", "peak_median_%", "peak_covered_%", "covered_%", "covered_low_%",
    "covered_high_%", "area_median_mm2", "direction_median_deg", "grid_rms_mm", "grid_median_mm",
    "grid_force_median_%", "grid_direction_median_deg",
)  # fmt: skip


@dataclass(frozen=True)
class Contact:
    """Errors of estimated contacts, and how often their regions hold the truth; a row of texts.

    Args:
        touches: with one contact; a quarter as many with several and of hands, which take longer.
        force: median of a fingertip, N.
        number: contacts at a time; 0: a hand or a bar.
        margin: least distance of contacts from the rim, m.
        apart: least distance between contacts, m.
        exactly: whether neighbours are that far apart.
        gain, clip, position: of the device, as :class:`skin.inference.noise.Noise` has them.
        actual: layers of the skin that is touched, where the posterior has others; its sensors are as far
            above the base.
        thickness: range that the posterior learns from.
        counted: touches of a stream that count, from one up to another one, where the posterior learns. Each
            stream begins with the described thickness.
        friction: largest tangential force as a fraction of the force; fractions up to it are equally likely.
        grid: m, pitch of the grid whose posterior is compared (:func:`grid_errors`); 0: none.
        seed: of the touches, with the name of the condition.
    """

    touches: Annotated[int, Ge(4)] = 2500
    force: Annotated[float, Gt(0)] = 5.0
    number: Annotated[int, Ge(0)] = 1
    margin: Annotated[float, Ge(0)] = 0.03
    apart: Annotated[float, Ge(0)] = 0.0
    exactly: bool = False
    gain: float = 0.0
    clip: float = float("inf")
    position: float = 0.0
    actual: Sequence[Any] = ()
    thickness: Annotated[tuple[float, float], RISING] = (1.0, 1.0)
    counted: Annotated[tuple[int, int], RISING] = (19, 50)
    friction: Annotated[float, Ge(0)] = 0.0
    grid: Annotated[float, Ge(0)] = 0.0
    seed: Annotated[int, Ge(0)] = 0

    def __call__(self, subject: Subject) -> pd.DataFrame:
        torch.set_num_threads(1)  # the times are those of one
        device = subject.device.simulated("contacts are simulated")
        body, sensors = device.body, device.sensors
        assert isinstance(body, Sheet)
        prior, noise = (
            FingertipPrior(force=self.force, friction=self.friction),
            Noise(0.05, 10, self.gain, self.clip, 0, self.position, self.thickness),
        )
        rng = np.random.default_rng([self.seed, *subject.condition.encode()])
        count, exact = self.touches if self.number == 1 else self.touches // 4, None
        shift = np.pad(noise.position * rng.standard_normal((len(sensors), 2)), ((0, 0), (0, 1)))
        if self.number:
            touched = Sheet(body.size, body.cells, self.actual) if self.actual else body  # type: ignore[arg-type]
            shift[:, 2] = touched.thickness - body.thickness
            exact = ExactSkin(touched, replace(sensors, positions=sensors.positions + shift), prior)
            contacts = self._draw_contacts(body, prior, 3 * count, rng)
            flat = contacts.reshape(-1, contacts.shape[2])
            forces = flat[:, None, 3:] @ exact.readings(flat[:, :3], float(self.friction > 0))
            true = forces.reshape(*contacts.shape[:2], -1).sum(1)
        else:
            true = press_hands(device, 2 * count, rng)
            contacts = np.zeros((len(true), 0, 4))
        chosen = np.flatnonzero((np.abs(true) > 3 * noise.frame).any(1))[:count]
        gains, scatter = 1 + noise.gain * rng.standard_normal(true.shape[1]), np.sqrt(noise.floor)
        readings = gains * true[chosen] + scatter * rng.standard_normal((len(chosen), len(sensors)))
        posterior = Posterior(device.model, noise, body, prior)
        described = Thickness(Mechanics(device.simulator, body, sensors, noise), posterior)
        candidates, works = posterior.candidates, np.ones(len(sensors), dtype=bool)
        first, length = self.counted if self.thickness != (1, 1) else (0, len(readings))
        estimates = list[FrameEstimate]()
        for number, values in enumerate(readings):
            if number % length == 0:
                learned = copy(described)
                posterior.assume(candidates, noise)
            estimates.append(posterior.estimate(values))
            if estimates[-1].fingertip and estimates[-1].number == 1:
                learned.add(Observation.of(values, works, ~works, posterior.noise))
        counted = np.arange(len(readings)) % length >= first
        figures = summarise_estimates(
            [*compress(estimates, counted)],
            contacts[chosen][counted],
            prior,
            length - first if first else 1,
        )
        if exact and self.grid:
            figures |= grid_errors(exact, body, noise, prior, readings, contacts[chosen, 0], self.grid)
        return pd.DataFrame(
            [
                {"row": subject.condition}
                | {
                    key: f"{each:.4g}".replace("nan", "") if isinstance(each, float) else str(each)
                    for key, each in figures.items()
                }
            ]
        )

    def _draw_contacts(
        self, body: AbstractBody, prior: FingertipPrior, count: int, rng: np.random.Generator
    ) -> np.ndarray:
        """Return contacts (count, number, 4 or 6): x, y, radius, m, force, N; with friction along x and y."""
        touches, size = list[np.ndarray](), np.array(body.size)
        while len(touches) < count:
            positions = self.margin + (size - 2 * self.margin) * rng.random((self.number, 2))
            if self.exactly:
                turn = rng.uniform(0, 2 * np.pi, self.number - 1)
                positions[1:] = self.apart * np.stack([np.cos(turn), np.sin(turn)], axis=1)
                positions = positions.cumsum(0)
            pairs = np.triu_indices(self.number, 1)
            distances = np.linalg.norm(positions[:, None] - positions, axis=2)[pairs]
            inside = ((positions >= self.margin) & (positions <= size - self.margin)).all()
            if inside and (distances > self.apart - 1e-9).all():
                radius = rng.uniform(*prior.radii, self.number)
                force = prior.force * np.exp(prior.spread * rng.standard_normal(self.number))
                touches.append(np.column_stack([positions, radius, force]))
                if self.friction:
                    pull = self.friction * rng.random(self.number) * force
                    pull = pull * np.exp(2j * np.pi * rng.random(self.number))
                    touches[-1] = np.column_stack([touches[-1], pull.real, pull.imag])
        return np.array(touches)


class ExactSkin:
    """Endless layers with sensors at a depth, under fingertips; solved by waves.

    A fingertip's pressure falls along a logistic function at its edge
    (:class:`skin.mechanics.geometry.Fingertip`): it is the mean of discs whose radii have that distribution.

    Args:
        body: its layers count.
        sensors: at one depth, facing the surface, with square footprints.
        prior: of the fingertips.
    """

    def __init__(self, body: Sheet, sensors: Sensors, prior: FingertipPrior) -> None:
        slabs = [
            # A material above 0.5 is impossible; the simulator takes 0.49, too.
            Slab(layer.thickness, material.young, 0.49 if material.poisson > 0.5 else material.poisson)
            for layer in reversed(body.layers)
            for material in [layer.material]
        ]
        edges = np.log(
            np.arange(1, 32, 2) / np.arange(31, 0, -2)
        )  # even quantiles of the logistic distribution
        self._sensors, self._rims = sensors, prior.rim * edges
        depth, reach = float(sensors.positions[0, 2]), float(np.hypot(*body.size))
        self._discs = Discs(slabs, depth, prior.radii, reach, self._rims.tolist())

    def readings(self, fingertips: np.ndarray, friction: float = 0.0) -> np.ndarray:
        """Return the readings (N, L, S), N/N, of fingertips (N, 3) of 1 N: x, y and radius, m.

        They are those of the force into the skin (L = 1) and, if ``friction`` is above 0, of that many
        newtons along x, and along y (L = 3).
        """
        area = np.pi * np.square((fingertips[:, 2:] + self._rims).clip(min=0)).mean(1, keepdims=True)
        side, axes = self._sensors.footprint[0], self._sensors.axes
        places, parts = self._sensors.positions[::axes, :2], np.array_split(fingertips, len(area) // 500 + 1)
        forces = np.concatenate([self._discs.tractions(part, places, side)[:, :, -axes:] for part in parts])
        loads = forces.reshape(len(area), -1, 3).transpose(0, 2, 1) / area[..., None]
        return loads[:, [2, 0, 1]] * np.array([[1], [friction], [friction]]) if friction else loads[:, 2:]


def press_hands(device: Simulated, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the readings (count, S), N, of hands and bars of the default gestures."""
    settings = GestureSettings(shapes=("bar", "hand"))
    shapes = Shapes(settings.shapes, device.body)
    drawn = draw_bodies(rng.random(count) < 0.5, settings, shapes, rng)
    room = np.array(device.size) - settings.spare - (drawn["high"] - drawn["low"])
    position = settings.spare / 2 - drawn["low"] + room * rng.random((count, 2))
    frames = shapes.render(drawn["shape"], drawn["angle"], drawn["scale"], position, drawn["stretch"])
    peak = torch.from_numpy(rng.uniform(10e3, 180e3, count)).float()[:, None, None]
    with torch.no_grad():
        return device.model(frames / frames.amax((1, 2), keepdim=True) * peak).readings.numpy().astype(float)


def grid_errors(
    skin: ExactSkin,
    body: AbstractBody,
    noise: Noise,
    prior: FingertipPrior,
    readings: np.ndarray,
    truth: np.ndarray,
    pitch: float,
) -> dict[str, Any]:
    """Return the figures of the best posterior that is known: on all positions of a grid, by the exact skin.

    Args:
        skin: with its readings.
        body: its size counts.
        noise: of the readings.
        prior: of the contacts.
        readings: (B, S), N.
        truth: contacts (B, 4 or 6): x, y, radius, m, and forces, N.
        pitch: of the grid, m.
    """
    x, y = (np.arange(pitch / 2, side, pitch) for side in body.size)
    grid = np.stack(np.meshgrid(x, y, np.linspace(*prior.radii, 9), indexing="ij"), -1).reshape(-1, 3)
    friction = (prior.friction or 0.0) / math.sqrt(6)
    table, works = skin.readings(grid, friction).astype(np.float32), np.ones(readings.shape[1], dtype=bool)
    none, means = np.zeros((len(table), table.shape[2]), np.float32), list[np.ndarray]()
    for values in readings:
        frame = Observation.of(values, works, ~works, noise)
        fit, evidence = fit_force(frame, prior, table, none)
        likely = np.flatnonzero(evidence > evidence.max() - 20)
        fit = Forces(*(part[likely] for part in fit))
        force, logs, tangent, _ = integrate_force(frame, prior, table[likely], none[likely], fit)
        weight = softmax(logs)
        sides = friction * np.einsum("nj,njk->k", weight * force, tangent)
        means.append(np.array([*(weight.sum(1) @ grid[likely, :2]), (weight * force).sum(), *sides]))
    estimates = np.array(means)
    away = estimates[:, :2] - truth[:, :2]
    return {
        "grid_rms_mm": 1e3 * float(np.sqrt(np.square(away).mean())),
        "grid_median_mm": 1e3 * float(np.median(np.hypot(*away.T))),
        "grid_force_median_%": 100 * float(np.median(np.abs(estimates[:, 2] / truth[:, 3] - 1))),
        "grid_direction_median_deg": float(pd.Series(map(turned, estimates[:, 3:], truth[:, 4:])).median()),
    }


def turned(estimated: np.ndarray | None, true: np.ndarray) -> float:
    """Return the angle between forces along the skin (2,), N, degrees; NaN if the true one is below 0.5 N."""
    if estimated is None or len(true) < 2 or np.hypot(*true) < 0.5:
        return np.nan
    return abs(float(np.degrees(np.angle(complex(*estimated) / complex(*true)))))


def summarise_estimates(
    estimates: Sequence[FrameEstimate], contacts: np.ndarray, prior: FingertipPrior, together: int = 1
) -> dict[str, Any]:
    """Return the figures of estimates for true contacts (B, n, 4), of the touches whose number is right.

    The interval of those covered is over groups of ``together`` estimates that follow each other.
    """
    number, rows = contacts.shape[1], list[dict[str, Any]]()
    right = [estimate.number == number for estimate in estimates]
    figures: dict[str, Any] = {
        "touches": len(estimates),
        "number_right_%": 100 * float(np.mean(right)) if number else "",
        "fingertip_%": 100 * float(np.mean([estimate.fingertip for estimate in estimates])),
        **dict.fromkeys(_COLUMNS, ""),
    }
    for place, (estimate, truths) in enumerate(zip(estimates, contacts, strict=True)):
        if not number or estimate.number != number:
            continue
        centres = np.array([contact.position for contact in estimate.contacts])
        distances = np.linalg.norm(centres[:, None] - truths[:, :2], axis=2)
        for index, true in zip(*linear_sum_assignment(distances**2), strict=True):
            contact, (*position, radius, force) = estimate.contacts[index], truths[true, :4]
            region, pressure = contact.region(), force * prior.peak(radius)
            row = {
                "group": place // together,
                "square": distances[index, true] ** 2 / 2,
                "distance": distances[index, true],
                "force": abs(contact.force / force - 1),
                "peak": abs(contact.peak / pressure - 1),
                "within": contact.peak_interval[0] < pressure < contact.peak_interval[1],
                "covered": region.contains(np.array(position)),
                "area": region.area,
                "direction": turned(contact.tangential, truths[true, 4:]),
            }
            rows.append(row)
    if not rows:
        return figures
    frame = pd.DataFrame(rows)
    median, mean = frame.median(), frame.mean()
    groups = frame.groupby("group").covered.mean()
    low, high = t.interval(0.95, len(groups) - 1, mean.covered, groups.sem())
    numbers = (
        1e3 * np.sqrt(mean.square), 1e3 * median.distance, 100 * median.force, 100 * median.peak,
        100 * mean.within, 100 * mean.covered, 100 * low, 100 * high, 1e6 * median.area,
        median.direction,
    )  # fmt: skip
    return figures | dict(zip(_COLUMNS, map(float, numbers), strict=False))


# Four barometers under a strip of rubber: the simulation against a real skin.


RIM = 5e-4  # m, of the tip
PITCH, LAST = 0.006, 0.027  # m, between the sensors, and the last of them in the strip


def read_presses(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the position (P,), mm, and the mean readings (P, 4), 10 kPa, of presses at their full depth.

    The five readings before each press are its baseline.

    Args:
        folder: of the recordings, each of a robot that presses a strip at one position after another.
        name: beginning of the name of the file.

    Raises:
        InputError: no such file, or none of its form.
    """
    try:
        (path,) = folder.glob(f"{name}*.csv")
        table = pd.read_csv(path)
        readings = table[[f"Sensor_{number}" for number in range(4)]].to_numpy(float) * 1e-4
        x, depth = table["x"].to_numpy(float) / 1e3, table["z"].to_numpy(float)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"cannot read {folder}/{name}*.csv as a recording of four barometers: {error}"
        ) from error
    number, presses = np.cumsum(np.diff((depth > 0).astype(int), prepend=0) > 0), []
    for press in range(1, int(number.max()) + 1):
        inside = np.flatnonzero((number == press) & (depth > 0))
        before = readings[max(0, inside[0] - 5) : inside[0]]
        baseline = before.mean(axis=0) if len(before) else readings[inside[0]]
        deep = inside[depth[inside] >= 0.98 * depth[inside].max()]
        presses.append([x[deep[0]], *(readings[deep] - baseline).mean(axis=0)])
    table = np.array(presses)
    return table[:, 0], table[:, 1:]


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

    def readings(self, x: np.ndarray) -> np.ndarray:
        """Return simulated readings (N, 4) of the tip with 1 N at positions (N,) of the robot, mm."""
        return strip_readings(self.body, self.simulator, x / 1e3 + self.offset, self.radius)

    def moved(self, x: np.ndarray, measured: np.ndarray) -> "Strip":
        """Return the strip at the position below the robot with which measured readings (P, 4) agree best."""
        offsets = self.offset + np.arange(-PITCH, PITCH + 1e-6, 1e-4)
        end = self.body.size[0] - 0.001 - x.max() / 1e3
        strips = [replace(self, offset=float(each)) for each in offsets if 0.001 < each < end]
        return min(strips, key=lambda strip: np.square(strip.readings(x) * strip.gains - measured).sum())


def strip_readings(
    body: AbstractBody, simulator: AbstractSimulator, x: np.ndarray, radius: float | np.ndarray
) -> np.ndarray:
    """Return readings (N, 4) of discs with 1 N in the middle of the strip at x (N,), m."""
    discs = np.column_stack([x, np.full(len(x), body.size[1] / 2), np.broadcast_to(radius, len(x))])
    return disc_readings(simulator, body, discs, RIM)


@cache
def build_strip(thickness: float) -> tuple[Sheet, Solid]:
    """Return body and simulator of the strip, with the sensors at its surface.

    The pitch of the sensors is known from the board, the width from the moulds.
    """
    body = Sheet((0.048, 0.010), (96, 20), (Layer(Material.of("EcoFlex 00-30"), thickness),))
    positions = [(LAST - number * PITCH, 0.005, thickness) for number in (3, 2, 1, 0)]
    return body, Solid(body, Listed(positions, (0.001, 0.001)).sensors(body))


def calibrate_strip(x: np.ndarray, measured: np.ndarray) -> Strip:
    """Return the strip whose readings are nearest to measured ones (P, 4) at positions (P,), mm.

    The unknown thickness, radius of the tip and x of the strip at x = 0 of the robot are chosen, too.
    """
    best, least = None, np.inf
    for thickness, radius in product(
        (0.003, 0.004, 0.005, 0.006), (0.0015, 0.002, 0.0025, 0.003, 0.0035, 0.0045)
    ):
        body, simulator = build_strip(thickness)
        grid = np.arange(0.001, body.size[0] - 0.001, 2e-4)
        table = strip_readings(body, simulator, grid, radius)
        for offset in np.arange(0.006, 0.012, 1e-4):
            simulated = np.stack([np.interp(x / 1e3 + offset, grid, column) for column in table.T], axis=1)
            gains = (simulated * measured).sum(axis=0) / np.square(simulated).sum(axis=0)
            loss = float(np.square(simulated * gains - measured).mean())
            if loss < least:
                error = np.sqrt(np.square(simulated - measured / gains).mean(axis=0))
                best, least = Strip(body, simulator, radius, float(offset), gains, error), loss
    assert best is not None  # of many
    return best


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

    def __call__(self, subject: Subject) -> pd.DataFrame:
        strip: Strip | None = None
        for name in self.recordings:
            x, measured = read_presses(Path(self.data).expanduser(), name)
            chosen = np.arange(len(x)) % 3 == 1
            known = x[chosen], measured[chosen]
            strip = calibrate_strip(*known) if strip is None else strip.moved(*known)
            x, measured = x[~chosen], measured[~chosen]
        assert strip is not None
        wrong = np.square(strip.readings(x) * strip.gains - measured).sum(axis=1)
        close = x / 1e3 + strip.offset < LAST + PITCH / 2
        squares = np.square(posterior_errors(strip, x[close], measured[close]))
        rows = [
            {"metric": "relative rms of readings, %"}
            | self._rms(1e4 * wrong, np.square(measured).sum(axis=1), 8),
            {"metric": "rms of positions, mm"} | self._rms(squares, np.ones_like(squares), 4),
        ]
        start = {
            "recording": subject.condition,
            "training": 20,
            "strip": f"solid, {1e3 * strip.body.thickness:g} mm thick, tip of {1e3 * strip.radius:g} mm",
        }
        return pd.DataFrame([start | row for row in rows]).round(3)

    def _rms(self, squares: np.ndarray, weights: np.ndarray, stream: int) -> dict[str, float]:
        """Return the root of the weighted mean, and its 95 % interval over presses."""
        count = len(squares)
        draw = np.random.default_rng([self.seed, stream]).integers(count, size=(1000, count))
        roots = np.sqrt(squares[draw].sum(axis=1) / weights[draw].sum(axis=1))
        low, high = np.quantile(roots, [0.025, 0.975]).tolist()
        return {
            "test": count,
            "value": float(np.sqrt(squares.sum() / weights.sum())),
            "low": low,
            "high": high,
        }


def posterior_errors(strip: Strip, x: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the errors of positions by the posterior of the simulated strip, mm."""
    radii = 0.8 * strip.radius, 1.25 * strip.radius
    prior = FingertipPrior(1.0, 0.3, radii, RIM, numbers=(0, 1, 0, 0), large=0)
    noise = Noise(float(np.sqrt(np.square(strip.error).mean())))
    posterior = Posterior(strip.simulator, noise, strip.body, prior, contacts=1)
    estimates = posterior.estimate(measured / strip.gains)
    assert isinstance(estimates, list)
    positions = np.array([estimate.contacts[0].position[0] for estimate in estimates])
    return 1e3 * (positions - strip.offset) - x
