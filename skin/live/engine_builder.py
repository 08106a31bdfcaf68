"""Build the engine of a live view from a trained model, a skin and settings, and test it at the start.

torch is not imported.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from time import monotonic, sleep
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from skin.calibration.check import verify_source
from skin.core.settings import configured
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.evaluation.alarm import choose_alarm_threshold
from skin.evaluation.decisions import DRIFT, minimum_visible
from skin.evaluation.guarantee import MARGIN, Guarantee
from skin.evaluation.operating_point import DangerScore, FinalThreshold, OperatingPoint
from skin.inference.mechanics import Mechanics
from skin.live.engine import DebounceSettings, Detection, Engine
from skin.live.verdict import Note, sensor_list
from skin.runs.configuration import Config
from skin.runs.model import Model, OnnxModel
from skin.wire.channels import NewtonFrame, RawRange, UnitConversion, unit_conversion
from skin.wire.reader import Port, SkinTimeout
from skin.wire.skin import SerialSource, Skin, Source

_OVERRIDE = "live.selftest=false skips this test"


@dataclass(frozen=True)
class SelfTest:
    """Presses on each sensor, passed through the settings in use and through nominal ones.

    Attributes:
        presses: (S, S), N, true readings of a press at the limit of ``dangerous`` on each sensor.
        used: engine with the settings in use.
        nominal: engine with those that the model brings.
        weak: pressure of weaker presses as a multiple of the limit of ``dangerous``: a network is surer of
            strong touches than of those that a limit hides.
        minimum: fraction of the presses that must raise the alarm with nominal settings.
        found: fraction of what the model finds with nominal settings that the settings in use must find.
        masked: largest fraction of the sensors without a valid reading.
        slowly: sensors that are pressed slowly, too.
        plausible: N, largest contact threshold that counts as nominal: a damaged model file cannot raise it.
    """

    presses: np.ndarray
    used: Engine
    nominal: Engine
    weak: float = 1.2
    minimum: float = 0.5
    found: float = 0.9
    masked: float = 0.25
    slowly: int = 5
    plausible: float = 1.0

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
        raised = self.find(self.used, conversion, device)
        # Where all presses raise it, there is nothing that nominal settings would find in addition.
        expected = raised if raised.all() else self.find(self._nominal, unit, RawRange())
        # A place without a valid sensor is shown as unknown, which hides nothing, unless there are many.
        valid = ~conversion.broken[self._sensors]
        silent, missed = (
            sensor_list(np.unique(self._sensors[which]).tolist()) if which.any() else ""
            for which in (~raised, expected & ~raised & valid)
        )
        text = f"self-test: {raised.sum()} of {len(raised)} dangerous presses raise the alarm"
        scale = (
            "only its range tests the scale"
            if device.maximum is not None  # too large or too small a force would leave the range
            else "the device declares no range (device.limits), so its scale is not checked"
        )
        more = "" if raised.all() else f", {expected.sum()} with nominal settings; not on {silent}"
        say(f"{text}{more}; {scale}")
        text += f", not {expected.sum()}" + f"; {missed} cannot raise it" * bool(missed)
        if expected.mean() < self.minimum:
            raise InputError(
                f"{text}, even with nominal settings: train another run, or a longer one; {_OVERRIDE}"
            )
        few = raised[valid].sum() < self.found * expected[valid].sum()
        if missed or few or conversion.broken.mean() > self.masked:
            raise InputError(f"{text}: {self._suspect(conversion)} is most likely wrong; {_OVERRIDE}")
        # A threshold above the nominal one may hide weaker touches alone.
        if self.used.above > self.nominal.above:
            strict = replace(self._nominal, patience=self.used.patience)
            used, nominal = (
                self.find(engine, unit, RawRange(), self.weak).sum() for engine in (strict, self._nominal)
            )
            if used < self.found * nominal:
                raise InputError(
                    f"self-test: {used} of {len(raised)} presses at {self.weak:g} times the limit raise the "
                    f"alarm, {nominal} with nominal settings: live.patience.above={self.used.above:g} is "
                    f"most likely wrong; {_OVERRIDE}"
                )

    @property
    def _sensors(self) -> np.ndarray:
        """The sensor of each press, (P,)."""
        slow = np.unique(np.linspace(0, len(self.presses) - 1, self.slowly).round().astype(int))
        return np.concatenate([np.arange(len(self.presses)), slow])

    @property
    def _nominal(self) -> Engine:
        """An engine with nominal settings and a plausible contact threshold."""
        threshold = min(self.nominal.detection.threshold, self.plausible)
        return replace(self.nominal, detection=replace(self.nominal.detection, threshold=threshold))

    def find(
        self,
        engine: Engine,
        conversion: UnitConversion,
        device: RawRange,
        strength: float = 1.5,
    ) -> np.ndarray:
        """Return which presses raise the alarm, (P,), bool: a fast one on each sensor, and some slow ones.

        Their pressure is ``strength`` times the limit of ``dangerous``.
        """
        engine = replace(engine)
        return np.array(
            [
                raises_alarm(
                    engine,
                    *_press(
                        number,
                        number >= len(self.presses),
                        strength * self.presses[sensor],
                        conversion,
                        device,
                    ),
                )
                for number, sensor in enumerate(self._sensors)
            ]
        )

    def _suspect(self, conversion: UnitConversion) -> str:
        """Return what hides presses: the mask, or settings in use that are not nominal, or the device's."""
        if conversion.broken.mean() > self.masked:
            return (
                f"{conversion.broken.sum()} of {len(self.presses)} sensors have no valid reading (at most a "
                "quarter may): they are dead, or the mask of broken sensors (device.calibration, or a tare "
                "at the limit)"
            )
        used, nominal = self.used.detection, self._nominal.detection
        differing = {
            "the contact threshold of the model or live.touch": used.threshold != nominal.threshold,
            "live.drift": used.drift != nominal.drift,
            "live.patience": self.used.patience != self.nominal.patience,
        }
        return (
            " or ".join(name for name, differs in differing.items() if differs)
            or "device.limits, device.scale or device.calibration"
        )


