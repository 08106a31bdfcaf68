"""Make an engine from a finished run."""

from dataclasses import dataclass, replace

from omegaconf import DictConfig, OmegaConf

from skin.device.base import AbstractDevice
from skin.device.recording import Recorded
from skin.device.serial import Serial
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.hardware.live.engine import Detection, Engine
from skin.hardware.live.verdict import Patience
from skin.signal.contact_detection import DRIFT
from skin.signal.contact_threshold import Threshold, rise
from skin.trained import Trained
from skin.wire.conversion import newtons
from skin.wire.open import open_skin
from skin.wire.skin import Skin
from skin.wire.tare import Tare

__all__ = ["Source", "advice", "engine", "source"]

_FAINT = 0.3  # N that end a contact where nothing else is known
_MANY = 4000  # windows of streams, a tenth of which tunes what touch is


@dataclass(frozen=True)
class Source:
    """Where frames come from.

    Attributes:
        name: of it, for a person.
        skin: open.
        tare: finds out what its values mean.
    """

    name: str
    skin: Skin
    tare: Tare


def source(device: AbstractDevice) -> Source:
    """Open a skin at a port, a recording, or the simulator, as the configuration names the device.

    Raises:
        InputError: it cannot be opened, or is a device that has no stream.
    """
    if isinstance(device, Serial):
        skin, _ = device.open(reconnect=True)
        return Source(str(device.port), skin, device.taring(skin))
    # Its readings are N, and what a run has learnt from such is without a baseline too.
    if isinstance(device, Recorded):
        return Source(device.path, open_skin(device.path, device.sensors), _plain(len(device.sensors)))
    if isinstance(device, Simulated):
        return Source("simulator", open_skin("simulated", device=device), _plain(len(device.sensors)))
    raise InputError(
        "only a skin at a port, a recording or the simulator can be watched: give device=serial "
        "device.port=/dev/ttyACM0, device=recording device.path=FILE.parquet, or leave out device="
    )


def _plain(sensors: int) -> Tare:
    return Tare(lambda baseline, header: newtons(sensors, None, 1.0, None, None), 0.0, 1.0)


def engine(of: Trained, patience: Patience, touch: float | None = None, drift: float = 600 * DRIFT) -> Engine:
    """Return the engine of a run.

    Args:
        of: the run.
        patience: how long answers must hold.
        touch: N above its baseline from which on a reading is a touch; None: tuned on simulated streams of
            its device, and what the run has learned about touch counts too.
        drift: N in ten minutes that the baseline may follow while nothing touches.

    Raises:
        InputError: neither learned nor given, and no device that has streams; or no probability can raise
            the alarm of the run.
    """
    if patience.above is None and of.point is not None:
        if of.point.silent:
            raise InputError(f"{of.point.warning()}: give live.patience.above=0.5, or train another run")
        patience = replace(patience, above=of.point.threshold)
    task = of.device.task
    learned = touch is None and task.gate is not None
    least = _tuned(of.device, learned) if touch is None else touch
    detection = Detection(least, drift / 600, learned, _longest(of))
    return Engine(of.learner, task, of.positions, of.window, of.rate, detection, patience)


def _longest(of: Trained) -> float:
    """Return the longest touch that a run was trained on, s; two thirds of its window if nobody knows."""
    frames = of.window * 2 / 3
    if isinstance(of.device, Simulated):
        frames = of.device.sampler.settings.press[1]
    return frames / of.rate


def _tuned(device: AbstractDevice, learned: bool) -> float:
    if not isinstance(device, Simulated):
        if learned:
            return _FAINT
        raise InputError(
            "this run does not know what no touch is: give live.touch=0.3 (N), or train on streams"
        )
    known = device.replace(stream=True, direction=False, tare=True, gestures=_MANY).touches("validation")
    assert known.labels is not None
    return Threshold.tuned(rise(known), known.labels[:, -1] > 0.5).least


def advice(stored: DictConfig, device: AbstractDevice) -> str | None:
    """Return what to say of a run that watches a real skin with what it learned from equation 10, or None.

    Args:
        stored: the run's configuration.
        device: what is watched.
    """
    reading = OmegaConf.select(stored, "device.simulator.reading")
    if reading != "equation10" or not isinstance(device, Serial):
        return None
    return (
        "warning: this run learned from simulator=fem and equation 10, which does not carry over to other "
        "mechanics (docs/results.md): train one with simulator=solid for a real skin"
    )
