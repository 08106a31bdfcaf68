"""What a live view watches: the settings of an engine and the source of its frames. torch is not imported."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import log
from time import monotonic
from typing import Any

import numpy as np

from skin.errors import InputError
from skin.exported.metadata import ModelMetadata
from skin.exported.model import ExportedModel
from skin.hardware.live.engine import DebounceSettings, Detection, EngineSettings
from skin.hardware.live.live_settings import LiveSettings
from skin.hardware.live.selftest import SelfTest
from skin.wire.channels import UnitConversion
from skin.wire.reader import PortSettings, SkinTimeout
from skin.wire.skin import Skin
from skin.wire.source import SerialSource, Source

USUAL_RATE = 100.0
"""Hz: of a device whose rate is not known yet, for the choice of a threshold."""

_PATIENCE = 3.0  # s
_ENOUGH = 20  # frames that show the rate


@dataclass(frozen=True)
class Watched:
    """The settings of an engine and what it is fed with.

    Attributes:
        title: of the run.
        source: open.
        settings: of the engine, in use.
        nominal: those that the run brings.
        positions: of the sensors, (S, 3), m.
        size: extent (x, y) of the sheet, m.
    """

    title: str
    source: Source
    settings: EngineSettings
    nominal: EngineSettings
    positions: np.ndarray
    size: tuple[float, float]

    @property
    def span(self) -> float:
        """Length of the window, s."""
        return self.settings.frames / self.settings.rate

    @property
    def selftest(self) -> SelfTest | None:
        """The test of the alarm; None where no alarm is raised, or no touches are known."""
        if self.nominal.presses is None or "dangerous" not in self.nominal.task.names:
            return None
        return SelfTest(self.nominal.presses, self.settings, self.nominal)


def watch_model(
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
    about = model.metadata
    source = SerialSource(PortSettings.select(device), len(about.positions), about.rate).open_source()
    opened.enter_context(source.skin)
    say(f"loaded {about.title} from {path}, exported by version {about.version}")
    given = live.patience.above
    above = about.threshold if given is not None else _threshold(about, source.skin, path, say)
    nominal = EngineSettings(
        model.probabilities,
        about.task,
        len(about.positions),
        about.window,
        about.rate,
        Detection(about.contact, learned=about.learned, longest=about.longest),
        DebounceSettings(above=above),
        None if about.presses is None else np.array(about.presses),
    )
    used = used_settings(nominal, live)
    if used.patience.above is not None:
        say(f"alarm above {used.patience.above:.4f}")
    return Watched(about.title, source, used, nominal, np.array(about.positions), about.size)


def used_settings(nominal: EngineSettings, live: LiveSettings) -> EngineSettings:
    """Return the settings of an engine with those of the live view in place of those of the run."""
    detection = replace(
        nominal.detection,
        threshold=nominal.detection.threshold if live.touch is None else live.touch,
        drift=live.drift / 600,
        learned=nominal.detection.learned and live.touch is None,
    )
    above = nominal.patience.above if live.patience.above is None else live.patience.above
    return replace(nominal, detection=detection, patience=replace(live.patience, above=above))


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


def check_settings(
    watched: Watched, wanted: bool, say: Callable[[str], None], conversion: UnitConversion
) -> None:
    """Run the self-test of a live view with the conversion that is in use.

    Args:
        watched: the run and the device.
        wanted: ``live.selftest``.
        say: called with each message for the user.
        conversion: of the device's values to N.

    Raises:
        InputError: the settings in use hide dangerous touches.
    """
    if not wanted:
        say("no self-test: live.selftest=false")
    elif (test := watched.selftest) is None:
        say("no self-test: this run brings no alarm or no simulated skin")
    else:
        test.run(conversion, watched.source.raw_range, say)


def _threshold(about: ModelMetadata, skin: Skin, path: str, say: Callable[[str], None]) -> float | None:
    """Return the threshold of the alarm for the rate of a device; None for a model without alarm."""
    if about.threshold is None:
        return None
    if about.thresholds:
        rate = measured_rate(skin)
        nearest = min(about.thresholds, key=lambda known: abs(log(float(known) / rate)))
        say(f"the device sends {rate:.3g} frames a second: threshold for {nearest} Hz, per touch")
        threshold = about.thresholds[nearest]
    else:
        say("the threshold was chosen for single windows: a touch has many, and raises more false alarms")
        threshold = about.threshold
    if threshold >= 1:
        raise InputError(f"{path} has no threshold that raises an alarm: give live.patience.above=0.5")
    return threshold
