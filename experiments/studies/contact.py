"""Measure the posterior of contacts on skins that nothing was tuned on, against layers solved exactly.

    python -m experiments.studies.contact
    python -m experiments.studies.contact touches=200 rows=deep,thin out=FOLDER

Writes contact.csv into docs/results, or into ``out=``. ``rows=``: only rows whose name begins so. Touches
that raise no sensor above three standard deviations of a frame are left out. Several contacts and hands take
twenty times as long: a quarter of the touches.

Fingertips press the layered solution of :mod:`experiments.validation.references`, which shares no code with
the simulator and is endless in the plane; contacts therefore keep away from the rim. Hands and bars press
``simulator=solid``.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
from scipy.stats import binomtest

from experiments import run_script, script_settings
from experiments.studies.pages import csv_text
from experiments.validation.references import Discs, Slab
from skin.body.base import AbstractBody, Layer, Sensors
from skin.body.layout import AbstractLayout, Grid, Hexagonal, Random
from skin.body.material import Material
from skin.body.sheet import Sheet
from skin.core.files import ROOT, write
from skin.errors import InputError
from skin.inference.candidates import FingertipPrior
from skin.inference.noise import Noise
from skin.inference.posterior import FrameEstimate, Posterior
from skin.mechanics.simulator.solid import Solid
from skin.touch.gestures import GestureSettings, draw_bodies
from skin.touch.shapes import Shapes

CELL = 0.005  # m
POISSON = {"Dragon Skin 10 Medium": 0.49}
FELT = 3.0  # standard deviations of a frame
SIDE = 0.01  # m, of the sensors' footprints
_EDGES = np.log(np.arange(1, 32, 2) / np.arange(31, 0, -2))  # even quantiles of the logistic distribution


def make_sheet(*layers: tuple[str, float], softer: float = 1.0, side: float = 0.16) -> Sheet:
    """Return a sheet of materials and thicknesses, m, from the base up; moduli by a factor."""
    made = [(Material.of(name), thickness) for name, thickness in layers]
    return Sheet(
        (side, side),
        (round(side / CELL),) * 2,
        tuple(Layer(replace(material, young=material.young * softer), thick) for material, thick in made),
    )


DEEP = make_sheet(("EcoFlex 00-30", 0.03))
MIDDLE = make_sheet(("EcoFlex 00-30", 0.02))
THIN = make_sheet(("Dragon Skin 10 Medium", 0.01), ("EcoFlex 00-30", 0.005))
GRID = Grid(5, 5, (SIDE, SIDE))


@dataclass(frozen=True)
class Row:
    """Touches of a kind on a skin.

    Attributes:
        name: of the row.
        body, layout: the skin.
        depth: of the sensors, m.
        force: median, N.
        noise: of the readings.
        number: contacts at a time; 0: a hand or a bar.
        margin: least distance from the rim, m.
        apart: least distance between contacts, m.
        exactly: whether neighbours are that far apart.
        actual: the skin that is touched, where the posterior has another one.
    """

    name: str
    body: Sheet = DEEP
    layout: AbstractLayout = GRID
    depth: float = 0.0295
    force: float = 5.0
    noise: Noise = field(default_factory=lambda: Noise(0.05, 10))
    number: int = 1
    margin: float = 0.03
    apart: float = 0.0
    exactly: bool = False
    actual: Sheet | None = None

    @property
    def sensors(self) -> Sensors:
        """Sensors where the posterior has them."""
        places = self.layout.sensors(self.body).positions.copy()
        places[:, 2] = self.depth
        return Sensors(places, (SIDE, SIDE))


@dataclass(frozen=True)
class Ring(AbstractLayout):
    """Sensors on a circle about the middle.

    Attributes:
        count: of sensors.
        radius: of the circle, m.
    """

    count: int
    radius: float

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors on a body, at its surface."""
        turn = 2 * np.pi * np.arange(self.count) / self.count
        away = self.radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
        return Sensors(np.array([*body.size, 0.0]) / 2 + away, (SIDE, SIDE))


