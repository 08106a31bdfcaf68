"""Time to the alarm: dangerous touches of many courses pass an engine, frame by frame."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch

from skin.core.rng import Stream, generator
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.hardware.emulator import gestures_with_labels, upsample
from skin.hardware.live.engine import Engine
from skin.hardware.wire.channels import UnitConversion

FIELDS = ("course", "touches", "alarms", "kept", "early", "median_s", "p95_s", "cleared_s")

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


@dataclass(frozen=True)
class AlarmTiming:
    """Timing of the alarm for one dangerous touch.

    Attributes:
        peak: largest true reading, N.
        raised: s from the first force to the alarm; None without an alarm.
        lasting: the alarm lasted until the end of the force.
        cleared: s from the end of the force to the end of the alarm; None without an alarm or its end.
        early: an alarm was raised before the touch.
    """

    peak: float
    raised: float | None
    lasting: bool
    cleared: float | None
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
    begin, end, segment = time[touched[0]], time[touched[-1]], next(_SEGMENTS)
    engine.reset()
    answers: list[tuple[float, bool]] = []
    for number, (t, row) in enumerate(zip(time.tolist(), measured, strict=True)):
        frame = Frame(number, t, t, row, ~dead, segment)
        answers += [(verdict.t, verdict.dangerous) for verdict in engine.push([frame], conversion)]
    return _outcome(answers, float(np.abs(true).max()), begin, end)


def _outcome(answers: list[tuple[float, bool]], peak: float, begin: float, end: float) -> AlarmTiming:
    raised = next((t for t, alarm in answers if alarm and t >= begin), None)
    early = any(alarm for t, alarm in answers if t < begin)
    if raised is None:
        return AlarmTiming(peak, None, True, None, early)
    lasting = all(alarm for t, alarm in answers if raised <= t <= end)
    last = max(t for t, alarm in answers if alarm)
    cleared = None if last >= answers[-1][0] else max(0.0, float(last - end))
    return AlarmTiming(peak, float(raised - begin), lasting, cleared, early)


def timing_row(course: str, timings: Sequence[AlarmTiming]) -> list[str]:
    """Return a line with the columns of ``FIELDS``.

    These are: the course; the numbers of touches, of those with an alarm, with an alarm kept to the end, and
    with an alarm before the touch; median and 95th percentile of the time to the alarm, and median of the
    time from the end of the touch to the end of the alarm, s.
    """
    raised = [timing.raised for timing in timings if timing.raised is not None]
    cleared = [timing.cleared for timing in timings if timing.cleared is not None]
    counts = len(timings), len(raised), sum(t.lasting for t in timings), sum(t.early for t in timings)
    times = [float(np.percentile(raised, share)) for share in (50, 95)] if raised else []
    times += [float(np.median(cleared))] if cleared else []
    words = [f"{value:.2f}" for value in times]
    return [course, *map(str, counts), *words, *[""] * (len(FIELDS) - 5 - len(words))]


def time_courses(
    engine: Engine,
    device: AbstractSimulated,
    number: int,
    rate: float,
    track: Callable[..., Iterable[np.ndarray]],
) -> Iterator[list[str]]:
    """Feed every course to an engine and yield a row for each, as :func:`timing_row` gives it.

    Args:
        engine: at rest.
        device: as in :func:`play_touch`.
        number: touches per course; a tenth of it for courses of minutes.
        rate: of the device, Hz.
        track: wraps the touches of a course to show progress, as ``rich.progress.track``.
    """
    for course in COURSES:
        many = max(1, number // 10) if _LONG in course else number
        forces = track(dangerous_touches(device, course, many), course, many)
        yield timing_row(
            course, [play_touch(engine, device, force, rate, n) for n, force in enumerate(forces)]
        )
