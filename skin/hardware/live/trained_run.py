"""A finished run for a live view."""

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from math import log
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mlflow.entities import Run
from omegaconf import DictConfig

from skin import array_cache
from skin.build import build_device
from skin.config import plain
from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.evaluation import operating_point
from skin.evaluation.operating_point import LABEL, OperatingPoint, Watching, choose_for_touches
from skin.hardware.live import engine_builder
from skin.hardware.live.live_settings import LiveSettings
from skin.hardware.live.watched import Watched, measured_rate, used_settings
from skin.hardware.wired import AbstractWired, open_source
from skin.progress import Steps
from skin.run_overrides import apply_overrides
from skin.signal import decisions, device_sampling, imperfection
from skin.signal.calibration import Calibration, read_calibration
from skin.stored_run import find_run, load_configuration, load_operating_point
from skin.tracking import Store
from skin.trained import Trained, load_trained, threshold_device

_EXPECTED = 20.0  # s
_RATIOS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)  # of the rate of a device to that of the model
_SOURCES = (operating_point, decisions, device_sampling, imperfection)


def watch_run(
    config: DictConfig,
    live: LiveSettings,
    say: Callable[[str], None],
    given: Sequence[str],
    opened: ExitStack,
    own_mechanics: bool = False,
) -> Watched:
    """Return a finished run and the device of a configuration.

    Args:
        config: of the command.
        live: settings of the live view.
        say: called with each message for the user.
        given: settings that replace those of the run, as overrides; ``config`` has their values.
        opened: closes the device in the end.
        own_mechanics: the device has the mechanics of the run, though it is at a port.

    Raises:
        InputError: there is no such run, it cannot be loaded, or the device cannot be opened.
    """
    torch.set_num_threads(config.tracking.threads or 1)
    store = Store.existing(config.tracking)
    run = find_run(store, config.run)
    stored = load_configuration(store, run, config.trust)
    watched = apply_overrides(stored, config, given)
    device = build_device(watched)
    # A port is opened first: that it is missing must not take as long to say as a run takes to load.
    source = open_source(device) if isinstance(device, AbstractWired) else None
    if source is not None:
        opened.enter_context(source.skin)
    # The training data stay those of the run, for any watched device.
    words = [word for word in given if not word.startswith(("device=", "device."))]
    trained = apply_overrides(stored, config, words)
    title = str(run.info.run_name)
    say(f"loading {title} ({run.info.run_id[:8]})")
    if not own_mechanics and (advice := engine_builder.simulator_warning(stored, device)):
        say(advice)
    of = load_trained(store, run, trained, stored, choose=False)
    nominal = engine_builder.nominal_settings(of)
    above = live.patience.above
    if above is None and LABEL in of.device.task.names:
        rate = measured_rate(source.skin) if source is not None else of.rate
        watching = watching_of(of, nominal.detection.threshold, rate, live.patience.alarm, source is None)
        with Steps({"choosing the threshold of the alarm": _EXPECTED}):
            point = choose_threshold(of, run, stored, watched, watching, say)
        if point.silent:
            raise InputError(f"{point.warning()}: give live.patience.above=0.5, or train another run")
        say(point.sentence())
        above = point.threshold
    elif above is not None:
        say(f"alarm above {above:g}")
    # A threshold of the command line is tested against the usual one.
    chosen = above if live.patience.above is None else None
    nominal = replace(nominal, patience=replace(nominal.patience, above=chosen))
    if source is None:
        source = open_source(device)
        opened.enter_context(source.skin)
    used = used_settings(nominal, live)
    return Watched(title, source, used, nominal, of.positions.numpy(), of.device.size)


def watching_of(of: Trained, contact: float, rate: float, patience: float, aligned: bool) -> Watching:
    """Return how a live view watches a device.

    Args:
        of: the run.
        contact: threshold, N.
        rate: of the device, Hz; the nearest of some rates is used.
        patience: s for which decisions must be dangerous.
        aligned: whether the device gives the frames of the model.
    """
    longest, column = engine_builder.longest_touch(of), of.device.task.names.index(LABEL)
    # A measured rate is never the same twice, and the threshold would be chosen anew at each start.
    ratio = min(_RATIOS, key=lambda known: abs(log(known * of.rate / rate)))
    return Watching(ratio * of.rate, contact, longest, patience, column, aligned)


def choose_threshold(
    of: Trained,
    run: Run,
    stored: DictConfig,
    watched: DictConfig,
    watching: Watching,
    say: Callable[[str], None],
) -> OperatingPoint:
    """Return the operating point of a run for safe touches of a skin and a device; it is kept on disk.

    Args:
        of: the run, loaded.
        run: the run.
        stored: its configuration.
        watched: its configuration with the skin, the device and the profile to use.
        watching: how it is watched.
        say: called with each message for the user.

    Raises:
        InputError: there is no such profile, or the calibration cannot be read.
    """
    settings = watched.evaluation
    if "simulator" not in stored.device:
        point = load_operating_point(run, of.learner, stored, settings)
        assert point is not None  # it has the label
        return point
    device = threshold_device(stored, watched)
    path = watched.device.get("calibration") if watched.device.get("port") else None
    calibration = read_calibration(path) if path and settings.profile is None else None
    if calibration is not None:
        device = device.replace(**imperfections_of(calibration), randomise=True, calibration=None)
    target, count = settings.false_alarm_rate, min(settings.safe_gestures, operating_point.SAFE_TOUCHES)
    content = _content(run, stored, watched, watching, device) | {"target": target, "count": count}
    key = array_cache.hashed(content, [Path(str(module.__file__)) for module in _SOURCES])

    def choose() -> dict[str, np.ndarray]:
        devices = "" if settings.profile is None else f" and devices of the profile {settings.profile}"
        say(f"choosing the alarm's threshold on {count} safe touches at {watching.rate:.3g} Hz{devices}")
        threads = torch.get_num_threads()
        torch.set_num_threads(os.cpu_count() or 1)  # nothing is watched yet
        point = choose_for_touches(of.learner, device, watching, target, count)
        torch.set_num_threads(threads)
        return {"point": np.array([point.threshold, point.raised])}

    file = array_cache.folder(None) / f"threshold_{key[:16]}.npz"
    threshold, raised = array_cache.kept(file, key, {"point": (2,)}, choose)["point"].tolist()
    return OperatingPoint(threshold, target, count, int(raised), device.data_seed, rate=watching.rate)


def _content(
    run: Run, stored: DictConfig, watched: DictConfig, watching: Watching, device: AbstractSimulated
) -> dict[str, Any]:
    """Return what a threshold depends on."""
    skin = {group: plain(watched)[group] for group in ("body", "layout", "simulator", "touch")}
    imperfections = {name: str(value) for name, value in vars(device.imperfection).items()}
    return {
        "run": run.info.run_id,
        "device": plain(stored)["device"],
        "skin": skin,
        "positions": device.sensors.positions.round(9).tolist(),
        "imperfections": imperfections,
        "watching": asdict(watching),
    }


def imperfections_of(calibration: Calibration) -> dict[str, Any]:
    """Return the imperfections that a calibrated device is left with: its gains are known to 2 %."""
    values = calibration.values()
    names = ("noise", "hysteresis", "time_constant")
    left = {name: float(np.median(values[name])) for name in names}
    clip = float(np.median(values["clip"]))
    limit = {"clip": clip} if np.isfinite(clip) else {}
    return left | limit | {"gain_spread": 0.02, "dead": 0, "tare": True}
