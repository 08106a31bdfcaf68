"""Build the engine of a live view from a trained model, a skin and settings, and test it at the start.

torch is not imported.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from time import monotonic
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from skin.calibration.check import verify_source
from skin.core.settings import configured
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.evaluation.alarm import choose_alarm_threshold
from skin.evaluation.decisions import DRIFT, least_visible
from skin.live.contacts import Mechanics
from skin.live.engine import DebounceSettings, Detection, EngineSettings
from skin.live.verdict import Note, sensor_list
from skin.runs.configuration import Config
from skin.runs.model import Model, OnnxModel
from skin.wire.channels import RawRange, UnitConversion, unit_conversion
from skin.wire.reader import PortSettings, SkinDisconnected, SkinTimeout
from skin.wire.skin import SerialSource, Skin, Source

STRENGTH = 1.5
"""Pressure of the touches as a multiple of the limit of ``dangerous``."""

_WEAK = 1.2  # the same of weaker ones: a network is surer of strong touches than of those that a limit hides
_LEAST = 0.5  # of the presses that must raise the alarm with nominal settings
_SHARE = 0.9  # of what the model finds with nominal settings that the settings in use must find
_MASKED = 0.25  # fraction of the sensors that may be without a valid reading
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
            InputError: fewer touches raise the alarm than with nominal settings, a valid sensor cannot raise
                it that does with those, or with those less than half of the presses do; or the threshold
                hides weaker ones.
        """
        unit = unit_conversion(len(self.presses), None, 1.0, None, None)
        expected = self.find(self._plausible, unit, RawRange())
        raised = self.find(self.used, conversion, device)
        # A place without a valid sensor is shown as unknown, which hides nothing, unless there are many.
        valid = ~conversion.broken[self._sensors]
        missed = np.unique(self._sensors[expected & ~raised & valid])
        text = f"self-test: {raised.sum()} of {len(raised)} dangerous presses raise the alarm, "
        text += f"{expected.sum()} with nominal settings"
        if not raised.all():
            text += f"; not on {sensor_list(np.unique(self._sensors[~raised]).tolist())}"
        untested = "only its range tests the scale" if device.known else "so its scale is not checked"
        declared = "" if device.known else "the device declares no range, "
        say(f"{text}; {declared}{untested}")
        few = raised[valid].sum() < _SHARE * expected[valid].sum()
        if expected.mean() < _LEAST or len(missed) or few or conversion.broken.mean() > _MASKED:
            raise InputError(self._refusal(raised, expected, missed, conversion, device))
        self._check_threshold(unit)

    def _check_threshold(self, unit: UnitConversion) -> None:
        """Raise InputError if a threshold above the nominal one hides weak touches, which it alone could."""
        above = [settings.patience.above or 0.5 for settings in (self.used, self.nominal)]
        if above[0] <= above[1]:
            return
        used, nominal = (
            self.find(
                replace(self._plausible, patience=replace(self.nominal.patience, above=value)),
                unit,
                RawRange(),
                _WEAK,
            ).sum()
            for value in above
        )
        if used < _SHARE * nominal:
            raise InputError(
                f"self-test: {used} of {len(self._sensors)} presses at {_WEAK:g} times the limit raise the "
                f"alarm, {nominal} with nominal settings: live.patience.above={above[0]:g} is most likely "
                f"wrong; {_OVERRIDE}"
            )

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

    def find(
        self,
        settings: EngineSettings,
        conversion: UnitConversion,
        device: RawRange,
        strength: float = STRENGTH,
    ) -> np.ndarray:
        """Return which presses raise the alarm, (P,), bool: a fast one on each sensor, and some slow ones."""
        engine, raised = settings.build(), list[bool]()
        # Without noise: the frozen frames of a test are no fault of the device.
        conversion = replace(conversion, changing=None)
        for number, sensor in enumerate(self._sensors):
            engine.reset()
            rise = _FAST if number < len(self.presses) else _SLOW
            frames = list(_frames(number, rise, strength * self.presses[sensor], conversion, device))
            settling = round(_REST * _RATE)
            engine.push(frames[:settling], None)  # nothing to decide yet
            pieces = (frames[first : first + _PIECE] for first in range(settling, len(frames), _PIECE))
            # The frames behind the alarm are left out.
            raised.append(
                any(verdict.dangerous for piece in pieces for verdict in engine.push(piece, conversion))
            )
        return np.array(raised)

    def _refusal(
        self,
        raised: np.ndarray,
        expected: np.ndarray,
        missed: np.ndarray,
        conversion: UnitConversion,
        device: RawRange,
    ) -> str:
        """Return why the settings in use are refused, with those that are not nominal, or the device."""
        found = f"{raised.sum()} of {len(raised)}"
        text = f"self-test: {found} dangerous presses raise the alarm, not {expected.sum()}"
        if len(missed):
            text += f"; {sensor_list(missed.tolist())} cannot raise it"
        if expected.mean() < _LEAST:
            return f"{text}, even with nominal settings: train another run, or a longer one; {_OVERRIDE}"
        if conversion.broken.mean() > _MASKED:
            suspect = (
                f"{conversion.broken.sum()} of {len(self.presses)} sensors have no valid reading (at most a "
                "quarter may): they are dead, or the mask of broken sensors (device.calibration, or a tare "
                "at the limit)"
            )
        else:
            repaired = self.find(self._plausible, conversion, device)
            hidden = np.isin(self._sensors, missed) & expected & ~repaired
            enough = not hidden.any() and repaired.sum() >= _SHARE * expected.sum()
            suspect = self._differing if enough else ""
        suspect = suspect or "device.limits, device.scale or device.calibration"
        return f"{text}: {suspect} is most likely wrong; {_OVERRIDE}"

    @property
    def _differing(self) -> str:
        """The settings in use that are not nominal, in words."""
        used, nominal = self.used, self._plausible
        threshold = used.detection.threshold != nominal.detection.threshold
        differing = {
            "the contact threshold of the model or live.touch": threshold,
            "live.drift": used.detection.drift != nominal.detection.drift,
            "live.patience": used.patience != nominal.patience,
        }
        return " or ".join(name for name, differs in differing.items() if differs)