def raises_alarm(
    engine: Engine, stream: Sequence[NewtonFrame], noise: np.ndarray | None, rest: int = 0
) -> bool:
    """Return whether a touch of the untouched skin raises the alarm.

    Args:
        engine: is reset.
        stream: the readings.
        noise: (S,), N, standard deviation of the untouched skin; None: unknown.
        rest: number of readings at the beginning on which there is nothing to decide.
    """
    engine.reset(noise=noise)
    engine.remember(stream[:rest])
    # Judged six at once; those behind the alarm are left out.
    return any(
        verdict.dangerous
        for first in range(rest, len(stream), 6)
        for verdict in engine.push(stream[first : first + 6])
    )


def _press(
    number: int,
    slow: bool,
    press: np.ndarray,
    conversion: UnitConversion,
    device: RawRange,
    rate: float = 20.0,
    spans: tuple[float, ...] = (0.4, 0.2, 0.4, 0.2),
    slowly: float = 4.0,
    apart: float = 1000.0,
) -> tuple[list[NewtonFrame], np.ndarray | None, int]:
    """Return the readings of a press, as they come from the device.

    Args:
        number: of the press.
        slow: whether its force rises slowly, which shows a baseline that follows touches.
        press: (S,), N.
        conversion: of the device's values to N.
        device: values that it can send.
        rate: of the frames, Hz: a decision at each.
        spans: s of rest, rise, hold and fall.
        slowly: s of a slow rise.
        apart: s between two presses: each begins with an untouched skin.

    Returns:
        The readings, the noise of the untouched skin, (S,), N, and the number of readings before the press.
    """
    rest, rise, hold, fall = spans
    corners = np.cumsum([rest, slowly if slow else rise, hold, fall])
    time = np.arange(0.0, corners[-1], 1 / rate)
    load = np.interp(time, corners, [0, 1, 1, 0])
    with np.errstate(all="ignore"):  # any scale is tried
        values = np.nan_to_num(conversion.raw(load[:, None] * press))
        values = np.clip(np.round(values) if device.whole else values, device.minimum, device.maximum)
    low, high = (
        np.inf * sign if limit is None else limit for sign, limit in zip((-1, 1), device.limits, strict=True)
    )
    frames = (
        Frame(None, t, t, row, np.isfinite(row), number, 0, "", (row <= low) | (row >= high))
        for t, row in zip((time + apart * number).tolist(), values, strict=True)
    )
    return [conversion.convert(frame) for frame in frames], conversion.noise, round(rest * rate)


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
        record: new MCAP file for readings, verdicts and contacts; None: they are not recorded.
        contacts: whether a process of its own estimates contacts.
        selftest: whether simulated dangerous touches must raise the alarm at the start.
        patience: settings of debouncing.
        thickness: range of the thickness of the skin, relative to the described one, for contacts.
    """

    web_port: Annotated[int, Ge(0), Le(65535)]
    top: Annotated[float, Gt(0)]
    touch: Annotated[float, Gt(0)] | None
    drift: Annotated[float, Ge(0)]
    verdicts: Literal["stdout"] | None
    log: str | None
    record: str | None
    contacts: bool
    selftest: bool
    patience: DebounceSettings
    thickness: tuple[Annotated[float, Gt(0), Le(1)], Annotated[float, Ge(1)]] = (1.0, 1.0)

    @classmethod
    def of(cls, live: Mapping[str, Any]) -> "LiveSettings":
        """Return checked settings from plain containers.

        Raises:
            InputError: a setting is unknown or invalid.
        """
        return configured(
            cls,
            {**live, "patience": configured(DebounceSettings, live["patience"], "live.patience")},
            "live",
        )


@dataclass(frozen=True)
class LiveSetup:
    """A model and its device, before the threshold of the alarm is chosen.

    Attributes:
        model: that predicts.
        name: of the device.
        port: open source of a skin at a port; None: the skin is simulated or recorded.
        begin: opens the source of the skin; of one without a port, whose frames come from then on.
        mechanics: gives what contacts are estimated with; it raises InputError if there is nothing.
    """

    model: Model
    name: str
    port: Source | None
    begin: Callable[[], Source]
    mechanics: Callable[..., Mechanics]

    def watch(
        self, live: LiveSettings, say: Callable[[str], None]
    ) -> tuple[Source, Engine, Engine, FinalThreshold | None]:
        """Choose the threshold, which may take seconds; return the source, and an engine for its frames.

        The second engine has the settings that the model brings. Where the threshold is provisional, the
        final one is being chosen in a process.

        Args:
            live: settings of the live view.
            say: called with each message for the user.

        Raises:
            InputError: no contact threshold is known, or no threshold raises an alarm as seldom as wanted.
        """
        model, given, usual, conditions = self.model, live.patience.above, None, None
        danger = final = promise = None
        if given is None and model.alarms:
            rate = model.rate if self.port is None else measured_rate(self.port.skin)
            conditions = model.live_conditions(rate, live.patience.alarm, self.port is None)
        if given is not None or model.alarms:
            point = choose_alarm_threshold(model.alarm, conditions, given, say=say, quick=True)
            # A threshold of the command line is tested against the usual one.
            if point is None or given is not None:
                usual = model.threshold
            else:
                usual, danger, promise = point.announced(say), point.score, point.guarantee
                if point.provisional and conditions is not None:
                    final = FinalThreshold(model.alarm, conditions)
        if conditions is not None and self.port is not None:
            # Of the frames that waited, the latest give the baseline; others would delay verdicts about now.
            self.port.skin.skip(self.port.tare.seconds + 0.2)
        nominal = engine_settings(model, DebounceSettings(above=usual), danger=danger)
        patience = replace(live.patience, above=usual if given is None else given)
        used = engine_settings(model, patience, live.touch, live.drift, danger, promise)
        return self.port or self.begin(), used, nominal, final

    def check(
        self,
        source: Source,
        engine: Engine,
        nominal: Engine,
        test: bool,
        say: Callable[[str], None],
        add_note: Callable[[Note], None],
        conversion: UnitConversion,
    ) -> np.ndarray | None:
        """Compare the conversion in use with what is stored of the device, and run the self-test with it.

        Args:
            source, engine, nominal: from :meth:`watch`.
            test: ``live.selftest``.
            say: called with each message for the user.
            add_note: called with a note on the whole session.
            conversion: of the device's values to N.

        Returns:
            The baseline above the stored rest of the device, (S,), N; None if none is stored.

        Raises:
            InputError: the settings in use hide dangerous touches.
        """
        found = verify_source(source, conversion, self.model.positions, self.model.size)
        if found.text:
            say(found.text)
        if found.state == "unverified":
            add_note(Note("unverified", detail=found.text))
        presses, largest = nominal.presses, largest_force(conversion, source.raw_range)
        if presses is not None:
            engine.short = largest < MARGIN * np.diagonal(presses)
        if engine.guarantee is not None:
            engine.guarantee = engine.guarantee.on_device(
                engine.detection == nominal.detection,
                not np.any(engine.short),
                # The mechanics of an emulated skin may be others than those of the guarantee.
                source.port is None
                or (found.state in ("checked", "declared") and bool(np.isfinite(largest).all())),
            )
        if not test:
            say("no self-test: live.selftest=false")
        elif presses is None or not self.model.alarms:
            say("no self-test: this run brings no alarm or no simulated skin")
        else:
            SelfTest(presses, engine, nominal).run(conversion, source.raw_range, say)
        if presses is not None and conversion.noise is not None:
            visible = presses >= minimum_visible(conversion.noise, engine.detection.threshold)
            if alone := np.flatnonzero(visible.sum(axis=1) < 2).tolist():
                say(f"no neighbour would show that the wire of {sensor_list(alone)} breaks to its rest value")
        stored = found.check.rest if found.check else source.calibrated_rest
        return (
            None
            if stored is None or conversion.rest is None
            else np.asarray(conversion.rest - conversion.newtons(np.asarray(stored)))
        )

    def check_final(
        self,
        source: Source,
        engine: Engine,
        nominal: Engine,
        test: bool,
        say: Callable[[str], None],
        point: OperatingPoint,
    ) -> None:
        """Run the self-test with the threshold that follows a provisional one, once there is a baseline.

        Args:
            source, engine, nominal, test, say: as in :meth:`check`.
            point: the threshold.

        Raises:
            InputError: it hides dangerous touches.
        """
        while (conversion := source.tare.conversion) is None:
            sleep(0.1)
        used, usual = (
            replace(each, patience=replace(engine.patience, above=point.threshold), danger=point.score)
            for each in (engine, nominal)
        )
        if test and used.presses is not None:
            SelfTest(used.presses, used, usual).run(conversion, source.raw_range, say)


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
    source = SerialSource(
        Port.select(device), len(model.positions), model.rate, inwards=bool(device.get("inwards"))
    ).open_source()
    opened.enter_context(source.skin)
    say(f"loaded {model.title} from {path}, exported by version {model.metadata.version}")
    return LiveSetup(model, source.name, source, lambda: source, partial(Mechanics.of, None, False))


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
    from skin.runs.build import build_device, equation10_warning, load_model, with_axes_of
    from skin.runs.run import find_run

    torch.set_num_threads(config.tracking.threads or 1)
    run = find_run(config.tracking, name, config.trust)
    configured = with_axes_of(run.stored, run.configured(overrides))
    device = build_device(configured)
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
    model = load_model(run, trained, configured, touch=touch, alarm=False)
    # Contacts take all channels that the device sends.
    whole = build_device(trained) if configured.device.get("inwards") else model.device
    mechanics = partial(Mechanics.of, whole.reference, bool(config.device.get("calibration")))

    return LiveSetup(
        model, device.name if port is None else port.name, port, partial(open_source, device), mechanics
    )


def largest_force(conversion: UnitConversion, device: RawRange) -> np.ndarray:
    """Return the largest force, (S,), N, that each sensor of a device can show; NaN where it is unknown."""
    bounds = zip(device.limits, (device.minimum, device.maximum), strict=True)
    least, most = np.array([bound if limit is None else limit for limit, bound in bounds], float)
    return conversion.newtons(np.where(conversion.scale > 0, most, least))


def engine_settings(
    model: Model,
    patience: DebounceSettings,
    touch: float | None = None,
    drift: float = 600 * DRIFT,
    danger: DangerScore | None = None,
    guarantee: Guarantee | None = None,
) -> Engine:
    """Return an engine for a model.

    Args:
        model: that predicts.
        patience: settings of debouncing, with the threshold of the alarm.
        touch: contact threshold, N above the baseline; None: that of the model, and the learned label
            ``touch`` counts as touch, too.
        drift: N in ten minutes that the baseline may follow without touch.
        danger, guarantee: as in :class:`Engine`.

    Raises:
        InputError: ``touch`` is neither given nor known, or the model estimates targets.
    """
    if model.task.kind == "regression":
        raise InputError(
            f"{model.title} estimates {', '.join(model.task.names)}: skin live shows labels or classes, so "
            "give a run of those"
        )
    return Engine(
        model.probabilities,
        model.task,
        len(model.positions),
        model.window,
        model.rate,
        Detection(
            model.contact if touch is None else touch,
            drift / 600,
            model.learned and touch is None,
            model.longest,
        ),
        patience,
        model.presses,
        danger,
        guarantee,
        # All channels of a site but the last.
        np.append((np.diff(model.positions, axis=0) == 0).all(1), False),
    )


def measured_rate(
    skin: Skin,
    patience: float = 3.0,
    enough: int = 20,
    shown: float = 0.2,
    bursts: float = 5.0,
    usual: float = 100.0,
    clock: Callable[[], float] = monotonic,
) -> float:
    """Return the rate of a device, Hz: measured, else that of its header, else the usual one.

    Waits for its first frame, which is discarded, and until frames arrive at the rate of the device's clock:
    its unit may have to be inferred.

    Args:
        skin: open.
        patience: s to wait.
        enough: frames that show the rate.
        shown: s from which the rate of arrivals shows.
        bursts: times the rate that frames in bursts may seem to arrive with; a unit is wrong by 1000.
        usual: Hz, of a device whose rate is not known.
        clock: gives the host's monotonic time, s.
    """
    begin, before = clock(), skin.stats.frames
    with suppress(SkinTimeout):
        skin.read(1, patience)
    while (passed := clock() - begin) < patience:
        sleep(0.01)
        stats = skin.stats
        arrived = (stats.frames - before) / max(passed, shown)
        if stats.frames >= enough and arrived / bursts < stats.rate_hz < arrived * bursts:
            break
    return skin.stats.rate_hz or (skin.header and skin.header.rate) or usual
