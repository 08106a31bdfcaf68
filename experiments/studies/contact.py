"""Measure the posterior of contacts on skins that nothing was tuned on, against its targets.

    python -m experiments.studies.contact
    python -m experiments.studies.contact touches=200 rows=deep,thin out=FOLDER

Writes contact.csv into docs/results, or into ``out=``. ``rows=``: only rows whose name begins so. Touches
that raise no sensor above three standard deviations of a frame are left out.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path

import numpy as np
import torch

from experiments import run_script, script_settings
from experiments.studies.pages import csv_text
from skin.body.base import AbstractBody, Layer, Sensors, Sheet
from skin.body.layout import AbstractLayout, Grid, Hexagonal, Random
from skin.body.material import Material
from skin.core.files import ROOT, write
from skin.errors import InputError
from skin.inference.candidates import FingertipPrior, disc_readings
from skin.inference.noise import Noise
from skin.inference.posterior import FrameEstimate, Posterior
from skin.mechanics.simulator.solid import Solid
from skin.touch.gesture import GestureSettings
from skin.touch.shapes import Shapes, draw_bodies

SIZE, CELLS = (0.16, 0.16), (32, 32)
POISSON = {"Dragon Skin 10 Medium": 0.49}
FELT = 3.0  # standard deviations of a frame


def make_sheet(*layers: tuple[str, float], softer: float = 1.0) -> Sheet:
    """Return a sheet of materials and thicknesses, m, from the base up; moduli by a factor."""
    made = [(Material.of(name), thickness) for name, thickness in layers]
    return Sheet(
        SIZE,
        CELLS,
        tuple(Layer(replace(material, young=material.young * softer), thick) for material, thick in made),
    )


DEEP = make_sheet(("EcoFlex 00-30", 0.03))
THIN = make_sheet(("Dragon Skin 10 Medium", 0.01), ("EcoFlex 00-30", 0.005))
_FOOTPRINT = (0.01, 0.01)
GRID = Grid(5, 5, _FOOTPRINT)


@dataclass(frozen=True)
class Row:
    """Touches of a kind on a skin.

    Attributes:
        name: of the row.
        body, layout: the skin.
        depth: of the sensors, m; None: that of the layout.
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
    depth: float | None = 0.0295
    force: float = 5.0
    noise: Noise = field(default_factory=lambda: Noise(0.05, 10))
    number: int = 1
    margin: float = 0.03
    apart: float = 0.0
    exactly: bool = False
    actual: Sheet | None = None

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in a body."""
        sensors = self.layout.sensors(body)
        if self.depth is None:
            return sensors
        places = sensors.positions.copy()
        places[:, 2] = self.depth
        return Sensors(places, sensors.footprint)


def rows() -> list[Row]:
    """Return all rows of the table."""
    thin = Row("thin", body=THIN, depth=None, margin=0.0)
    clipped = Noise(0.05, 10, clip=10.0)
    device = Noise(0.05, 10, gain=0.02, position=0.001)
    layouts = {
        "16": Grid(4, 4, _FOOTPRINT),
        "64": Grid(8, 8, _FOOTPRINT),
        "hexagonal": Hexagonal(5, 5, _FOOTPRINT),
        "random": Random(25, 1, _FOOTPRINT),
        "random_30": Random(30, 2, _FOOTPRINT),
    }
    return [
        Row("deep"),
        Row("deep_whole", margin=0.0),
        thin,
        replace(thin, name="thin_20N", force=20.0, noise=clipped),
        replace(thin, name="thin_inner", margin=0.03),
        replace(thin, name="thin_inner_20N", margin=0.03, force=20.0, noise=clipped),
        *(Row(f"layout_{name}", layout=layout, margin=0.0) for name, layout in layouts.items()),
        *(Row(f"device_{number}", noise=device, margin=0.0) for number in range(1, 6)),
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
    size = np.array(SIZE)
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


def press_hands(simulator: Solid, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the readings (count, S), N, of hands and bars of the default gestures."""
    settings = GestureSettings(shapes=("bar", "hand"))
    shapes = Shapes(settings.shapes, THIN)
    drawn = draw_bodies(rng.random(count) < 0.5, settings, shapes, rng)
    room = np.array(SIZE) - settings.spare - (drawn["high"] - drawn["low"])
    place = settings.spare / 2 - drawn["low"] + room * rng.random((count, 2))
    frames = shapes.render(drawn["shape"], drawn["angle"], drawn["scale"], place, drawn["stretch"])
    peak = torch.from_numpy(rng.uniform(10e3, 180e3, count)).float()[:, None, None]
    with torch.no_grad():
        return simulator(frames / frames.amax((1, 2), keepdim=True) * peak).readings.numpy().astype(float)