def _frames(
    number: int, rise: float, press: np.ndarray, conversion: UnitConversion, device: RawRange
) -> Iterator[Frame]:
    """Yield the frames of a press (S,), N, as the device would send them."""
    corners = np.cumsum([_REST, rise, _HOLD, _FALL])
    time = np.arange(0.0, corners[-1], 1 / _RATE)
    load = np.interp(time, corners, [0, 1, 1, 0])
    with np.errstate(all="ignore"):  # any scale is tried
        values = np.nan_to_num(conversion.raw(load[:, None] * press))
        values = np.round(values) if device.whole else values
        if (device.least, device.most) != (None, None):
            values = np.clip(values, device.least, device.most)
    low, high = (
        np.inf * sign if limit is None else limit for sign, limit in zip((-1, 1), device.limits, strict=True)
    )
    polarity = np.sign(conversion.scale)
    for t, row in zip((time + _APART * number).tolist(), values, strict=True):
        saturated = (row <= low) | (row >= high)
        yield Frame(None, t, t, row, np.isfinite(row), number, 0, "", saturated, polarity)


# The settings of ``skin live``.


@dataclass(frozen=True)
class LiveSettings:
    """Settings under ``live:`` (``conf/live.yaml``).

    Attributes:
        web_port: port of the page; 0: any free one.
        top: upper end of the colour scale, N.
        touch: contact threshold, N above the baseline; None: that of the run.
        drift: N in ten minutes that the baseline may follow without touch.
        verdicts: where JSON lines go, ``stdout``, in place of the terminal view; None: nowhere.
        log: file to which alarms are appended; None: no log.
        contacts: whether a process of its own estimates contacts.
        selftest: whether simulated dangerous touches must raise the alarm at the start.
        patience: settings of debouncing.
    """

    web_port: Annotated[int, Ge(0), Le(65535)]
    top: Annotated[float, Gt(0)]
    touch: Annotated[float, Gt(0)] | None
    drift: Annotated[float, Ge(0)]
    verdicts: Literal["stdout"] | None
    log: str | None
    contacts: bool
    selftest: bool
    patience: DebounceSettings

    @classmethod
    def of(cls, live: Mapping[str, Any]) -> "LiveSettings":
        """Return checked settings from plain containers.

        Raises:
            InputError: a setting is unknown or invalid.
        """
        patience = configured(DebounceSettings, live["patience"], "live.patience")
        return configured(cls, {**live, "patience": patience}, "live")


USUAL_RATE = 100.0
"""Hz: of a device whose rate is not known yet, for the choice of a threshold."""

_PATIENCE = 3.0  # s
_ENOUGH = 20  # frames that show the rate
_SHOWN = 0.2  # s from which the rate of arrivals shows
_BURSTS = 5.0  # times the rate that frames in bursts may seem to arrive with; a unit is wrong by 1000
_ALL = 10**6  # frames, more than any queue holds


