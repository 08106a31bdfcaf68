"""Build an engine from a finished run."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from skin import __version__
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.evaluation.operating_point import Predictor
from skin.exported.metadata import ModelMetadata
from skin.hardware.live.engine import Classify, DebounceSettings, Detection, Engine, EngineSettings
from skin.hardware.wired import AbstractWired
from skin.recording import Touches
from skin.signal.contact_detection import DRIFT
from skin.signal.contact_threshold import ContactThreshold, rise
from skin.trained import Trained

_FAINT = 0.3  # N, default contact threshold
_MANY = 4000  # windows of streams, a tenth of which tunes the contact threshold


def nominal_settings(of: Trained, above: float | None = None) -> EngineSettings:
    """Return the settings of the engine of a run that it brings itself.

    Args:
        of: the run.
        above: threshold of its alarm; None: 0.5.

    Raises:
        InputError: the device of the run has no streams on which a contact threshold could be tuned.
    """
    return EngineSettings(
        window_classifier(of.learner, of.positions, of.rate),
        of.device.task,
        len(of.positions),
        of.window,
        of.rate,
        _detection(of, None),
        DebounceSettings(above=above),
        press_readings(of),
    )


def make_engine(
    of: Trained, patience: DebounceSettings, touch: float | None = None, drift: float = 600 * DRIFT
) -> Engine:
    """Return the engine of a run with its own threshold.

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
    shape = len(of.positions), of.window, of.rate
    classify = window_classifier(of.learner, of.positions, of.rate)
    detection = _detection(of, touch, drift)
    return Engine(classify, of.device.task, *shape, detection, patience, press_readings(of))


def press_readings(of: Trained) -> np.ndarray | None:
    """Return the readings (S, S), N, of a press at the limit on each sensor; None: nothing is simulated."""
    return None if of.device.reference is None else of.device.reference.press_readings().double().numpy()


def window_classifier(learner: Predictor, positions: Tensor, rate: float) -> Classify:
    """Return a function of the readings and validity of windows that asks a learner.

    Args:
        learner: trained.
        positions: (S, 3), m.
        rate: Hz.
    """

    @torch.inference_mode()
    def classify(readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        windows = torch.from_numpy(readings), torch.from_numpy(valid)
        return learner.probabilities(Touches(*windows, positions, None, rate)).numpy()

    return classify


def describe(
    of: Trained,
    run: str,
    title: str,
    touch: float | None = None,
    thresholds: Mapping[float, float] | None = None,
) -> ModelMetadata:
    """Return the description of a run for an exported file.

    Args:
        of: the run.
        run: its id.
        title: its name.
        touch: as in :func:`make_engine`.
        thresholds: rate of a device, Hz -> threshold of the alarm; None: that of ``of`` only.

    Raises:
        InputError: as in :func:`make_engine`.
    """
    task, detection, presses = of.device.task, _detection(of, touch), press_readings(of)
    return ModelMetadata(
        run=run,
        title=title,
        version=__version__,
        labels=list(task.names),
        kind=task.kind,
        gate=task.gate,
        direction=task.direction,
        rate=of.rate,
        window=of.window,
        positions=of.positions.tolist(),
        size=of.device.size,
        saturation=None if of.device.reference is None else of.device.reference.imperfection.clip,
        threshold=None if of.point is None else of.point.threshold,
        contact=detection.threshold,
        learned=detection.learned,
        longest=detection.longest,
        thresholds={f"{rate:g}": value for rate, value in thresholds.items()} if thresholds else None,
        presses=None if presses is None else presses.round(4).tolist(),
    )


def _detection(of: Trained, touch: float | None, drift: float = 600 * DRIFT) -> Detection:
    learned = touch is None and of.device.task.gate is not None
    least = _tuned(of.device, learned) if touch is None else touch
    return Detection(least, drift / 600, learned, longest_touch(of))


def longest_touch(of: Trained) -> float:
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


def simulator_warning(stored: DictConfig, device: AbstractDevice | None = None) -> str | None:
    """Return a warning if a run trained with equation 10 is used on a real skin; else None.

    Args:
        stored: the run's configuration.
        device: the watched device; None: a real skin.
    """
    reading = OmegaConf.select(stored, "device.simulator.reading")
    if reading != "equation10" or not (device is None or isinstance(device, AbstractWired)):
        return None
    return (
        "warning: this run learned from simulator=fem and equation 10, which does not carry over to other "
        "mechanics (docs/results.md): train one with simulator=solid for a real skin"
    )
