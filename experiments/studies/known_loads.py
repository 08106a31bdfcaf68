"""How well gains are known after a calibration without a gauge, and what an alarm then does.

    python -m experiments.studies.known_loads                       # gains
    python -m experiments.studies.known_loads alarm=true            # and any_skin on such devices

Writes known_loads.csv to the folder out=, results by default. Every device has other gains, positions and
moduli than the calibration supposes, and the pressure below a base is uneven.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from scipy.ndimage import gaussian_filter

from experiments import run_script
from experiments.studies.pages import csv_text
from skin.body.base import Layer, Sheet
from skin.body.layout import Grid
from skin.body.material import Material
from skin.core.files import write
from skin.core.settings import checked, configured
from skin.device.calibration import Calibration
from skin.device.simulated import Simulated
from skin.hardware.bench import BenchSession
from skin.hardware.bench_protocol import Protocol
from skin.hardware.known_loads import KnownLoad, emulate_placements, fit_known_load
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.solid import Solid
from skin.plot.figures import COLOURS, save_figure
from skin.touch.shapes import Shapes

WEIGHT = KnownLoad(2.0, 0.02)
SOLID = partial(Solid, poisson={"Dragon Skin 10 Medium": 0.49})
DEFAULT = (("Dragon Skin 10 Medium", 560e3, 0.010), ("EcoFlex 00-30", 170e3, 0.005))
LAYER = (("EcoFlex 00-30", 170e3, 0.030),)
SKINS: Mapping[str, tuple[Any, Any]] = {
    "default, fem": (DEFAULT, PlatesAndBeams),
    "default, solid": (DEFAULT, SOLID),
    "30 mm layer, solid": (LAYER, SOLID),
}
PROCEDURES = {"weight once": 1, "weight twice": 2, "weight four times": 4}
POSITION, MODULUS, UNEVEN, GAINS, NOISE = 0.002, 0.2, 0.1, 0.3, 0.1
_ALARMED = "weight once"
_SHOWN, _DRAWN = 45.0, 6  # s and sensors of the figure
_WAVE = 0.01  # m, over which the pressure changes
_PROTOCOL = Protocol(idle=10.0, rest=2.0)


@checked("known_loads")
@dataclass(frozen=True)
class Settings:
    """Settings of the command line.

    Attributes:
        devices: simulated devices for every skin.
        alarm: also evaluate ``any_skin`` on the devices, as they are and calibrated.
        touches: test touches of every device, for the alarm.
        out: folder of the results.
    """

    devices: Annotated[int, Ge(1)] = 10
    alarm: bool = False
    touches: Annotated[int, Ge(16)] = 1000
    out: str = "results"


def make_skin(layers: Any, simulator: Any, **settings: Any) -> Simulated:
    """Return a device on a sheet of these layers (material, Pa, m)."""
    entries = tuple(Layer(replace(Material.of(name), young=young), thick) for name, young, thick in layers)
    body = Sheet((0.16, 0.16), (32, 32), entries)
    return Simulated(body=body, layout=Grid(5, 5), simulator=simulator, **settings)


def draw_device(layers: Any, simulator: Any, seed: int, **settings: Any) -> Simulated:
    """Return a device whose positions, moduli and gains differ from the nominal ones."""
    draw = np.random.default_rng([seed, 1])
    other = [(name, young * draw.uniform(1 - MODULUS, 1 + MODULUS), thick) for name, young, thick in layers]
    errors: dict[str, Any] = {"gain_spread": GAINS, "noise": NOISE, "dead": 1, "position_error": POSITION}
    return make_skin(other, simulator, seed=seed, **errors | settings)


def uneven_pressure(skin: Simulated, pressure: torch.Tensor, draw: np.random.Generator) -> torch.Tensor:
    """Return pressures (P, H, W), Pa, with random factors and the same force."""
    cells = _WAVE / np.array(skin.body.cell)[::-1]
    waves = np.stack([gaussian_filter(draw.standard_normal(skin.body.shape), cells) for _ in pressure])
    waves *= UNEVEN / waves.std(axis=(1, 2), keepdims=True)
    rough = pressure * torch.from_numpy(np.exp(waves)).float()
    return rough * (pressure.sum((1, 2), keepdim=True) / rough.sum((1, 2), keepdim=True))


def weight_pressure(skin: Simulated, rounds: int, draw: np.random.Generator) -> torch.Tensor:
    """Return the pressures of a weight on every sensor of the layout, in any order, by hand."""
    order = np.concatenate([draw.permutation(len(skin.sensors)) for _ in range(rounds)])
    places = skin.sensors.positions[order, :2]
    margin = WEIGHT.base
    places = np.clip(places, margin, np.array(skin.size) - margin)
    shapes = Shapes(["disc"], skin.body)
    scale = WEIGHT.base / (np.ptp(shapes.hulls[0], axis=0).max() / 2)
    count = len(order)
    images = shapes.render(np.zeros(count, dtype=int), np.zeros(count), np.full(count, scale), places)
    return WEIGHT.force * images / float(np.prod(skin.body.cell))


@torch.no_grad()
def record(device: Simulated, rounds: int, seed: int) -> BenchSession:
    """Return a session of a device under placements of the weight."""
    draw = np.random.default_rng([seed, 2])
    pressures = uneven_pressure(device, weight_pressure(device, rounds, draw), draw)
    readings = torch.cat([device.model(part).readings for part in pressures.split(16)]).double().numpy()
    return emulate_placements(device, readings, _PROTOCOL, draw)


def compare_gains(device: Simulated, calibration: Calibration) -> tuple[np.ndarray, int]:
    """Return gain over true gain of the working sensors, and how many of them have none."""
    alive = ~device.constants.dead.numpy()
    gains = np.array([np.nan if gain is None else gain for gain in calibration.sensors["gain"]])
    ratios = (gains / device.constants.gain.numpy())[alive]
    return ratios[np.isfinite(ratios)], int((~np.isfinite(ratios)).sum())


def summarise_gains(skin: str, procedure: str, results: list[tuple[np.ndarray, int]]) -> dict[str, Any]:
    """Return a row: errors over the sensors of all devices, %."""
    ratios = np.concatenate([ratios for ratios, _ in results])
    scales = np.array([np.median(ratios) for ratios, _ in results])
    relative = np.concatenate([ratios / np.median(ratios) for ratios, _ in results])
    return {
        "skin": skin,
        "procedure": procedure,
        "devices": len(results),
        "gain_rms_percent": 100 * float(np.sqrt(np.mean((ratios - 1) ** 2))),
        "relative_rms_percent": 100 * float(np.sqrt(np.mean((relative - 1) ** 2))),
        "scale_rms_percent": 100 * float(np.sqrt(np.mean((scales - 1) ** 2))),
        "scale_median_percent": 100 * float(np.median(scales) - 1),
        "without_gain": sum(missing for _, missing in results),
    }


def measure_gains(settings: Settings) -> Iterator[dict[str, Any]]:
    """Yield a row for every skin and procedure."""
    for name, (layers, simulator) in SKINS.items():
        nominal = make_skin(layers, simulator)
        results: dict[str, list[tuple[np.ndarray, int]]] = {procedure: [] for procedure in PROCEDURES}
        for seed in range(settings.devices):
            device = draw_device(layers, simulator, seed)
            for number, (procedure, rounds) in enumerate(PROCEDURES.items()):
                session = record(device, rounds, 100 * seed + number)
                calibration = fit_known_load(nominal, session, WEIGHT).calibration
                results[procedure].append(compare_gains(device, calibration))
        for procedure in PROCEDURES:
            yield summarise_gains(name, procedure, results[procedure])


def measure_alarms(settings: Settings) -> Iterator[dict[str, Any]]:
    """Yield a row for every way to correct the gains: ``any_skin`` on the default skin, windows of the model.

    The threshold lets 2 % of the safe touches of the nominal skin raise the alarm.
    """
    from skin.evaluation.metrics import compute_metrics
    from skin.evaluation.operating_point import choose_operating_point
    from skin.evaluation.settings import check_evaluation
    from skin.runs.model_of_run import RunModel, load_run

    layers, simulator = SKINS["default, solid"]
    mild: dict[str, Any] = {"noise": 0.05, "tare": True}
    nominal = make_skin(layers, simulator, gain_spread=0.02, **mild)
    model = load_run("any_skin", body=nominal.body, layout=nominal.layout)
    assert isinstance(model, RunModel)
    assert model.config is not None
    learner = model.learner
    point = choose_operating_point(learner, nominal, check_evaluation(model.config.evaluation))
    rows: dict[str, list[dict[str, float]]] = {}
    for seed in range(settings.devices):
        errors: dict[str, Any] = {"test_gestures": settings.touches, **mild}
        device = draw_device(layers, simulator, seed, **errors)
        measured = device.touches("test")
        assert measured.labels is not None
        true = device.constants.gain
        gains = {"not corrected": torch.ones_like(true), "true gains": true}
        noisy = draw_device(layers, simulator, seed)
        session = record(noisy, PROCEDURES[_ALARMED], 100 * seed)
        estimated = fit_known_load(nominal, session, WEIGHT).calibration.known("gain")
        gains[_ALARMED] = torch.from_numpy(estimated).float()
        for name, gain in gains.items():
            touches = replace(measured, readings=measured.readings / gain, geometry=nominal.geometry)
            metrics = compute_metrics(learner.probabilities(touches), measured.labels, nominal.task, point)
            rows.setdefault(name, []).append(metrics)
    for name, metrics_of_devices in rows.items():
        names = ("overall/accuracy", "dangerous/alarm_recall", "dangerous/false_alarm_rate")
        means = {name: 100 * float(np.mean([row[name] for row in metrics_of_devices])) for name in names}
        yield {"correction": name, "devices": settings.devices, "touches": settings.touches, **means}


def draw_weight() -> Figure:
    """Draw a session of a weight on a device, and its gains over the true ones."""
    layers, simulator = SKINS["default, solid"]
    nominal, device = make_skin(layers, simulator), draw_device(layers, simulator, 0)
    session = record(device, 1, 0)
    calibration = fit_known_load(nominal, session, WEIGHT).calibration
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    trace, scatter = figure.subplots(1, 2, width_ratios=[2, 1])
    part = session.time < _SHOWN
    highest = np.nanmax(session.raw[part], axis=0)
    for number in np.argsort(-highest)[:_DRAWN]:
        trace.plot(session.time[part], session.raw[part, number], linewidth=0.7, label=f"sensor {number}")
    trace.set(xlabel="time, s", ylabel="reading, N", title="2 kg put on one sensor after the other")
    trace.legend(fontsize=8, ncols=2)
    alive = ~device.constants.dead.numpy()
    true, estimated = device.constants.gain.numpy()[alive], calibration.known("gain")[alive]
    ends = [min(true) * 0.9, max(true) * 1.1]
    scatter.plot(ends, ends, color="grey", linewidth=0.8)
    scatter.plot(true, estimated, "o", markersize=4, color=COLOURS[0])
    scatter.set(xlabel="true gain", ylabel="gain from the weight", title="24 working sensors")
    return figure


def write_rows(rows: Iterator[dict[str, Any]], path: Path) -> None:
    """Print rows as they come, and write them as CSV, rounded to two digits."""
    whole = []
    for row in rows:
        shown = {name: round(value, 2) if isinstance(value, float) else value for name, value in row.items()}
        print(*shown.values(), sep=", ", flush=True)
        whole.append(shown)
    print(write(csv_text([[*whole[0]], *([*row.values()] for row in whole)]), path))


def main(words: list[str]) -> None:
    """Run what the words ``name=value`` select."""
    given = OmegaConf.to_container(OmegaConf.from_dotlist(words))
    settings = configured(Settings, given, "known_loads")  # type: ignore[arg-type]
    folder = Path(settings.out)
    print(save_figure(draw_weight(), folder / "known_loads.png"))
    write_rows(measure_gains(settings), folder / "known_loads.csv")
    if settings.alarm:
        write_rows(measure_alarms(settings), folder / "known_loads_alarm.csv")


if __name__ == "__main__":
    run_script(main)
