"""Frame to verdict on one core; run in a process of its own.

skin bench benchmark=live_latency                       # the best row, untrained
skin bench benchmark=live_latency benchmark.run=latest  # what a run has learnt
"""

import time

import numpy as np
import psutil
import torch

from experiments.benchmarks.harness import training_config
from skin.build import build_data, build_device, build_learner
from skin.device.base import AbstractSimulated
from skin.hardware.live.engine import Detection, Engine
from skin.learner.network import Network
from skin.model_of_run import window_classifier
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion

RATE = 100.0  # Hz, of the device
ROW = "best_fresh"
# Where a row is not measured on the default skin: the largest of its distribution.
_SETTINGS = {"any_skin": ("device=simulated", "simulator=solid", "layout=random", "layout.count=64")}
_WARM = 50  # verdicts that are not counted
_TOUCH = 0.3  # N


def measure_latency(
    frames: int = 1000, row: str = ROW, run: str | None = None, uri: str | None = None
) -> dict[str, float]:
    """Return the time from a frame at 100 Hz to the verdict on it, ms: median and the 99th percentile.

    One thread classifies every frame of a simulated stream of touches. ``core_ms`` is the 99th percentile of
    the processor time, which excludes other processes; ``memory_mb`` is that of the process at its end.

    Args:
        frames: number of classified frames.
        row: of the table, untrained, because speed does not depend on the weights.
        run: prefix of the id of a finished run to use instead, or ``latest``.
        uri: of the store with that run; None: the default.
    """
    torch.set_num_threads(1)
    device, engine = _untrained(row) if run is None else _trained(run, uri)
    return time_verdicts(device, engine, frames)


def time_verdicts(device: AbstractSimulated, engine: Engine, frames: int) -> dict[str, float]:
    """Return the times of :func:`measure_latency` for an engine on a stream of a device."""
    taken = np.array([_seconds(engine, frame) for frame in _stream(device, engine, frames + _WARM)])[_WARM:]
    wall, core = 1e3 * taken.T
    return {
        "p50_ms": float(np.median(wall)),
        "p99_ms": float(np.percentile(wall, 99)),
        "core_ms": float(np.percentile(core, 99)),
        "core_share": float(core.mean() * RATE / 1e3),
        "memory_mb": psutil.Process().memory_info().rss / 1e6,
    }


def _untrained(row: str) -> tuple[AbstractSimulated, Engine]:
    settings = _SETTINGS.get(row, ("simulator=naive",))
    config = training_config(*settings, f"experiment={row}", "data.gestures=10")
    device, learner = build_device(config).simulated("the stream is simulated"), build_learner(config)
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    positions = data.example.positions
    classify = window_classifier(learner, positions, device.model_rate)
    return device, Engine(
        classify, device.task, len(positions), device.window, device.model_rate, Detection(_TOUCH)
    )


def _trained(run: str, uri: str | None) -> tuple[AbstractSimulated, Engine]:
    from skin.finished_run import find_run
    from skin.hardware.live.engine_builder import engine_settings
    from skin.hardware.live.verdict import DebounceSettings
    from skin.model_of_run import load_model
    from skin.tracking import Store

    config = training_config(*([f"tracking.uri={uri}"] if uri else []))
    found = find_run(Store.open(config.tracking), run)
    of = load_model(found, found.configured(config, []))
    device = of.device.simulated("the stream is simulated")
    return device, engine_settings(of, DebounceSettings(), _TOUCH).build()


def _stream(device: AbstractSimulated, engine: Engine, count: int) -> list[Frame]:
    """Return frames at 100 Hz, after the engine's window has been filled with frames."""
    held = round(RATE / device.model_rate)
    ahead = held * device.window
    whole = device.simulate_stream((ahead + count) // held + 1).whole.touches
    values = np.repeat(whole.readings[0].double().numpy(), held, axis=0)[: ahead + count]
    valid = np.ones(values.shape[1], dtype=bool)
    frames = [Frame(n, n / RATE, n / RATE, row, valid) for n, row in enumerate(values)]
    for frame in frames[:ahead]:
        engine.push([frame], None)
    return frames[ahead:]


def _seconds(engine: Engine, frame: Frame) -> tuple[float, float]:
    """Return the duration of a verdict as wall time and as processor time, s."""
    sensors = engine.window.sensors
    known = UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, dtype=bool))
    wall, core = time.perf_counter(), time.thread_time()
    engine.push([frame], known)
    return time.perf_counter() - wall, time.thread_time() - core
