"""What a live view watches: an engine and the source of its frames. torch is not imported."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from skin.errors import InputError
from skin.exported.model import ExportedModel
from skin.hardware.live.engine import Detection, Engine
from skin.hardware.live.live_settings import LiveSettings
from skin.wire.serial_source import SerialSource
from skin.wire.source import Source


@dataclass(frozen=True)
class Watched:
    """An engine and what it is fed with.

    Attributes:
        title: of the run.
        engine: of the run.
        open: opens the source of the frames.
        positions: of the sensors, (S, 3), m.
        size: extent (x, y) of the sheet, m.
    """

    title: str
    engine: Engine
    open: Callable[[], Source]
    positions: np.ndarray
    size: tuple[float, float]

    @property
    def span(self) -> float:
        """Length of the window, s."""
        return self.engine.window.frames / self.engine.window.rate


def watch_model(
    path: str, device: Mapping[str, Any], live: LiveSettings, say: Callable[[str], None]
) -> Watched:
    """Return an exported network and a skin at a port.

    Args:
        path: of the ONNX file.
        device: settings of ``device=serial``.
        live: settings of the live view.
        say: called with each message for the user.

    Raises:
        InputError: the file cannot be used, or the device is no skin at a port.
    """
    if "port" not in device:
        raise InputError(
            f"run={path} watches a skin at a port: add device=serial device.port=/dev/ttyACM0, or give the "
            "run itself for a recording or the simulator"
        )
    model = ExportedModel(path)
    about, patience = model.metadata, live.patience
    if patience.above is None and about.threshold is not None:
        if about.threshold >= 1:
            raise InputError(f"{path} has no threshold that raises an alarm: give live.patience.above=0.5")
        patience = replace(patience, above=about.threshold)
    detection = Detection(
        about.contact if live.touch is None else live.touch,
        live.drift / 600,
        about.learned and live.touch is None,
        about.longest,
    )
    sensors = len(about.positions)
    engine = Engine(model.probabilities, about.task, sensors, about.window, about.rate, detection, patience)
    names = {one.name for one in fields(SerialSource)}
    settings = {name: value for name, value in device.items() if name in names}
    source = SerialSource(sensors=sensors, rate=about.rate, **settings)
    say(f"loaded {about.title} from {path}, exported by version {about.version}")
    if patience.above is not None:
        say(f"alarm above {patience.above:.4f}")
    return Watched(about.title, engine, source.source, np.array(about.positions), about.size)
