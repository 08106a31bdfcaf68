"""Time to the alarm: dangerous touches of many courses pass an engine, frame by frame."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Annotated, NamedTuple

import numpy as np
import pandas as pd
import torch
from annotated_types import Ge, Gt
from rich.progress import track

from experiments.studies.measures import Subject
from skin.core.rng import Stream, generator
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.live import engine_builder
from skin.live.engine import DebounceSettings, Engine
from skin.wire.channels import UnitConversion
from skin.wire.emulator import gestures_with_labels, upsample

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
        model, rows = subject.reloaded, []
        debounce = DebounceSettings(above=model.threshold)
        engine = engine_builder.engine_settings(model, debounce, self.touch, self.drift)
        device = model.device.simulated("held touches are simulated").replace(stream=False)
        for course, load in self.courses.items():
            number = max(1, self.gestures // 10) if load and load[0][-1] >= 60 else self.gestures
            forces = dangerous_touches(device, number, course == "tap", load)
            steps = track(enumerate(forces), course, number, transient=True)
            timings = [play_touch(engine, device, force, self.rate, n) for n, force in steps]
            rows.append({"course": course} | summarise_timings(timings))
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
    device: AbstractSimulated, number: int, tap: bool, load: Sequence[Sequence[float]] | None, seed: int = 0
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
    device: AbstractSimulated,
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
    idle = [np.zeros((round(seconds * rate), force.shape[1])) for seconds in around]
    true = np.concatenate([idle[0], upsample(force, device.model_rate, rate), idle[1]])
    noise, time = generator(Stream.NOISE, seed, Stream.TEST, 6), np.arange(len(true)) / rate
    imperfection, constants = device.imperfection, device.constants
    given = torch.from_numpy(true)[None].float(), constants, noise, torch.from_numpy(time)
    measured = imperfection.raw(*given)[0].double().numpy()
    dead = constants.dead.numpy()
    conversion = UnitConversion(np.ones(len(dead)), constants.offset.double().numpy(), dead)
    touched = np.flatnonzero(true.any(axis=1))
    segment = next(_SEGMENTS)
    time = time + 1e4 * segment  # longer than any course: the time of an engine never goes back
    begin, end = time[touched[0]], time[touched[-1]]
    engine.reset()
    answers: list[tuple[float, bool]] = []
    for number, (t, row) in enumerate(zip(time.tolist(), measured, strict=True)):
        frame = Frame(number, t, t, row, ~dead, segment)
        verdicts = engine.push([conversion.convert(frame)])
        answers += [(verdict.t, verdict.dangerous) for verdict in verdicts]
    return _outcome(pd.Series(dict(answers), dtype=bool), begin, end)


def _outcome(alarm: pd.Series, begin: float, end: float) -> AlarmTiming:
    """Return the timing of an alarm by time, s, for a force from begin to end."""
    early, after = bool(alarm[alarm.index < begin].any()), alarm[alarm.index >= begin]
    if not after.any():
        return AlarmTiming(np.nan, True, np.nan, early)
    raised, last = after.idxmax(), alarm[alarm].index[-1]
    cleared = np.nan if last >= alarm.index[-1] else max(0.0, last - end)
    kept = bool(alarm[(alarm.index >= raised) & (alarm.index <= end)].all())
    return AlarmTiming(float(raised - begin), kept, cleared, early)


def summarise_timings(timings: Sequence[AlarmTiming]) -> dict[str, object]:
    """Return the columns of :class:`Holds` for one course."""
    frame = pd.DataFrame(timings)
    raised, cleared = frame.raised.dropna(), frame.cleared.dropna()
    times = {"median_s": raised.quantile(0.5), "p95_s": raised.quantile(0.95), "cleared_s": cleared.median()}
    counts = {
        "touches": len(frame),
        "alarms": len(raised),
        "kept": frame.kept.sum(),
        "early": frame.early.sum(),
    }
    return counts | {name: "" if np.isnan(value) else f"{value:.2f}" for name, value in times.items()}