def read_device(readings: np.ndarray, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Return what a device with gains of its own measures, (B, S), N."""
    gain = 1 + noise.gain * rng.standard_normal(readings.shape[1])
    return gain * readings + np.sqrt(noise.floor) * rng.standard_normal(readings.shape)


def displaced(sensors: Sensors, noise: Noise, rng: np.random.Generator) -> Sensors:
    """Return the sensors where they really are."""
    shift = noise.position * rng.standard_normal((len(sensors), 2))
    return Sensors(sensors.positions + np.pad(shift, ((0, 0), (0, 1))), sensors.footprint)


def run_row(row: Row, count: int, seed: int) -> dict[str, object]:
    """Return the figures of a row."""
    rng = np.random.default_rng([seed, *row.name.encode()])
    sensors, actual = row.sensors(row.body), row.actual or row.body
    real = displaced(row.sensors(actual), row.noise, rng)
    real = Sensors(np.minimum(real.positions, [*SIZE, actual.thickness - 1e-6]), real.footprint)
    touched = Solid(actual, real, poisson=POISSON)
    prior = FingertipPrior(force=row.force)
    posterior = Posterior(Solid(row.body, sensors, poisson=POISSON), row.noise, row.body, prior)
    if row.number:
        contacts = draw_contacts(row, 3 * count, rng)
        flat = contacts.reshape(-1, 4)
        felt = disc_readings(touched, actual, flat[:, :3], prior.rim) * flat[:, 3:]
        true = felt.reshape(*contacts.shape[:2], -1).sum(1)
    else:
        true = press_hands(touched, count, rng)
        contacts = np.zeros((count, 0, 4))
    chosen = np.flatnonzero((true > FELT * row.noise.frame).any(1))[:count]
    readings = read_device(true[chosen], row.noise, rng)
    estimates, seconds = list[FrameEstimate](), list[float]()
    for values in readings:
        start = time.process_time()
        estimate = posterior.estimate(values)
        seconds.append(time.process_time() - start)
        assert isinstance(estimate, FrameEstimate)
        estimates.append(estimate)
    return {"row": row.name} | summarise_estimates(estimates, contacts[chosen], prior) | {
        "ms_median": 1e3 * float(np.median(seconds)),
        "ms_p99": 1e3 * float(np.quantile(seconds, 0.99)),
    }  # fmt: skip


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
    names = ("rms_mm", "median_mm", "force_median_%", "peak_median_%", "covered_%", "area_median_mm2")
    if not number or not right:
        return figures | dict.fromkeys(names, "")
    place, force, peak, covered, area = [], [], [], [], []
    for row in right:
        found = estimates[row].contacts
        away = np.array([[np.sum((c.place - t[:2]) ** 2) for t in contacts[row]] for c in found])
        order = min(permutations(range(number)), key=lambda p: sum(away[k, p[k]] for k in range(number)))
        for contact, index in zip(found, order, strict=True):
            truth = contacts[row, index]
            region = contact.region()
            place.append(contact.place - truth[:2])
            force.append(contact.force / truth[3] - 1)
            peak.append(contact.peak / (truth[3] * prior.peak(truth[2])) - 1)
            covered.append(region.contains(truth[:2]))
            area.append(region.area)
    distance = np.linalg.norm(place, axis=1)
    values = (
        1e3 * np.sqrt(np.square(place).mean()), 1e3 * np.median(distance),
        100 * np.median(np.abs(force)), 100 * np.median(np.abs(peak)),
        100 * np.mean(covered), 1e6 * np.median(area),
    )  # fmt: skip
    return figures | dict(zip(names, map(float, values), strict=True))


def main(words: Sequence[str]) -> None:
    """Run the rows and write contact.csv."""
    defaults = {"touches": "2000", "rows": "", "out": str(ROOT / "docs/results"), "seed": "0"}
    settings = script_settings(words, defaults)
    begins = tuple(settings["rows"].split(","))
    chosen = [row for row in rows() if row.name.startswith(begins)]
    if not chosen:
        raise InputError(f"rows={settings['rows']} begins no row: {', '.join(row.name for row in rows())}")
    torch.set_num_threads(1)
    lines = list[dict[str, object]]()
    for row in chosen:
        lines.append(run_row(row, int(settings["touches"]), int(settings["seed"])))
        print(*(f"{k}={_text(v)}" for k, v in lines[-1].items()), flush=True)
    table = [[*lines[0]], *([*map(_text, line.values())] for line in lines)]
    print(write(csv_text(table), Path(settings["out"]) / "contact.csv"))


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    run_script(main)
