"""Build the engine of a live view from a trained model, a skin and settings. torch is not imported."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from time import monotonic
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le
from hydra import compose

from skin.core.settings import configured
from skin.errors import InputError
from skin.evaluation.decisions import DRIFT
from skin.hardware.live.engine import DebounceSettings, Detection, EngineSettings
from skin.hardware.live.selftest import SelfTest
from skin.hardware.wire.channels import UnitConversion
from skin.hardware.wire.reader import PortSettings, SkinTimeout
from skin.hardware.wire.skin import Skin
from skin.hardware.wire.source import SerialSource, Source
from skin.runs.configuration import Config
from skin.runs.exported.model import ExportedModel
from skin.runs.trained_model import TrainedModel

# The settings of ``skin live``.


@dataclass(frozen=True)
class LiveSettings:
    """Settings under ``live:`` (``conf/live.yaml``).

    Attributes:
        web_port: port of the page; 0: any free one.
        top: upper end of the colour scale, N.
        touch: contact threshold, N above the baseline; None: that of the run.
        drift: N in ten minutes that the baseline may follow without touch.
        verdicts: where JSON lines go: ``stdout``, or a TCP port, 0: any free one; None: nowhere.
        log: file to which alarms are appended; None: no log.
        selftest: whether simulated dangerous touches must raise the alarm at the start.
        patience: settings of debouncing.
    """

    web_port: Annotated[int, Ge(0), Le(65535)]
    top: Annotated[float, Gt(0)]
    touch: Annotated[float, Gt(0)] | None
    drift: Annotated[float, Ge(0)]
    verdicts: Literal["stdout"] | Annotated[int, Ge(0), Le(65535)] | None
    log: str | None
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


@dataclass(frozen=True)
class Watched:
    """The settings of an engine and what it is fed with.

    Attributes:
        model: that predicts.
        source: open.
        settings: of the engine, in use.
        nominal: those that the model brings.
    """

    model: TrainedModel
    source: Source
    settings: EngineSettings
    nominal: EngineSettings

    @property
    def span(self) -> float:
        """Length of the window, s."""
        return self.settings.frames / self.settings.rate

    @property
    def selftest(self) -> SelfTest | None:
        """The test of the alarm; None where no alarm is raised, or no touches are known."""
        if self.nominal.presses is None or not self.model.alarms:
            return None
        return SelfTest(self.nominal.presses, self.settings, self.nominal)

    def check(self, test: bool, say: Callable[[str], None], conversion: UnitConversion) -> None:
        """Run the self-test with the conversion that is in use.

        Args:
            test: ``live.selftest``.
            say: called with each message for the user.
            conversion: of the device's values to N.

        Raises:
            InputError: the settings in use hide dangerous touches.
        """
        if not test:
            say("no self-test: live.selftest=false")
        elif (selftest := self.selftest) is None:
            say("no self-test: this run brings no alarm or no simulated skin")
        else:
            selftest.run(conversion, self.source.raw_range, say)


def watch_exported(
    path: str, device: Mapping[str, Any], live: LiveSettings, say: Callable[[str], None], opened: ExitStack
) -> Watched:
    """Return an exported network and a skin at a port.

    Args:
        path: of the ONNX file.
        device: settings of ``device=serial``.
        live: settings of the live view.
        say: called with each message for the user.
        opened: closes the port in the end.

    Raises:
        InputError: the file cannot be used, or the device is no skin at a port, or cannot be opened.
    """
    if "port" not in device:
        raise InputError(
            f"run={path} watches a skin at a port: add device=serial device.port=/dev/ttyACM0, or give the "
            "run itself for a recording or the simulator"
        )
    model = ExportedModel(path)
    source = SerialSource(PortSettings.select(device), len(model.positions), model.rate).open_source()
    opened.enter_context(source.skin)
    say(f"loaded {model.title} from {path}, exported by version {model.metadata.version}")
    return watch(model, source, live, say, lambda: source)


def watch_run(
    config: Config,
    live: LiveSettings,
    say: Callable[[str], None],
    overrides: Sequence[str],
    opened: ExitStack,
    own_mechanics: bool = False,
) -> Watched:
    """Return a finished run and the device of a configuration.

    Args:
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

    from skin.hardware.serial import open_source
    from skin.runs.build import build_device
    from skin.runs.finished_run import FinishedRun
    from skin.runs.model_of_run import equation10_warning, load_model

    torch.set_num_threads(config.tracking.threads or 1)
    run = FinishedRun.named(config)
    composed = compose("live", [*overrides])
    watched = run.configured(composed, overrides)
    device = build_device(watched)
    # A port is opened first: that it is missing must not take as long to say as a run takes to load.
    port = open_source(device) if device.real else None
    if port is not None:
        opened.enter_context(port.skin)
    # The training data stay those of the run, for any watched device.
    trained = run.configured(
        composed, [word for word in overrides if not word.startswith(("device=", "device."))]
    )
    say(f"loading {run.title} ({run.identity[:8]})")
    if not own_mechanics and (advice := equation10_warning(run.stored, device)):
        say(advice)
    # Without a simulator nothing could tune a contact threshold.
    touch = None if "simulator" in run.stored.device else live.touch
    model = load_model(run, trained, watched, touch=touch, alarm=False)

    def begin() -> Source:
        source = open_source(device)
        opened.enter_context(source.skin)
        return source

    return watch(model, port, live, say, begin)