@dataclass(frozen=True)
class Watched:
    """The settings of an engine and what it is fed with.

    Attributes:
        model: that predicts.
        source: open.
        settings: of the engine, in use.
        nominal: those that the model brings.
    """

    model: Model
    source: Source
    settings: EngineSettings
    nominal: EngineSettings

    def check(
        self,
        test: bool,
        say: Callable[[str], None],
        add_note: Callable[[Note], None],
        conversion: UnitConversion,
    ) -> tuple[int, np.ndarray | None]:
        """Compare the conversion in use with what is stored of the device, and run the self-test with it.

        Args:
            test: ``live.selftest``.
            say: called with each message for the user.
            add_note: called with a note on the whole session.
            conversion: of the device's values to N.

        Returns:
            The largest number of sensors that may prove dead afterwards; and the baseline above the stored
            rest of the device, (S,), N, None if none is stored.

        Raises:
            InputError: the settings in use hide dangerous touches.
        """
        sensors = len(self.model.positions)
        found = verify_source(self.source, conversion, self.model.positions, self.model.size)
        if found.text:
            say(found.text)
        if found.state == "unverified":
            add_note(Note("unverified", detail=found.text))
        rest = found.check.rest if found.check else self.source.calibrated_rest
        raised = None
        if rest is not None and conversion.rest is not None:
            raised = conversion.rest - conversion.newtons(np.asarray(rest))
        if not test:
            say("no self-test: live.selftest=false")
        elif self.nominal.presses is None or not self.model.alarms:
            say("no self-test: this run brings no alarm or no simulated skin")
        else:
            selftest = SelfTest(self.nominal.presses, self.settings, self.nominal)
            selftest.run(conversion, self.source.raw_range, say)
            sensors = int(_MASKED * sensors)
        if self.nominal.presses is not None and conversion.noise is not None:
            felt = self.nominal.presses >= least_visible(conversion.noise, self.settings.detection.threshold)
            if alone := np.flatnonzero(felt.sum(axis=1) < 2).tolist():
                say(f"no neighbour would show that the wire of {sensor_list(alone)} breaks to its rest value")
        return sensors, raised


@dataclass(frozen=True)
class LiveSetup:
    """A model and its device, before the threshold of the alarm is chosen.

    Attributes:
        model: that predicts.
        name: of the device.
        port: open source of a skin at a port; None: the skin is simulated or recorded.
        begin: opens the source of such a skin, whose frames come from then on.
        mechanics: gives what contacts are estimated with; it raises InputError if there is nothing.
    """

    model: Model
    name: str
    port: Source | None
    begin: Callable[[], Source]
    mechanics: Callable[[], Mechanics]

    def watch(self, live: LiveSettings, say: Callable[[str], None]) -> Watched:
        """Choose the threshold, which may take seconds, and return what is fed to the engine.

        Raises:
            InputError: no contact threshold is known, or no threshold raises an alarm as seldom as wanted.
        """
        settings = used_and_nominal(self.model, self.port, live, say)
        return Watched(self.model, self.port or self.begin(), *settings)


def watch_exported(
    path: str, device: Mapping[str, Any], say: Callable[[str], None], opened: ExitStack
) -> LiveSetup:
    """Return an exported network and a skin at a port.

    Args:
        path: of the ONNX file.
        device: settings of ``device=serial``.
        say: called with each message for the user.
        opened: closes the port in the end.

    Raises:
        InputError: the file cannot be used, or the device is not a skin at a port, or cannot be opened.
    """
    if "port" not in device:
        raise InputError(
            f"run={path} watches a skin at a port: add device=serial device.port=/dev/ttyACM0, or give the "
            "run itself for a recording or the simulator"
        )
    model = OnnxModel(path)
    source = SerialSource(PortSettings.select(device), len(model.positions), model.rate).open_source()
    opened.enter_context(source.skin)
    say(f"loaded {model.title} from {path}, exported by version {model.metadata.version}")
    return LiveSetup(model, source.name, source, lambda: source, _refuse_contacts)


def _refuse_contacts() -> Mechanics:
    raise InputError("an exported model has no mechanics: give the run itself, as in run=latest")


