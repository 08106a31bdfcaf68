"""How well gains are known after a calibration without a gauge, and what an alarm then does.

Every device has other gains, positions and moduli than the calibration supposes, and the pressure below a
base is uneven.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from annotated_types import Ge
from hydra.utils import instantiate
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from experiments.studies.measures import Subject
from experiments.studies.pages import Page
from skin.calibration.bench import BenchSession
from skin.calibration.bench_protocol import Protocol
from skin.calibration.known_loads import KnownLoad, emulate_placements, fit_known_load
from skin.device.simulated import Simulated
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold
from skin.evaluation.metrics import compute_metrics
from skin.plot.figures import COLOURS
from skin.touch.shapes import Shapes

WEIGHT = KnownLoad(2.0, 0.02)
ROUNDS = {"weight once": 1, "weight twice": 2, "weight four times": 4}
"""Procedure -> how often the weight is on each sensor."""

_ALARMED = "weight once"


def make_skin(subject: Subject, seed: int | None = None, **settings: Any) -> Simulated:
    """Return the nominal device, or with a seed one that differs in positions, moduli and gains."""
    body = instantiate(subject.config.body)
    if seed is not None:
        draw = np.random.default_rng([seed, 1])
        softness = [draw.uniform(0.8, 1.2) for _ in body.layers]
        layers = tuple(
            replace(layer, material=replace(layer.material, young=layer.material.young * factor))
            for layer, factor in zip(body.layers, softness, strict=True)
        )
        body = replace(body, layers=layers)
        errors: dict[str, Any] = {"gain_spread": 0.3, "noise": 0.1, "dead": 1, "position_error": 0.002}
        settings = {"seed": seed} | errors | settings
    layout, simulator = instantiate(subject.config.layout), instantiate(subject.config.simulator)
    return Simulated(body=body, layout=layout, simulator=simulator, **settings)


def weight_pressure(skin: Simulated, rounds: int, draw: np.random.Generator) -> torch.Tensor:
    """Return the uneven pressures (P, H, W), Pa, of a weight on every sensor of the layout, in any order."""
    order = np.concatenate([draw.permutation(len(skin.sensors)) for _ in range(rounds)])
    margin, count = WEIGHT.base, len(order)
    positions = np.clip(skin.sensors.positions[order, :2], margin, np.array(skin.size) - margin)
    shapes = Shapes(["disc"], skin.body)
    scale = np.full(count, WEIGHT.base / (np.ptp(shapes.hulls[0], axis=0).max() / 2))
    images = shapes.render(np.zeros(count, dtype=int), np.zeros(count), scale, positions)
    pressure = WEIGHT.force * images / float(np.prod(skin.body.cell))
    # Random factors, 10 % rms, that change over 10 mm; the force stays.
    cells = 0.01 / np.array(skin.body.cell)[::-1]
    waves = np.stack([gaussian_filter(draw.standard_normal(skin.body.shape), cells) for _ in pressure])
    waves *= 0.1 / waves.std(axis=(1, 2), keepdims=True)
    rough = pressure * torch.from_numpy(np.exp(waves)).float()
    return rough * (pressure.sum((1, 2), keepdim=True) / rough.sum((1, 2), keepdim=True))


@torch.no_grad()
def record(device: Simulated, procedure: str, seed: int) -> BenchSession:
    """Return the session of a device under a procedure."""
    draw = np.random.default_rng([100 * seed + list(ROUNDS).index(procedure), 2])
    pressures = weight_pressure(device, ROUNDS[procedure], draw)
    readings = torch.cat([device.model(part).readings for part in pressures.split(16)]).double().numpy()
    return emulate_placements(device, readings, Protocol(idle=10.0, rest=2.0), draw)


@dataclass(frozen=True)
class KnownLoadGains:
    """Errors of the gains after each procedure, % over the sensors of all devices.

    Args:
        devices: simulated devices.
    """

    devices: Annotated[int, Ge(1)] = 10

    def __call__(self, subject: Subject) -> pd.DataFrame:
        nominal, parts = make_skin(subject), []
        for seed in range(self.devices):
            device = make_skin(subject, seed)
            working = ~device.constants.dead.numpy()
            for procedure in ROUNDS:
                session = record(device, procedure, seed)
                gains = fit_known_load(nominal, session, WEIGHT).calibration.known("gain")
                ratio = (gains / device.constants.gain.numpy())[working]
                parts.append(pd.DataFrame({"procedure": procedure, "device": seed, "ratio": ratio}))
                if seed == 0 and procedure == _ALARMED:
                    drawn = _shown(session, gains[working], device.constants.gain.numpy()[working])
        sensors = pd.concat(parts)
        sensors["scale"] = sensors.groupby(["procedure", "device"]).ratio.transform("median")
        rows = [
            {"skin": subject.condition, "procedure": name, "devices": self.devices} | _errors(group)
            for name, group in sensors.groupby("procedure", sort=False)
        ]
        frame = pd.DataFrame(rows)
        frame.attrs["drawn"] = drawn
        return frame

    def page(self, frame: pd.DataFrame, title: str) -> Page:
        """Return the rows, and of one skin a figure of a session with a weight."""
        return Page("", {}, frame, _draw(frame.attrs["drawn"]) if frame.skin[0] == "default, solid" else None)


def _errors(sensors: pd.DataFrame) -> dict[str, float]:
    """Return rms errors of gains, of gains over the median of the device, and of that median, %."""
    known = sensors.dropna()
    scales = known.groupby("device").scale.first()
    samples = {"gain": known.ratio, "relative": known.ratio / known.scale, "scale": scales}
    errors = {
        f"{name}_rms_percent": round(100 * float(np.sqrt(np.mean((sample - 1) ** 2))), 2)
        for name, sample in samples.items()
    }
    median = round(100 * float(np.median(scales) - 1), 2)
    return errors | {"scale_median_percent": median, "without_gain": len(sensors) - len(known)}


@dataclass(frozen=True)
class KnownLoadAlarms:
    """Accuracy and alarms of ``any_skin``, windows of the model, for every way to correct the gains.

    The threshold lets 2 % of the safe touches of the nominal skin raise the alarm.

    Args:
        devices: simulated devices.
        touches: test touches of every device.
    """

    devices: Annotated[int, Ge(1)] = 10
    touches: Annotated[int, Ge(16)] = 1000

    def __call__(self, subject: Subject) -> pd.DataFrame:
        quiet: dict[str, Any] = {"noise": 0.05, "tare": True}
        nominal = make_skin(subject, gain_spread=0.02, **quiet)
        model, rows = subject.load("any_skin"), []
        source = AlarmSource("any_skin", model.config.evaluation, model.learner, device=nominal)
        point = choose_alarm_threshold(source, anew=True)
        for seed in range(self.devices):
            device = make_skin(subject, seed, test_gestures=self.touches, **quiet)
            measured, true = device.touches("test"), device.constants.gain
            gains = {"not corrected": torch.ones_like(true), "true gains": true}
            session = record(make_skin(subject, seed), _ALARMED, seed)
            fitted = fit_known_load(nominal, session, WEIGHT).calibration
            gains[_ALARMED] = torch.from_numpy(fitted.known("gain")).float()
            for name, gain in gains.items():
                touches = replace(measured, readings=measured.readings / gain, geometry=nominal.geometry)
                probabilities = model.learner.probabilities(touches)
                metrics = compute_metrics(probabilities, measured.known_labels, nominal.task, point)
                rows.append({"correction": name} | metrics)
        names = ["overall/accuracy", "dangerous/alarm_recall", "dangerous/false_alarm_rate"]
        means = (100 * pd.DataFrame(rows).groupby("correction", sort=False)[names].mean()).round(2)
        means.insert(0, "devices", self.devices)
        means.insert(1, "touches", self.touches)
        return means.reset_index()


def _shown(session: BenchSession, gains: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    """Return the readings of the six strongest sensors, N, for 45 s, and the gains, of the figure."""
    part = session.time < 45.0
    strongest = np.argsort(-np.nanmax(session.raw[part], axis=0))[:6]
    readings = {f"sensor {number}": session.raw[part, number].tolist() for number in strongest}
    gain_pairs = [true.tolist(), gains.tolist()]
    return {"time": session.time[part].tolist(), "readings": readings, "gains": gain_pairs}


def _draw(drawn: Mapping[str, Any]) -> Figure:
    """Draw a session of a weight on a device, and its gains over the true ones."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    trace, scatter = figure.subplots(1, 2, width_ratios=[2, 1])
    for name, readings in drawn["readings"].items():
        trace.plot(drawn["time"], readings, linewidth=0.7, label=name)
    trace.set(xlabel="time, s", ylabel="reading, N", title="2 kg put on one sensor after the other")
    trace.legend(fontsize=8, ncols=2)
    true, estimated = drawn["gains"]
    ends = [min(true) * 0.9, max(true) * 1.1]
    scatter.plot(ends, ends, color="grey", linewidth=0.8)
    scatter.plot(true, estimated, "o", markersize=4, color=COLOURS[0])
    scatter.set(xlabel="true gain", ylabel="gain from the weight", title=f"{len(true)} working sensors")
    return figure