def rows() -> list[Row]:
    """Return all rows of the table."""
    thin = Row("thin", body=THIN, depth=0.005, margin=0.015)
    clipped = Noise(0.05, 10, clip=10.0)
    device = Noise(0.05, 10, gain=0.02, position=0.001)
    layouts = {
        "16": Grid(4, 4, GRID.footprint),
        "64": Grid(8, 8, GRID.footprint),
        "hexagonal": Hexagonal(5, 5, GRID.footprint),
        "hexagonal_49": Hexagonal(7, 7, GRID.footprint),
        "random": Random(25, 1, GRID.footprint),
        "random_7": Random(7, 3, GRID.footprint),
        "random_30": Random(30, 2, GRID.footprint),
    }
    return [
        Row("deep"),
        Row("middle", body=MIDDLE, depth=0.0195, margin=0.02),
        thin,
        replace(thin, name="thin_20N", force=20.0, noise=clipped),
        *(Row(f"layout_{name}", layout=layout) for name, layout in layouts.items()),
        Row("layout_ring_12", body=make_sheet(("EcoFlex 00-30", 0.03), side=0.2), layout=Ring(12, 0.06)),
        *(Row(f"device_{number}", noise=device) for number in range(1, 6)),
        *(replace(thin, name=f"thin_device_{number}", noise=device) for number in range(1, 6)),
        Row("stiffer", actual=make_sheet(("EcoFlex 00-30", 0.03), softer=1.2)),
        Row("softer", actual=make_sheet(("EcoFlex 00-30", 0.03), softer=0.8)),
        Row("thicker", actual=make_sheet(("EcoFlex 00-30", 0.033))),
        Row("thinner", actual=make_sheet(("EcoFlex 00-30", 0.03 * 0.9)), depth=0.0265),
        *(
            Row(f"{name}_{kind}", number=number, apart=apart, exactly=exactly)
            for name, number in (("two", 2), ("three", 3))
            for kind, apart, exactly in (
                ("64mm", 0.064, False),
                ("from_32mm", 0.032, False),
                ("32mm", 0.032, True),
            )
        ),
        Row("hands_deep", number=0),
        replace(thin, name="hands_thin", number=0),
        replace(thin, name="hands_thin_20N", number=0, force=20.0, noise=clipped),
    ]


