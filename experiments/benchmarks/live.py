"""What a live view waits for: lines, and verdicts on one core. Each runs in a process of its own."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil
import torch

from experiments.benchmarks.harness import training_config
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.hardware.live.engine import Detection, Engine
from skin.hardware.wire.channels import UnitConversion
from skin.hardware.wire.decoder import Decoder
from skin.hardware.wire.protocol import encode_line
from skin.learning.data import TouchData
from skin.learning.learner.network import Network
from skin.runs.build import build_data, build_device, build_learner
from skin.runs.exported.model import ExportedModel
from skin.runs.exported.writer import write_model
from skin.runs.model_of_run import RunModel, window_classifier

RATE = 100.0  # Hz, of the device
_SENSORS = 25
_PIECE = 512  # bytes that a port gives at a time
# Where a row is not measured on the default skin: the largest of its distribution.
_SETTINGS = {"any_skin": ("device=simulated", "simulator=solid", "layout=random", "layout.count=64")}
_WARM = 50  # verdicts that are not counted
_TOUCH = 0.3  # N


def measure_decoder(rate: float = 1000.0, frames: int = 20_000) -> dict[str, float]:
    """Return the share of one core that decoding 25 channels at ``rate`` Hz takes."""
    values = [
        [(number * (7 + channel) + 31 * channel) % 1024 for channel in range(_SENSORS)]
        for number in range(frames)
    ]
    data = b"".join(
        encode_line(line, number, round(1e6 * number / rate)) for number, line in enumerate(values)
    )
    decoder, decoded, began = Decoder(_SENSORS), 0, time.process_time()
    for start in range(0, len(data), _PIECE):
        decoded += len(decoder.feed(data[start : start + _PIECE], start / len(data) * frames / rate))
    assert decoded == frames
    return {"decode_core_share": (time.process_time() - began) / frames * rate}


def measure_latency(row: str, frames: int) -> dict[str, float]:
    """Return the time from a frame at 100 Hz to the verdict on it, ms: median and the 99th percentile.

    One thread classifies every frame of a simulated stream of touches. ``core_ms`` is the 99th percentile of
    the processor time, which excludes other processes; ``memory_mb`` is that of the process at its end.

    Args:
        row: of the table, untrained, because speed does not depend on the weights.
        frames: number of classified frames.
    """
    torch.set_num_threads(1)
    device, learner, data = _untrained(row)
    positions = data.example.positions
    classify = window_classifier(learner, positions, device.model_rate)
    engine = Engine(
        classify, device.task, len(positions), device.window, device.model_rate, Detection(_TOUCH)
    )
    return _time_verdicts(device, engine, frames)


def measure_onnx_latency(row: str, frames: int) -> dict[str, float]:
    """Return the times of :func:`measure_latency` for the exported row, without torch in the engine."""
    torch.set_num_threads(1)
    device, learner, data = _untrained(row)
    touches = data.touches("train")
    model = RunModel(device, learner, data.example, touch=_TOUCH)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        write_model(learner.pipeline(model.places), model.describe(), touches, path)
        exported = ExportedModel(path)
    about = exported.metadata
    engine = Engine(
        exported.probabilities, about.task, len(about.positions), about.window, about.rate, Detection(_TOUCH)
    )
    return _time_verdicts(device, engine, frames)


def _untrained(row: str) -> tuple[AbstractSimulated, Network, TouchData]:
    """Return the device of a row, its network with random weights, and a few touches."""
    config = training_config(
        *_SETTINGS.get(row, ("simulator=naive",)), f"experiment={row}", "data.gestures=100"
    )
    device, learner = build_device(config).simulated("the stream is simulated"), build_learner(config)
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    return device, learner, data


def _time_verdicts(device: AbstractSimulated, engine: Engine, frames: int) -> dict[str, float]:
    """Return the times of :func:`measure_latency` for an engine on a stream of a device."""
    durations = np.array([_seconds(engine, frame) for frame in _stream(device, engine, frames + _WARM)])
    wall, core = 1e3 * durations[_WARM:].T
    return {
        "p50_ms": float(np.median(wall)),
        "p99_ms": float(np.percentile(wall, 99)),
        "core_ms": float(np.percentile(core, 99)),
        "core_share": float(core.mean() * RATE / 1e3),
        "memory_mb": psutil.Process().memory_info().rss / 1e6,
    }


def _stream(device: AbstractSimulated, engine: Engine, count: int) -> list[Frame]:
    """Return frames at 100 Hz, after the engine's window has been filled with frames."""
    repeats = round(RATE / device.model_rate)
    ahead = repeats * device.window
    touches = device.simulate_stream((ahead + count) // repeats + 1).whole.touches
    values = np.repeat(touches.readings[0].double().numpy(), repeats, axis=0)[: ahead + count]
    valid = np.ones(values.shape[1], dtype=bool)
    frames = [Frame(n, n / RATE, n / RATE, row, valid) for n, row in enumerate(values)]
    for frame in frames[:ahead]:
        engine.push([frame], None)
    return frames[ahead:]


def _seconds(engine: Engine, frame: Frame) -> tuple[float, float]:
    """Return the duration of a verdict as wall time and as processor time, s."""
    sensors = engine.window.sensors
    conversion = UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, dtype=bool))
    wall, core = time.perf_counter(), time.thread_time()
    engine.push([frame], conversion)
    return time.perf_counter() - wall, time.thread_time() - core