def engine_settings(
    model: TrainedModel,
    patience: DebounceSettings,
    touch: float | None = None,
    drift: float = 600 * DRIFT,
) -> EngineSettings:
    """Return the settings of the engine of a model.

    Args:
        model: that predicts.
        patience: settings of debouncing; without a threshold of the alarm, that of the model for windows.
        touch: contact threshold, N above the baseline; None: that of the model, and the learned label
            ``touch`` counts as touch, too.
        drift: N in ten minutes that the baseline may follow without touch.

    Raises:
        InputError: ``touch`` is neither given nor known, or the threshold raises no alarm.
    """
    contact = model.contact if touch is None else touch
    if patience.above is None and model.threshold is not None:
        if model.threshold >= 1:
            raise InputError(
                f"{model.title} has no threshold that raises an alarm: give live.patience.above=0.5, or "
                "train another run"
            )
        patience = replace(patience, above=model.threshold)
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


def watch(
    model: TrainedModel,
    port: Source | None,
    live: LiveSettings,
    say: Callable[[str], None],
    begin: Callable[[], Source],
) -> Watched:
    """Return a model and a skin with the settings of a live view.

    Args:
        model: that predicts.
        port: open source of a skin at a port; None: the skin is simulated or recorded.
        live: settings of the live view.
        say: called with each message for the user.
        begin: opens the source of a skin that is simulated or recorded.

    Raises:
        InputError: no contact threshold is known, or no threshold raises an alarm as seldom as wanted.
    """
    above = live.patience.above
    if above is not None:
        say(f"alarm above {above:g}")
        # A threshold of the command line is tested against the usual one.
        usual = model.threshold
    elif model.alarms:
        rate = model.rate if port is None else measured_rate(port.skin)
        above = usual = model.threshold_at(rate, live.patience.alarm, port is None, say)
    else:
        usual = None
    nominal = engine_settings(model, DebounceSettings(above=usual))
    detection = replace(
        nominal.detection,
        threshold=nominal.detection.threshold if live.touch is None else live.touch,
        drift=live.drift / 600,
        learned=nominal.detection.learned and live.touch is None,
    )
    used = replace(nominal, detection=detection, patience=replace(live.patience, above=above))
    return Watched(model, port or begin(), used, nominal)


def measured_rate(skin: Skin) -> float:
    """Return the rate of a device, Hz: measured, else that of its header, else the usual one.

    Waits some seconds for its first frames, which are discarded.
    """
    deadline = monotonic() + _PATIENCE
    while skin.stats.frames < _ENOUGH and monotonic() < deadline:
        try:
            skin.read(1, _PATIENCE / 10)
        except SkinTimeout:
            continue
    declared = skin.header.rate if skin.header is not None else None
    return skin.stats.rate_hz or declared or USUAL_RATE
