"""A test of the alarm at the start: simulated dangerous touches pass the very settings in use."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from skin.errors import InputError
from skin.hardware.live.engine import Engine, EngineSettings
from skin.hardware.live.verdict import sensor_list
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion
from skin.wire.health import RawRange

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
            rest = round(_REST * _RATE)
            engine.push(frames[:rest], None)  # nothing to decide yet
            raised.append(_alarms(engine, frames[rest:], conversion))
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
        given = used.detection.threshold != self.nominal.detection.threshold
        name = "live.touch" if given else "the contact threshold of the model"
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
