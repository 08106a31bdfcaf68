"""Measures of simulated devices: alarms of touches, time to an alarm, and calibrations without a gauge."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from annotated_types import Ge, Gt
from hydra.utils import instantiate
from scipy.ndimage import gaussian_filter
from scipy.stats import binomtest

from experiments.studies.measures import Subject
from skin.calibration.bench import BenchSession
from skin.calibration.known_loads import GRAVITY, KnownLoad, emulate_placements, fit_known_load
from skin.core.rng import Stream, generator
from skin.device.resampling import Frame
from skin.device.simulated import Simulated
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.guarantee import MARGIN, counted
from skin.evaluation.metrics import compute_metrics
from skin.evaluation.operating_point import LABEL, OperatingPoint
from skin.evaluation.touch_scores import decide_touches
from skin.live.engine import DebounceSettings, Engine
from skin.live.engine_builder import engine_settings
from skin.runs.build import TorchModel, build_device, load_model
from skin.runs.configuration import recompose
from skin.touch.labels import TOUCH
from skin.touch.shapes import Shapes
from skin.wire.channels import UnitConversion
from skin.wire.emulator import gestures_with_labels, upsample


@dataclass(frozen=True)
class TouchAlarms:
    """Alarms per touch, as the live view raises them, and dangerous touches without one.

    The threshold is chosen on other touches than those that are counted, as ``evaluation`` says. Rates are
    given with exact 95 % intervals: of false alarms, of all safe touches and of those below 0.9 times the
    limit (``clear_false_alarm``); of safe touches whose danger is unknown; of missed touches above 1.1 times
    the limit, of the big and small ones, and of those that are on a sensor (``failure``).

    Args:
        safe: number of safe touches that are counted.
        dangerous: largest number of touches above 1.1 times the limit and on a sensor.
        seed: of the touches that are counted; it must differ from those of training and thresholds.
        actual: overrides of the device that is counted; the threshold does not know them.
    """

    safe: Annotated[int, Ge(1)] = 10000
    dangerous: Annotated[int, Ge(1)] = 2000
    seed: Annotated[int, Ge(0)] = 1_000_003
    actual: Sequence[str] = ()

    def __call__(self, subject: Subject) -> pd.DataFrame:
        run = subject.trained.run
        assert run is not None
        model, purpose = load_model(run, subject.config), "touches are simulated"
        device = subject.device.simulated(purpose)
        counts = build_device(recompose(subject.config, self.actual)).simulated(purpose)
        live, point = _choose_point(subject, model, float(np.ravel(device.rate)[0]))
        # A few more, because not all of them are on a sensor and far above the limit.
        drawn = max(self.safe, self.dangerous * 5 // 4)
        labels = counts.sampler.balanced(2 * drawn, generator(Stream.TEST, 7))
        danger = labels[:, TOUCH.names.index(LABEL)]
        kinds = np.flatnonzero(~danger)[: self.safe], np.flatnonzero(danger)[: self.dangerous * 5 // 4]
        labels, safe = labels[np.concatenate(kinds)], ~danger[np.concatenate(kinds)]
        known = point.score, point.threshold
        touches = decide_touches(model.learner, counts, live, labels, self.seed, enough=known)
        alarms, peak = point.alarm(touches.scores(point.score)).numpy(), touches.peak.numpy()
        likely = (touches._replace(row=1).scores(point.score) > 0.5).numpy()
        above, big = peak > MARGIN, labels[:, TOUCH.names.index("big")]
        groups = {
            "failure": ~alarms[counted(peak, touches.sensed.numpy())][: self.dangerous],
            "missed": ~alarms[above],
            "missed_big": ~alarms[above & big],
            "missed_small": ~alarms[above & ~big],
            "unknown": (likely & ~alarms)[safe],
            "false_alarm": alarms[safe],
            "clear_false_alarm": alarms[peak < 2 - MARGIN],
        }
        metrics = {"touch/threshold": point.threshold, "touch/recall": alarms[~safe].mean()}
        for name, those in groups.items():
            rates = those.mean(), *binomtest(int(those.sum()), len(those)).proportion_ci()
            ends = zip(("rate", "low", "high"), rates, strict=True)
            metrics |= {f"touch/{name}_{kind}": value for kind, value in ends}
        frame = pd.DataFrame([metrics])
        found = ", ".join(f"{name} {those.sum()} of {len(those)}" for name, those in groups.items())
        frame.attrs["about"] = f"{subject.condition}: {point.sentence()}\n{found}"
        return frame


def _choose_point(subject: Subject, model: TorchModel, rate: float) -> tuple[LiveConditions, OperatingPoint]:
    """Return the conditions of the live view of a device at ``rate``, Hz, and its threshold, chosen anew."""
    device = subject.device.simulated("touches are simulated")
    live = model.live_conditions(rate, DebounceSettings().alarm, rate <= device.model_rate)
    source = AlarmSource("this run", subject.config.evaluation, model.learner, device=device)
    point = choose_alarm_threshold(source, live, anew=True)
    assert point is not None  # it has the label
    return live, point


# Time to the alarm: dangerous touches of many courses pass an engine, frame by frame.

_SEGMENTS = count()  # of the device's clock: every touch begins with an empty window


@dataclass(frozen=True)
class Holds:
    """Delay of the alarm, and whether it persists during a held press, by the engine of ``skin live``.

    The columns are: the course; the numbers of touches, of those with an alarm, with an alarm kept to the
    end, and with an alarm before the touch; median and 95th percentile of the time to the alarm, and median
    of the time from the end of the touch to the end of the alarm, s, as texts, empty without an alarm.

    Args:
        courses: name -> times, s, and the load then; None: the gesture as it is. Only ``tap`` is a tap.
        gestures: number of touches of each course; a tenth of it of those of a minute and more.
        rate: of the device, Hz.
        touch: as ``live.touch``, N.
        drift: as ``live.drift``, N in ten minutes.
    """

    courses: Mapping[str, Sequence[Sequence[float]] | None]
    gestures: Annotated[int, Ge(1)] = 40
    rate: Annotated[float, Gt(0)] = 100.0
    touch: Annotated[float, Gt(0)] | None = None
    drift: Annotated[float, Ge(0)] = 0.2

    def __call__(self, subject: Subject) -> pd.DataFrame:
        trained, rows = subject.trained.run, list[dict[str, Any]]()
        assert trained is not None
        model = load_model(trained, subject.config)
        point = _choose_point(subject, model, self.rate)[1]
        debounce = DebounceSettings(above=point.threshold)
        engine = engine_settings(model, debounce, self.touch, self.drift, point.score)
        device = model.device.simulated("held touches are simulated").replace(stream=False)
        for course, load in self.courses.items():
            number = max(1, self.gestures // 10) if load and load[0][-1] >= 60 else self.gestures
            forces = dangerous_touches(device, number, course == "tap", load)
            played = (play_touch(engine, device, force, self.rate, n) for n, force in enumerate(forces))
            timings = pd.DataFrame(played)
            raised, counts = timings.raised, {"touches": len(timings), "alarms": timings.raised.count()}
            counts |= timings[["kept", "early"]].sum().to_dict()
            times = {"median_s": raised.median(), "p95_s": raised.quantile(0.95)}
            times["cleared_s"] = timings.cleared.median()
            texts = {name: "" if np.isnan(time) else f"{time:.2f}" for name, time in times.items()}
            rows.append({"course": course} | counts | texts)
        frame = pd.DataFrame(rows)
        lines = (
            ", ".join(f"{name} {value}" for name, value in row.items() if value)
            for row in frame.to_dict("records")
        )
        frame.attrs["about"] = "\n".join(lines)
        return frame


class AlarmTiming(NamedTuple):
    """Timing of the alarm for one dangerous touch.

    Attributes:
        raised: s from the first force to the alarm; NaN without an alarm.
        kept: the alarm lasted until the end of the force.
        cleared: s from the end of the force to the end of the alarm; NaN without an alarm or its end.
        early: an alarm was raised before the touch.
    """

    raised: float
    kept: bool
    cleared: float
    early: bool


def dangerous_touches(
    device: Simulated, number: int, tap: bool, load: Sequence[Sequence[float]] | None, seed: int = 0
) -> Iterator[np.ndarray]:
    """Yield the true readings (T, S), N, of dangerous static touches at the model's rate.

    Args:
        device: source of the gestures, which are not used for training.
        number: of touches; half of them are big.
        tap: whether they are taps, else presses.
        load: times, s, and the fraction of the strongest frame that presses then; None: the gesture itself.
        seed: of the gestures.
    """
    labels = {"dynamic": 0, "press": int(not tap), "dangerous": 1}
    names = [name for name in device.task.names if name in (*labels, "big")]
    rows = [[index % 2 if name == "big" else labels[name] for name in names] for index in range(number)]
    for gesture in gestures_with_labels(device, np.array(rows), seed):
        if load is None:
            yield gesture.force
            continue
        strongest = gesture.force[gesture.force.sum(axis=1).argmax()]
        course = np.interp(np.arange(0.0, 2000.0, 1 / device.model_rate), load[0], load[1])
        yield course[: np.flatnonzero(course)[-1] + 2, None] * strongest


def play_touch(
    engine: Engine,
    device: Simulated,
    force: np.ndarray,
    rate: float,
    seed: int = 0,
    around: tuple[float, float] = (4.0, 5.0),
) -> AlarmTiming:
    """Feed a touch to an engine frame by frame; return the timing of the alarm.

    Args:
        engine: new, or at rest.
        device: measures the touch with its imperfections, after a tare.
        force: true readings, (T, S), N, at the model's rate.
        rate: of the device, Hz.
        seed: of the noise.
        around: duration without touch before and behind it, s.
    """
    idle = [round(seconds * rate) for seconds in around]
    true = np.pad(upsample(force, device.model_rate, rate), (idle, (0, 0)))
    time, constants = np.arange(len(true)) / rate, device.constants
    noise = generator(Stream.NOISE, seed, Stream.TEST, 6)
    given = torch.from_numpy(true)[None].float(), constants, noise, torch.from_numpy(time)
    measured = device.imperfection.raw(*given)[0].double().numpy()
    dead = constants.dead.numpy()
    conversion = UnitConversion(np.ones(len(dead)), constants.offset.double().numpy(), dead)
    segment = next(_SEGMENTS)
    time = time + 1e4 * segment  # longer than any course: the time of an engine never goes back
    touched = time[true.any(axis=1)]
    begin, end = touched[0], touched[-1]  # which are one frame, in a short tap
    engine.reset()
    rows = enumerate(zip(time.tolist(), measured, strict=True))
    frames = (conversion.convert(Frame(number, t, t, row, ~dead, segment)) for number, (t, row) in rows)
    verdicts = (verdict for frame in frames for verdict in engine.push([frame]))
    alarm = pd.Series({verdict.t: verdict.dangerous for verdict in verdicts}, dtype=bool)
    early, after = bool(alarm[alarm.index < begin].any()), alarm[alarm.index >= begin]
    if not after.any():
        return AlarmTiming(np.nan, False, np.nan, early)
    raised, last = after.idxmax(), alarm[alarm].index[-1]
    cleared = np.nan if last >= alarm.index[-1] else max(0.0, last - end)
    kept = bool(alarm[(alarm.index >= raised) & (alarm.index <= end)].all())
    return AlarmTiming(float(raised - begin), kept, cleared, early)


# How well gains are known after a calibration without a gauge, and what an alarm then does. Every device has
# other gains, positions and moduli than the calibration supposes, and the pressure below a base is uneven.

WEIGHT = KnownLoad(2.0, 0.02)
ROUNDS = {"weight once": 1, "weight twice": 2, "weight four times": 4}
"""Procedure -> how often the weight is on each sensor."""

_ALARMED = next(iter(ROUNDS))


def make_skin(subject: Subject, seed: int | None = None, **settings: Any) -> Simulated:
    """Return the nominal device, or with a seed one that differs in positions, moduli and gains."""
    body = instantiate(subject.config.body)
    if seed is not None:
        softness = np.random.default_rng([seed, 1]).uniform(0.8, 1.2, len(body.layers)).tolist()
        layers = tuple(
            replace(layer, material=replace(layer.material, young=layer.material.young * factor))
            for layer, factor in zip(body.layers, softness, strict=True)
        )
        body = replace(body, layers=layers)
        errors = {"seed": seed, "gain_spread": 0.3, "noise": 0.1, "dead": 1, "position_error": 0.002}
        settings = errors | settings
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
    pressure = GRAVITY * WEIGHT.weight * images / float(np.prod(skin.body.cell))
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
    return emulate_placements(device, readings, draw, idle=10.0)


@dataclass(frozen=True)
class KnownLoadGains:
    """Errors of the gains after each procedure, % over the sensors of all devices.

    Args:
        devices: simulated devices.
    """

    devices: Annotated[int, Ge(1)] = 10

    def __call__(self, subject: Subject) -> pd.DataFrame:
        nominal, parts = make_skin(subject), list[pd.DataFrame]()
        for seed in range(self.devices):
            device = make_skin(subject, seed)
            working = ~device.constants.dead.numpy()
            true = device.constants.gain.numpy()[working]
            for procedure in ROUNDS:
                session = record(device, procedure, seed)
                gains = fit_known_load(nominal, session, WEIGHT).known("gain")[working]
                parts.append(pd.DataFrame({"procedure": procedure, "device": seed, "ratio": gains / true}))
        sensors = pd.concat(parts)
        sensors["scale"] = sensors.groupby(["procedure", "device"]).ratio.transform("median")
        rows = [
            {"skin": subject.condition, "procedure": name, "devices": self.devices} | _errors(group)
            for name, group in sensors.groupby("procedure", sort=False)
        ]
        return pd.DataFrame(rows)


def _errors(sensors: pd.DataFrame) -> dict[str, float]:
    """Return rms errors of gains, of gains over the median of the device, and of that median, %."""
    known = sensors.dropna()
    scales = known.groupby("device").scale.first()
    samples = {"gain": known.ratio, "relative": known.ratio / known.scale, "scale": scales}
    errors = {
        f"{name}_rms_percent": round(100 * float(np.sqrt(np.mean((sample - 1) ** 2))), 2)
        for name, sample in samples.items()
    }
    errors["scale_median_percent"] = round(100 * float(np.median(scales) - 1), 2)
    return errors | {"without_gain": len(sensors) - len(known)}


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
        nominal, model, rows = make_skin(subject, gain_spread=0.02, **quiet), subject.load("any_skin"), []
        source = AlarmSource("any_skin", model.config.evaluation, model.learner, device=nominal)
        point = choose_alarm_threshold(source, anew=True)
        for seed in range(self.devices):
            device = make_skin(subject, seed, test_gestures=self.touches, **quiet)
            measured, true = device.touches("test"), device.constants.gain
            session = record(make_skin(subject, seed), _ALARMED, seed)
            fitted = fit_known_load(nominal, session, WEIGHT).known("gain")
            gains = {"not corrected": torch.ones_like(true), "true gains": true}
            gains[_ALARMED] = torch.from_numpy(fitted).float()
            for name, gain in gains.items():
                touches = replace(measured, readings=measured.readings / gain, geometry=nominal.geometry)
                probabilities = model.learner.probabilities(touches)
                metrics = compute_metrics(probabilities, measured.known_labels, nominal.task, point)
                rows.append({"correction": name} | metrics)
        names = ["overall/accuracy", "dangerous/alarm_recall", "dangerous/false_alarm_rate"]
        means = (100 * pd.DataFrame(rows).groupby("correction", sort=False)[names].mean()).round(2)
        counted = means.assign(devices=self.devices, touches=self.touches)
        return counted[["devices", "touches", *names]].reset_index()
