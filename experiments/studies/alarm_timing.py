"""Time to the alarm: dangerous touches of many courses pass an engine, frame by frame."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch

from skin.core.rng import Stream, generator
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.live.engine import Engine
from skin.wire.channels import UnitConversion
from skin.wire.emulator import gestures_with_labels, upsample

_IDLE = 4.0  # s without touch before each one
_AFTER = 5.0  # s behind it
_LONG = "600 s"  # in the names of courses that last minutes
_SEGMENTS = count()  # of the device's clock: every touch begins with an empty window
_TAP = {"dynamic": 0, "press": 0, "dangerous": 1}
_PRESS = {"dynamic": 0, "press": 1, "dangerous": 1}


def _held(seconds: float, load: float = 1.0) -> Callable[[np.ndarray], np.ndarray]:
    """Return the load of a press (F,) at times (F,), s: full for half a second, then ``load``."""
    return lambda t: np.interp(t, [0, 0.2, 0.5, 0.7, seconds, seconds + 0.2], [0, 1, 1, load, load, 0])


def _ramp(seconds: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: np.interp(t, [0, seconds, seconds + 1, seconds + 1.2], [0, 1, 1, 0])


COURSES: Mapping[str, Callable[[np.ndarray], np.ndarray] | None] = {
    "tap": None,
    "press": None,
    "hold 1 s": _held(1.0),
    "hold 1 s, 30 % load": _held(1.0, 0.3),
    "hold 10 s": _held(10.0),
    "hold 10 s, 30 % load": _held(10.0, 0.3),
    "hold 600 s": _held(600.0),
    "hold 600 s, 30 % load": _held(600.0, 0.3),
    "ramp 10 s": _ramp(10.0),
}
"""Load of a dangerous touch over time; None: that of the gesture."""


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
    device: AbstractSimulated, course: str, number: int, seed: int = 0
) -> Iterator[np.ndarray]:
    """Yield the true readings (T, S), N, of dangerous static touches at the model's rate.

    Args:
        device: source of the gestures, which are not used for training.
        course: a name in ``COURSES``.
        number: of touches; half of them are big.
        seed: of the gestures.

    Raises:
        InputError: there is no such course.
    """
    if course not in COURSES:
        raise InputError(f"there is no course {course!r}: there are {', '.join(COURSES)}")
    labels = _TAP if course == "tap" else _PRESS
    names = [name for name in device.task.names if name in (*labels, "big")]
    rows = np.array(
        [[place % 2 if name == "big" else labels[name] for name in names] for place in range(number)]
    )
    profile = COURSES[course]
    for gesture in gestures_with_labels(device, rows, seed):
        if profile is None:
            yield gesture.force
            continue
        strongest = gesture.force[gesture.force.sum(axis=1).argmax()]
        load = profile(np.arange(0.0, 2000.0, 1 / device.model_rate))
        yield load[: np.flatnonzero(load)[-1] + 2, None] * strongest


def play_touch(
    engine: Engine, device: AbstractSimulated, force: np.ndarray, rate: float, seed: int = 0
) -> AlarmTiming:
    """Feed a touch to an engine frame by frame; return the timing of the alarm.

    Args:
        engine: new, or at rest.
        device: measures the touch with its imperfections, after a tare.
        force: true readings, (T, S), N, at the model's rate.
        rate: of the device, Hz.
        seed: of the noise.
    """
    idle = [np.zeros((round(seconds * rate), force.shape[1])) for seconds in (_IDLE, _AFTER)]
    true = np.concatenate([idle[0], upsample(force, device.model_rate, rate), idle[1]])
    noise, time = generator(Stream.NOISE, seed, Stream.TEST, 6), np.arange(len(true)) / rate
    imperfection, constants = device.imperfection, device.constants
    measured = (
        imperfection.raw(torch.from_numpy(true)[None].float(), constants, noise, torch.from_numpy(time))[0]
        .double()
        .numpy()
    )
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


def summarise_timings(course: str, timings: Sequence[AlarmTiming]) -> dict[str, object]:
    """Return a row of :func:`time_courses`; times are texts, empty where there was no alarm."""
    frame = pd.DataFrame(timings)
    raised, cleared = frame.raised.dropna(), frame.cleared.dropna()
    times = {"median_s": raised.quantile(0.5), "p95_s": raised.quantile(0.95), "cleared_s": cleared.median()}
    counts = {
        "touches": len(frame),
        "alarms": len(raised),
        "kept": frame.kept.sum(),
        "early": frame.early.sum(),
    }
    texts = {name: "" if np.isnan(value) else f"{value:.2f}" for name, value in times.items()}
    return {"course": course, **counts, **texts}


def time_courses(
    engine: Engine,
    device: AbstractSimulated,
    number: int,
    rate: float,
    track: Callable[..., Iterable[np.ndarray]],
) -> pd.DataFrame:
    """Feed every course to an engine and return a row for each.

    The columns are: the course; the numbers of touches, of those with an alarm, with an alarm kept to the
    end, and with an alarm before the touch; median and 95th percentile of the time to the alarm, and median
    of the time from the end of the touch to the end of the alarm, s.

    Args:
        engine: at rest.
        device: as in :func:`play_touch`.
        number: touches per course; a tenth of it for courses of minutes.
        rate: of the device, Hz.
        track: wraps the touches of a course to show progress, as ``rich.progress.track``.
    """
    rows = []
    for course in COURSES:
        many = max(1, number // 10) if _LONG in course else number
        forces = track(dangerous_touches(device, course, many), course, many)
        timings = [play_touch(engine, device, force, rate, n) for n, force in enumerate(forces)]
        rows.append(summarise_timings(course, timings))
    return pd.DataFrame(rows)
