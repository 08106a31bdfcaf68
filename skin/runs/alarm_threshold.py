"""Which threshold of the alarm holds for a finished run on a skin and a device.

The threshold for single windows is stored with a run (:func:`alarm_point`). That of the live view, which
judges many windows of a touch, depends on the rate of the device, too (:func:`alarm_point_for_touches`).
"""

import logging
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from skin.core import array_cache
from skin.device import imperfection
from skin.device import imperfection as device_sampling
from skin.device.base import AbstractDevice, AbstractSimulated
from skin.device.calibration import Calibration, read_calibration
from skin.errors import InputError
from skin.evaluation import decisions, operating_point
from skin.evaluation.operating_point import (
    OperatingPoint,
    Predictor,
    Watching,
    choose_for_touches,
    choose_operating_point,
)
from skin.evaluation.settings import Evaluation, check_evaluation
from skin.runs.build import build_device
from skin.runs.configuration import Config
from skin.runs.finished_run import FinishedRun
from skin.runs.overrides import profile_settings

_log = logging.getLogger(__name__)
_SOURCES = (operating_point, decisions, device_sampling, imperfection)


def alarm_point(
    run: FinishedRun,
    learner: Predictor,
    config: Config,
    one_skin: bool = False,
    device: AbstractDevice | None = None,
) -> OperatingPoint | None:
    """Return the operating point of a run for single windows; None if its task has no label ``dangerous``.

    Safe touches are more easily mistaken on some skins and devices than on others, so a threshold that was
    chosen over many of them has another false-alarm rate on each. A run that was trained on drawn skins gets
    one for its skin, and every run one for ``evaluation.profile``. Otherwise the stored one holds.

    Args:
        run: the run.
        learner: of the run, trained.
        config: its configuration with the skin to use.
        one_skin: the skin of ``config`` counts even if its device draws others.
        device: on which another threshold is chosen; None: that of :func:`threshold_device`.

    Raises:
        InputError: the stored operating point cannot be read; see also :func:`threshold_device`.
    """
    settings, stored = check_evaluation(config.evaluation), run.stored
    all_skins = "skins" in config.device and not one_skin
    same_profile = settings.profile == (stored.evaluation and stored.evaluation.profile)
    if all_skins or ("skins" not in stored.device and same_profile):
        return stored_point(run, learner, settings)
    return choose_operating_point(learner, device or threshold_device(stored, config), settings)


def stored_point(run: FinishedRun, learner: Predictor, settings: Evaluation) -> OperatingPoint | None:
    """Return the operating point that is stored with a run; None if its task has no label ``dangerous``.

    If the run has none for the target rate, it is chosen now if the device of its training draws fresh
    gestures; else the threshold is 0.5. Both cases are reported on standard error.

    Args:
        run: the run.
        learner: of the run, trained.
        settings: the target rate and the number of safe gestures.

    Raises:
        InputError: the stored operating point cannot be read.
    """
    point, target = run.point, settings.false_alarm_rate
    if run.stores_point and (point is None or point.target == target):
        return point
    lacks = f"run {run.identity} stores no alarm threshold for {100 * target:g} % false alarms"
    if "simulator" in run.stored.device:
        point = choose_operating_point(learner, build_device(run.stored), settings)
        message = None if point is None else f"{lacks}, it is chosen now: {point.sentence()}"
    else:
        point = point or OperatingPoint.default(target)
        message = (
            f"{lacks} and its device draws no fresh gestures: {point.sentence()}; train it again to store one"
        )
    if message:
        _log.warning(message)
    return point