def draw_contacts(row: Row, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return contacts (count, number, 4): x, y, radius, m, and force, N."""
    prior, touches = FingertipPrior(force=row.force), list[np.ndarray]()
    size = np.array(row.body.size)
    while len(touches) < count:
        places = row.margin + (size - 2 * row.margin) * rng.random((row.number, 2))
        if row.exactly:
            turn = rng.uniform(0, 2 * np.pi, row.number - 1)
            places[1:] = row.apart * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            places = places.cumsum(0)
        away = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(row.number, 1)]
        inside = ((places >= row.margin) & (places <= size - row.margin)).all()
        if inside and (away > row.apart - 1e-9).all():
            radius = rng.uniform(*prior.radii, row.number)
            force = prior.force * np.exp(prior.spread * rng.standard_normal(row.number))
            touches.append(np.column_stack([places, radius, force]))
    return np.array(touches)


class ExactSkin:
    """Endless layers with sensors at a depth, under fingertips; solved by waves.

    A fingertip's pressure falls along a logistic function at its edge
    (:class:`skin.mechanics.geometry.Fingertip`): it is the mean of discs whose radii have that distribution.

    Args:
        body: its layers count.
        sensors: at one depth.
        prior: of the fingertips.
    """

    def __init__(self, body: Sheet, sensors: Sensors, prior: FingertipPrior) -> None:
        slabs = [
            Slab(
                layer.thickness,
                layer.material.young,
                POISSON.get(layer.material.name, layer.material.poisson),
            )
            for layer in reversed(body.layers)
        ]
        self._sensors, self._rims = sensors, prior.rim * _EDGES
        depth, reach = float(sensors.positions[0, 2]), float(np.hypot(*body.size))
        self._discs = Discs(slabs, depth, prior.radii, reach, self._rims.tolist())

    def readings(self, fingertips: np.ndarray) -> np.ndarray:
        """Return the readings (N, S), N/N, of fingertips (N, 3) of 1 N: x, y and radius, m."""
        area = np.pi * np.square((fingertips[:, 2:] + self._rims).clip(min=0)).mean(1, keepdims=True)
        return self._discs.forces(fingertips, self._sensors.positions[:, :2], SIDE) / area


def press_hands(simulator: Solid, body: Sheet, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the readings (count, S), N, of hands and bars of the default gestures."""
    settings = GestureSettings(shapes=("bar", "hand"))
    shapes = Shapes(settings.shapes, THIN)
    drawn = draw_bodies(rng.random(count) < 0.5, settings, shapes, rng)
    room = np.array(body.size) - settings.spare - (drawn["high"] - drawn["low"])
    place = settings.spare / 2 - drawn["low"] + room * rng.random((count, 2))
    frames = shapes.render(drawn["shape"], drawn["angle"], drawn["scale"], place, drawn["stretch"])
    peak = torch.from_numpy(rng.uniform(10e3, 180e3, count)).float()[:, None, None]
    with torch.no_grad():
        return simulator(frames / frames.amax((1, 2), keepdim=True) * peak).readings.numpy().astype(float)


def read_device(readings: np.ndarray, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Return what a device with gains of its own measures, (B, S), N."""
    gain = 1 + noise.gain * rng.standard_normal(readings.shape[1])
    return gain * readings + np.sqrt(noise.floor) * rng.standard_normal(readings.shape)


def run_row(row: Row, count: int, seed: int) -> dict[str, object]:
    """Return the figures of a row."""
    rng = np.random.default_rng([seed, *row.name.encode()])
    prior, sensors = FingertipPrior(force=row.force), row.sensors
    shift = np.pad(row.noise.position * rng.standard_normal((len(sensors), 2)), ((0, 0), (0, 1)))
    real = Sensors(sensors.positions + shift, sensors.footprint)
    simulator = Solid(row.body, sensors, poisson=POISSON)
    posterior = Posterior(simulator, row.noise, row.body, prior)
    contacts, exact = draw_contacts(row, 3 * count if row.number else 0, rng), None
    if row.number:
        exact = ExactSkin(row.actual or row.body, real, prior)
        flat = contacts.reshape(-1, 4)
        felt = exact.readings(flat[:, :3]) * flat[:, 3:]
        true = felt.reshape(*contacts.shape[:2], -1).sum(1)
    else:
        true = press_hands(simulator, row.body, 2 * count, rng)
        contacts = np.zeros((len(true), 0, 4))
    chosen = np.flatnonzero((true > FELT * row.noise.frame).any(1))[:count]
    readings = read_device(true[chosen], row.noise, rng)
    estimates, seconds = list[FrameEstimate](), list[float]()
    for values in readings:
        start = time.process_time()
        estimate = posterior.estimate(values)
        seconds.append(time.process_time() - start)
        assert isinstance(estimate, FrameEstimate)
        estimates.append(estimate)
    figures = {"row": row.name} | summarise_estimates(estimates, contacts[chosen], prior)
    if exact and row.name == "deep":
        figures |= _summarise_grid(GridPosterior(exact, row, prior), readings, contacts[chosen, 0])
    return figures | {
        "ms_median": 1e3 * float(np.median(seconds)),
        "ms_p99": 1e3 * float(np.quantile(seconds, 0.99)),
    }


class GridPosterior:
    """Posterior of one contact on all places of a grid, with the readings of the exact skin: the best known.

    Args:
        skin: with its readings.
        row: size and noise.
        prior: of the contact.
    """

    def __init__(self, skin: ExactSkin, row: Row, prior: FingertipPrior) -> None:
        x, y = (np.arange(0.0005, side, 0.001) for side in row.body.size)
        radii = np.linspace(*prior.radii, 9)
        self._grid = np.stack(np.meshgrid(x, y, radii, indexing="ij"), -1).reshape(-1, 3)
        self._table, self._floor = skin.readings(self._grid), row.noise.floor
        self._square = (self._table**2).sum(1) / self._floor
        self._score = np.linspace(-5, 5, 101)
        self._force = prior.force * np.exp(prior.spread * self._score)

    def estimate(self, readings: np.ndarray) -> np.ndarray:
        """Return the mean x and y, m, and force, N, for readings (S,), N."""
        along = self._table @ readings / self._floor
        best = along.clip(min=0) ** 2 / self._square / 2
        likely = np.flatnonzero(best > best.max() - 25)
        fit = np.outer(along[likely], self._force) - np.outer(self._square[likely], self._force**2) / 2
        mass = np.exp(fit - self._score**2 / 2 - fit.max())
        mass /= mass.sum()
        return np.array([*(mass.sum(1) @ self._grid[likely, :2]), mass.sum(0) @ self._force])


def _summarise_grid(grid: GridPosterior, readings: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    found = np.stack([grid.estimate(values) for values in readings])
    return {
        "grid_rms_mm": 1e3 * float(np.sqrt(np.square(found[:, :2] - truth[:, :2]).mean())),
        "grid_force_median_%": 100 * float(np.median(np.abs(found[:, 2] / truth[:, 3] - 1))),
    }


def summarise_estimates(
    estimates: Sequence[FrameEstimate], contacts: np.ndarray, prior: FingertipPrior
) -> dict[str, object]:
    """Return the figures of estimates for true contacts (B, n, 4), of the touches whose number is right."""
    number = contacts.shape[1]
    right = [row for row, estimate in enumerate(estimates) if estimate.number == number]
    figures: dict[str, object] = {
        "touches": len(estimates),
        "number_right_%": 100 * len(right) / max(len(estimates), 1) if number else "",
        "fingertip_%": 100 * float(np.mean([estimate.fingertip for estimate in estimates])),
    }
    names = (
        "rms_mm", "median_mm", "force_median_%", "peak_median_%", "peak_covered_%", "covered_%",
        "covered_low_%", "covered_high_%", "area_median_mm2", "grid_rms_mm", "grid_force_median_%",
    )  # fmt: skip
    figures |= dict.fromkeys(names, "")
    if not number or not right:
        return figures
    place, force, peak, within, covered, area = [], [], [], [], [], []
    for row in right:
        found = estimates[row].contacts
        away = np.array([[np.sum((c.place - t[:2]) ** 2) for t in contacts[row]] for c in found])
        order = min(permutations(range(number)), key=lambda p: sum(away[k, p[k]] for k in range(number)))
        for contact, index in zip(found, order, strict=True):
            truth = contacts[row, index]
            region, pressure = contact.region(), truth[3] * prior.peak(truth[2])
            place.append(contact.place - truth[:2])
            force.append(contact.force / truth[3] - 1)
            peak.append(contact.peak / pressure - 1)
            within.append(contact.peak_interval[0] < pressure < contact.peak_interval[1])
            covered.append(region.contains(truth[:2]))
            area.append(region.area)
    interval = binomtest(sum(covered), len(covered)).proportion_ci(method="wilson")
    values = (
        1e3 * np.sqrt(np.square(place).mean()), 1e3 * np.median(np.linalg.norm(place, axis=1)),
        100 * np.median(np.abs(force)), 100 * np.median(np.abs(peak)), 100 * np.mean(within),
        100 * np.mean(covered), 100 * interval.low, 100 * interval.high, 1e6 * np.median(area),
    )  # fmt: skip
    return figures | dict(zip(names, map(float, values), strict=False))


def main(words: Sequence[str]) -> None:
    """Run the rows and write contact.csv."""
    defaults = {"touches": "2500", "rows": "", "out": str(ROOT / "docs/results"), "seed": "0"}
    settings = script_settings(words, defaults)
    begins = tuple(settings["rows"].split(","))
    chosen = [row for row in rows() if row.name.startswith(begins)]
    if not chosen:
        raise InputError(f"rows={settings['rows']} begins no row: {', '.join(row.name for row in rows())}")
    torch.set_num_threads(1)
    lines = list[Mapping[str, object]]()
    for row in chosen:
        count = int(settings["touches"]) // (1 if row.number == 1 else 4)
        lines.append(run_row(row, count, int(settings["seed"])))
        print(*(f"{k}={_text(v)}" for k, v in lines[-1].items()), flush=True)
    table = [[*lines[0]], *([*map(_text, line.values())] for line in lines)]
    print(write(csv_text(table), Path(settings["out"]) / "contact.csv"))


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    run_script(main)
