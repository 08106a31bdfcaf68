"""Simulated dangerous touches pass an engine: a test at the start, and the time to the alarm."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
import torch

from skin.core.rng import Stream, generator
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.hardware.emulator.gestures import gestures_with_labels, upsample
from skin.hardware.live.engine import Engine, EngineSettings, sensor_list
from skin.hardware.wire.channels import RawRange, UnitConversion

STRENGTH = 1.5
"""Pressure of the touches as a multiple of the limit of ``dangerous``."""

_SHARE = 0.9  # of what the model finds with nominal settings that the settings in use must find
_MASKED = 0.25  # share of the sensors that may be without a valid reading
_RATE = 20.0  # Hz of the simulated frames: a decision at each
_REST, _HOLD, _FALL = 0.4, 0.4, 0.2  # s
_FAST, _SLOW = 0.2, 4.0  # s in which the force rises; the slow one shows a baseline that follows touches
_SLOWLY = 5  # sensors that are pressed slowly, too
_PLAUSIBLE = 1.0  # N, largest contact threshold that counts as nominal
_PIECE = 6  # frames that are judged at once
_APART = 1000.0  # s between two touches: each begins with an untouched skin
_OVERRIDE = "live.selftest=false skips this test"


@dataclass(frozen=True)
class SelfTest:
    """Presses on each sensor, passed through the settings in use and through nominal ones.

    Attributes:
        presses: (S, S), N, true readings of a press at the limit of ``dangerous`` on each sensor.
        used: settings of the alarm in use.
        nominal: those that the model brings.
    """

    presses: np.ndarray
    used: EngineSettings
    nominal: EngineSettings

    def run(self, conversion: UnitConversion, device: RawRange, say: Callable[[str], None]) -> None:
        """Run the test and report it.

        Args:
            conversion: of the device's values to N, in use.
            device: values that it can send.
            say: called with each message for the user.

        Raises:
            InputError: fewer touches raise the alarm than with nominal settings, or a valid sensor cannot
                raise it.
        """
        unit = nominal_conversion(len(self.presses))
        expected = self.find(self._plausible, unit, RawRange())
        raised = self.find(self.used, conversion, device)
        # A place without a valid sensor is shown as unknown, which hides nothing, unless there are many.
        valid = ~conversion.broken[self._sensors]
        missed = np.unique(self._sensors[expected & ~raised & valid])
        say(self._report(raised, expected, device))
        few = raised[valid].sum() < _SHARE * expected[valid].sum()
        if not expected.any() or len(missed) or few or conversion.broken.mean() > _MASKED:
            raise InputError(self._refusal(raised, expected, missed, conversion, device))

    @property
    def _sensors(self) -> np.ndarray:
        """The sensor of each press, (P,)."""
        slow = np.unique(np.linspace(0, len(self.presses) - 1, _SLOWLY).round().astype(int))
        return np.concatenate([np.arange(len(self.presses)), slow])

    @property
    def _plausible(self) -> EngineSettings:
        """Nominal settings, with a contact threshold that a damaged model file cannot raise."""
        detection = self.nominal.detection
        threshold = min(detection.threshold, _PLAUSIBLE)
        return replace(self.nominal, detection=replace(detection, threshold=threshold))

    def find(self, settings: EngineSettings, conversion: UnitConversion, device: RawRange) -> np.ndarray:
        """Return which presses raise the alarm, (P,), bool: a fast one on each sensor, and some slow ones."""
        engine, raised = settings.build(), list[bool]()
        # Without noise: the frozen frames of a test are no fault of the device.
        conversion = replace(conversion, changing=None)
        for number, sensor in enumerate(self._sensors):
            engine.reset()
            rise = _FAST if number < len(self.presses) else _SLOW
            frames = list(_frames(number, rise, STRENGTH * self.presses[sensor], conversion, device))
            settling = round(_REST * _RATE)
            engine.push(frames[:settling], None)  # nothing to decide yet
            raised.append(_alarms(engine, frames[settling:], conversion))
        return np.array(raised)

    def _report(self, raised: np.ndarray, expected: np.ndarray, device: RawRange) -> str:
        text = (
            f"self-test: {raised.sum()} of {len(raised)} dangerous presses raise the alarm, "
            f"{expected.sum()} with nominal settings"
        )
        if not raised.all():
            text += f"; not on {sensor_list(np.unique(self._sensors[~raised]).tolist())}"
        return text if device.known else f"{text}; the device declares no range, so its scale is not checked"

    def _refusal(
        self,
        raised: np.ndarray,
        expected: np.ndarray,
        missed: np.ndarray,
        conversion: UnitConversion,
        device: RawRange,
    ) -> str:
        """Return why the settings in use are refused, with the one that is most likely wrong."""
        count = f"{raised.sum()} of {len(raised)} dangerous presses raise the alarm, not {expected.sum()}"
        text = f"self-test: {count}"
        if len(missed):
            text += f"; {sensor_list(missed.tolist())} cannot raise it"
        if not expected.any():
            return f"{text}, even with nominal settings: train another run, or a longer one; {_OVERRIDE}"
        for setting, settings, values, sent in self._repairs(conversion, device):
            repaired = self.find(settings, values, sent)
            hidden = np.isin(self._sensors, missed) & expected & ~repaired
            enough = repaired.sum() >= _SHARE * expected.sum()
            if not hidden.any() and enough and values.broken.mean() <= _MASKED:
                return f"{text}: {setting} is most likely wrong; {_OVERRIDE}"
        return f"{text}: several settings are wrong; {_OVERRIDE}"

    def _repairs(
        self, conversion: UnitConversion, device: RawRange
    ) -> Iterator[tuple[str, EngineSettings, UnitConversion, RawRange]]:
        """Yield each setting with everything in use but this setting, which is nominal."""
        used, nominal, unit = self.used, self._plausible, nominal_conversion(len(self.presses))
        contact = replace(used.detection, threshold=nominal.detection.threshold)
        drift = replace(used.detection, drift=nominal.detection.drift)
        above = replace(used.patience, above=nominal.patience.above)
        masked = replace(conversion, broken=np.zeros(len(self.presses), dtype=bool))
        overridden = used.detection.threshold != self.nominal.detection.threshold
        name = "live.touch" if overridden else "the contact threshold of the model"
        yield name, replace(used, detection=contact), conversion, device
        yield "live.drift", replace(used, detection=drift), conversion, device
        yield "live.patience.above", replace(used, patience=above), conversion, device
        yield "live.patience", replace(used, patience=nominal.patience), conversion, device
        yield "the mask of broken sensors (device.calibration, or a tare at the limit)", used, masked, device
        yield "device.limits", used, conversion, replace(device, limits=(None, None))
        yield "device.scale or device.calibration", used, unit, RawRange()


def nominal_conversion(sensors: int) -> UnitConversion:
    """Return the conversion of a device that sends N."""
    return UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, dtype=bool))


def _alarms(engine: Engine, frames: Sequence[Frame], conversion: UnitConversion) -> bool:
    """Return whether frames raise the alarm; those behind it are left out."""
    pieces = (frames[first : first + _PIECE] for first in range(0, len(frames), _PIECE))
    return any(verdict.dangerous for piece in pieces for verdict in engine.push(piece, conversion))


def _frames(
    number: int, rise: float, press: np.ndarray, conversion: UnitConversion, device: RawRange
) -> Iterator[Frame]:
    """Yield the frames of a press (S,), N, as the device would send them."""
    corners = np.cumsum([_REST, rise, _HOLD, _FALL])
    time = np.arange(0.0, corners[-1], 1 / _RATE)
    load = np.interp(time, corners, [0, 1, 1, 0])
    with np.errstate(all="ignore"):  # any scale is tried
        values = device.rounded(np.nan_to_num(load[:, None] * press / conversion.scale + conversion.zero))
    low, high = (
        np.inf * sign if limit is None else limit for sign, limit in zip((-1, 1), device.limits, strict=True)
    )
    polarity = np.sign(conversion.scale)
    for t, row in zip((time + _APART * number).tolist(), values, strict=True):
        saturated = (row <= low) | (row >= high)
        yield Frame(None, t, t, row, np.isfinite(row), number, 0, "", saturated, polarity)


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