def threshold_device(stored: Config, config: Config) -> AbstractSimulated:
    """Return the device whose fresh gestures determine the threshold of the alarm.

    It is the device of the training on the skin of ``config``. If ``evaluation.profile`` is set, every
    gesture is measured by another device of this profile.

    Args:
        stored: configuration of a training.
        config: the same with the skin to use.

    Raises:
        InputError: the training has no simulated touches, or there is no such profile.
    """
    profile, settings = check_evaluation(config.evaluation).profile, stored.device
    if "simulator" not in settings:
        raise InputError(
            f"evaluation.profile={profile} chooses the alarm's threshold on simulated touches, and this run "
            "was trained on others: leave it out"
        )
    skin = {group: getattr(config, group) for group in ("body", "layout", "simulator")}
    settings = settings | skin
    if profile is not None:
        settings |= profile_settings(profile)
        # Drawn skins draw a device for every gesture without being told.
        every = {} if "skins" in settings else {"randomise": True, "calibration": None}
        settings = {name: value for name, value in settings.items() if name != "randomise"} | every
    device = build_device(replace(stored, **skin, device=settings)).reference
    assert device is not None
    return device


def alarm_point_for_touches(
    run: FinishedRun,
    learner: Predictor,
    config: Config,
    watching: Watching,
    say: Callable[[str], None],
) -> OperatingPoint:
    """Return the operating point of a run for safe touches as the live view judges them; it is kept on disk.

    Args:
        run: the run; its task has the label ``dangerous``.
        learner: of the run, trained.
        config: its configuration with the skin, the device and the profile to use.
        watching: how the device is watched.
        say: called with each message for the user.

    Raises:
        InputError: there is no such profile, or the calibration cannot be read.
    """
    settings = check_evaluation(config.evaluation)
    if "simulator" not in run.stored.device:
        point = stored_point(run, learner, settings)
        assert point is not None  # it has the label
        return point
    device = threshold_device(run.stored, config)
    path = config.device.get("calibration") if config.device.get("port") else None
    calibration = read_calibration(path) if path and settings.profile is None else None
    if calibration is not None:
        device = device.replace(**_remaining(calibration), randomise=True, calibration=None)
    target, count = settings.false_alarm_rate, min(settings.safe_gestures, operating_point.SAFE_TOUCHES)
    content = _content(run, config, watching, device) | {"target": target, "count": count}
    key = array_cache.hashed(content, [Path(str(module.__file__)) for module in _SOURCES])

    def choose() -> dict[str, np.ndarray]:
        devices = "" if settings.profile is None else f" and devices of the profile {settings.profile}"
        say(f"choosing the alarm's threshold on {count} safe touches at {watching.rate:.3g} Hz{devices}")
        threads = torch.get_num_threads()
        torch.set_num_threads(os.cpu_count() or 1)  # nothing is watched yet
        point = choose_for_touches(learner, device, watching, target, count)
        torch.set_num_threads(threads)
        return {"point": np.array([point.threshold, point.raised])}

    file = array_cache.folder(None) / f"threshold_{key[:16]}.npz"
    threshold, raised = array_cache.kept(file, key, {"point": (2,)}, choose)["point"].tolist()
    return OperatingPoint(threshold, target, count, int(raised), device.data_seed, rate=watching.rate)


def _content(
    run: FinishedRun, config: Config, watching: Watching, device: AbstractSimulated
) -> dict[str, Any]:
    """Return what a threshold depends on."""
    imperfections = {name: str(value) for name, value in vars(device.imperfection).items()}
    return {
        "run": run.identity,
        "device": run.stored.device,
        "skin": {group: getattr(config, group) for group in ("body", "layout", "simulator", "touch")},
        "positions": device.sensors.positions.round(9).tolist(),
        "imperfections": imperfections,
        "watching": asdict(watching),
    }


def _remaining(calibration: Calibration) -> dict[str, Any]:
    """Return the imperfections that a calibrated device is left with: its gains are known to 2 %."""
    values = calibration.values()
    names = ("noise", "hysteresis", "time_constant")
    left = {name: float(np.median(values[name])) for name in names}
    clip = float(np.median(values["clip"]))
    limit = {"clip": clip} if np.isfinite(clip) else {}
    return left | limit | {"gain_spread": 0.02, "dead": 0, "tare": True}
