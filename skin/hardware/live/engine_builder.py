"""Build an engine from a finished run."""

from dataclasses import replace

from omegaconf import DictConfig, OmegaConf

from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.hardware.live.engine import Detection, Engine
from skin.hardware.live.verdict import DebounceSettings
from skin.signal.contact_detection import DRIFT
from skin.signal.contact_threshold import ContactThreshold, rise
from skin.trained import Trained

_FAINT = 0.3  # N, default contact threshold
_MANY = 4000  # windows of streams, a tenth of which tunes the contact threshold


def make_engine(
    of: Trained, patience: DebounceSettings, touch: float | None = None, drift: float = 600 * DRIFT
) -> Engine:
    """Return the engine of a run.

    Args:
        of: the run.
        patience: settings of debouncing.
        touch: contact threshold, N above the baseline; None: tuned on simulated streams of its device, and
            the learned label ``touch`` is used too.
        drift: N in ten minutes that the baseline may follow without touch.

    Raises:
        InputError: ``touch`` is neither given nor learned and the device has no streams; or the run cannot
            raise an alarm.
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
    """Return the longest touch that a run was trained on, s; two thirds of its window if unknown."""
    if of.device.reference is not None:
        return of.device.reference.sampler.settings.press[1]
    return of.window * 2 / 3 / of.rate


def _tuned(device: AbstractDevice, learned: bool) -> float:
    if device.reference is None:
        if learned:
            return _FAINT
        raise InputError("this run has no contact threshold: give live.touch=0.3 (N), or train on streams")
    known = device.reference.replace(stream=True, direction=False, tare=True, gestures=_MANY).touches(
        "validation"
    )
    assert known.labels is not None
    return ContactThreshold.tuned(rise(known), known.labels[:, -1] > 0.5).least


def simulator_warning(stored: DictConfig, device: AbstractDevice) -> str | None:
    """Return a warning if a run trained with equation 10 is used on a real skin; else None.

    Args:
        stored: the run's configuration.
        device: the watched device.
    """
    reading = OmegaConf.select(stored, "device.simulator.reading")
    if reading != "equation10" or device.wired is None:
        return None
    return (
        "warning: this run learned from simulator=fem and equation 10, which does not carry over to other "
        "mechanics (docs/results.md): train one with simulator=solid for a real skin"
    )