def watch_run(
    name: str,
    config: Config,
    live: LiveSettings,
    say: Callable[[str], None],
    overrides: Sequence[str],
    opened: ExitStack,
    own_mechanics: bool = False,
) -> LiveSetup:
    """Return a finished run and the device of a configuration.

    Args:
        name: of the run.
        config: of the command.
        live: settings of the live view.
        say: called with each message for the user.
        overrides: settings that replace those of the run; ``config`` has their values.
        opened: closes the device in the end.
        own_mechanics: the device has the mechanics of the run, though it is at a port.

    Raises:
        InputError: there is no such run, it cannot be loaded, or the device cannot be opened.
    """
    import torch

    from skin.record.serial import open_source
    from skin.runs.build import build_device
    from skin.runs.run import find_run
    from skin.runs.torch_model import equation10_warning, load_model

    torch.set_num_threads(config.tracking.threads or 1)
    run = find_run(config.tracking, name, config.trust)
    watched = run.configured(overrides)
    device = build_device(watched)
    # A port is opened first: that it is missing must not take as long to say as a run takes to load.
    port = open_source(device) if device.real else None
    if port is not None:
        opened.enter_context(port.skin)
    # The training data stay those of the run, for any watched device.
    trained = run.configured([word for word in overrides if not word.startswith(("device=", "device."))])
    say(f"loading {run.title} ({run.identity[:8]})")
    if not own_mechanics and (advice := equation10_warning(run.stored, device)):
        say(advice)
    # Without a simulator nothing could tune a contact threshold.
    touch = None if "simulator" in run.stored.device else live.touch
    model = load_model(run, trained, watched, touch=touch, alarm=False)
    mechanics = partial(Mechanics.of, model.device.reference, bool(config.device.get("calibration")))

    def begin() -> Source:
        source = open_source(device)
        opened.enter_context(source.skin)
        return source

    return LiveSetup(model, device.name if port is None else port.name, port, begin, mechanics)


def engine_settings(
    model: Model,
    patience: DebounceSettings,
    touch: float | None = None,
    drift: float = 600 * DRIFT,
) -> EngineSettings:
    """Return the settings of the engine of a model.

    Args:
        model: that predicts.
        patience: settings of debouncing, with the threshold of the alarm.
        touch: contact threshold, N above the baseline; None: that of the model, and the learned label
            ``touch`` counts as touch, too.
        drift: N in ten minutes that the baseline may follow without touch.

    Raises:
        InputError: ``touch`` is neither given nor known, or the model estimates targets.
    """
    if model.task.kind == "regression":
        raise InputError(
            f"{model.title} estimates {', '.join(model.task.names)}: skin live shows labels or classes, so "
            "give a run of those"
        )
    contact = model.contact if touch is None else touch
    return EngineSettings(
        model.probabilities,
        model.task,
        len(model.positions),
        model.window,
        model.rate,
        Detection(contact, drift / 600, model.learned and touch is None, model.longest),
        patience,
        model.presses,
    )


def used_and_nominal(
    model: Model, port: Source | None, live: LiveSettings, say: Callable[[str], None]
) -> tuple[EngineSettings, EngineSettings]:
    """Return the settings of an engine: those of a live view, and those that the model brings.

    Args:
        model: that predicts.
        port: open source of a skin at a port, whose frames are discarded that wait while a threshold is
            chosen; None: the skin is simulated or recorded.
        live: settings of the live view.
        say: called with each message for the user.

    Raises:
        InputError: no contact threshold is known, or no threshold raises an alarm as seldom as wanted.
    """
    given, usual, conditions = live.patience.above, None, None
    if given is None and model.alarms:
        rate = model.rate if port is None else measured_rate(port.skin)
        conditions = model.live_conditions(rate, live.patience.alarm, port is None)
    if given is not None or model.alarms:
        point = choose_alarm_threshold(model.alarm, conditions, given, say=say)
        # A threshold of the command line is tested against the usual one.
        usual = model.threshold if point is None or given is not None else point.announced(say)
    if conditions is not None and port is not None:
        # Frames that waited meanwhile would delay the verdicts about those of now.
        with suppress(SkinTimeout, SkinDisconnected):
            port.skin.read(_ALL, 0.0)
    nominal = engine_settings(model, DebounceSettings(above=usual))
    used = engine_settings(model, nominal.patience, live.touch, live.drift)
    above = usual if given is None else given
    return replace(used, patience=replace(live.patience, above=above)), nominal


def measured_rate(skin: Skin) -> float:
    """Return the rate of a device, Hz: measured, else that of its header, else the usual one.

    Waits some seconds for its first frames, which are discarded, and until they arrive at the rate of the
    device's clock: its unit may have to be inferred.
    """
    begin, before = monotonic(), skin.stats.frames
    while (passed := monotonic() - begin) < _PATIENCE:
        with suppress(SkinTimeout):
            skin.read(1, _PATIENCE / 10)
        stats = skin.stats
        arrived = (stats.frames - before) / max(passed, _SHOWN)
        if stats.frames >= _ENOUGH and arrived / _BURSTS < stats.rate_hz < arrived * _BURSTS:
            break
    declared = skin.header.rate if skin.header is not None else None
    return skin.stats.rate_hz or declared or USUAL_RATE
