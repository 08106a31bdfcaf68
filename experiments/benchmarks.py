"""Measure what docs/results.md publishes of speed and memory.

    python -m experiments.benchmarks repeats=3 out=results
    python -m experiments.benchmarks only=live.onnx,wire against=../other

Writes bench.json into ``out``. With ``against=`` every figure is also measured with the package ``skin`` of
that checkout, in turns, and ``ratios`` has what this checkout measures over what the other does.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from itertools import count
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from experiments import run_script, script_settings
from skin.core.files import CONF, ROOT, results, write
from skin.core.messages import quiet
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.network import Network
from skin.live.engine import Detection, Engine
from skin.runs.build import build_data, build_device, build_learner
from skin.runs.configuration import Config, validate_config
from skin.runs.model import Model
from skin.runs.torch_model import TorchModel
from skin.wire.channels import UnitConversion
from skin.wire.decoder import Decoder
from skin.wire.protocol import encode_line

Figures = dict[str, float]
Benchmark = tuple[str, tuple[object, ...]]
"""Function of this module and its arguments."""

ROWS = ("temporal_graph", "temporal_image", "sequence_graph", "sequence_image")
"""Rows whose epochs are timed."""

_FRAMES = 3000  # of which every fifth is classified
_PACKAGES = ("torch", "pytorch-lightning", "numpy", "scipy")
_ALONE = (
    "import json, sys; from experiments import benchmarks; "
    "print(json.dumps(getattr(benchmarks, sys.argv[1])(*json.loads(sys.argv[2]))))"
)
_DEFAULTS = {"repeats": "3", "out": "results", "only": "", "against": ""}


def benchmarks(repeats: int) -> dict[str, Benchmark]:
    """Return all benchmarks by name."""
    built, live = ("fem", "solid"), ("best_fresh", "any_skin")
    return {
        **{f"generation.{name}": ("measure_generation", (name, repeats)) for name in built},
        **{f"operator.{name}": ("measure_operator", (name, repeats)) for name in built},
        **{f"training.{row}": ("measure_training", (row, repeats)) for row in ROWS},
        **{f"live.{row}": ("measure_latency", (row, _FRAMES)) for row in live},
        "live.onnx": ("measure_onnx_latency", ("best_fresh", _FRAMES)),
        "wire": ("measure_decoder", ()),
    }


def main(arguments: Sequence[str]) -> None:
    """Run the benchmarks and write their figures.

    Raises:
        InputError: an unknown setting, benchmark or checkout, or a bad value.
    """
    settings = script_settings(arguments, _DEFAULTS)
    repeats, against = settings["repeats"], settings["against"]
    if not repeats.isdecimal() or int(repeats) < 3:
        raise InputError(f"repeats={repeats} must be a number of at least 3: medians are returned")
    if against and not (Path(against) / "skin").is_dir():
        raise InputError(f"against={against} has no folder skin: give another checkout of this project")
    choice = benchmarks(int(repeats))
    names = [name for name in settings["only"].split(",") if name] or list(choice)
    if unknown := [name for name in names if name not in choice]:
        raise InputError(f"only={','.join(unknown)} is none of {', '.join(choice)}")
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.processor() or 'unknown'}"
    versions = {name: version(name) for name in _PACKAGES}
    measured: dict[str, Any] = {"repeats": int(repeats), "machine": machine, "versions": versions}
    for name in names:
        print(name, file=sys.stderr)
        measured[name] = run_alone(*choice[name])
        if against:
            baseline = run_alone(*choice[name], checkout=Path(against))
            ratios = {key: value / baseline[key] for key, value in measured[name].items() if baseline[key]}
            measured[name] = {"here": measured[name], "there": baseline, "ratios": ratios}
    text = json.dumps(measured, indent=2)
    write(text + "\n", results(settings["out"]) / "bench.json")
    print(text)


def run_alone(function: str, arguments: Sequence[object], checkout: Path = ROOT) -> Figures:
    """Run a benchmark in its own process, so that its peak memory and its threads are its own.

    Args:
        function, arguments: of this module.
        checkout: folder of the package ``skin`` that is measured.
    """
    with TemporaryDirectory() as folder:
        # These benchmarks, and not those of the other checkout.
        (Path(folder) / "experiments").symlink_to(ROOT / "experiments")
        paths = os.pathsep.join([folder, str(checkout.resolve())])
        done = subprocess.run(
            [sys.executable, "-P", "-c", _ALONE, function, json.dumps(arguments)],
            env=os.environ | {"PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return json.loads(done.stdout)


def training_config(*overrides: str) -> Config:
    """Return the configuration of a training with overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return validate_config(compose("train", list(overrides)))


def median_seconds(task: Callable[[], object], repeats: int) -> float:
    """Return the median duration of a task, s, after one warm-up call."""
    task()
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        task()
        taken.append(time.perf_counter() - began)
    return median(taken)


GESTURES = 4038


def measure_generation(simulator: str, repeats: int) -> dict[str, float]:
    """Return gestures per second (median).

    The operator is warm; everything else starts from the seed: sampling, redraws, labels, rendering,
    readings, imperfections.
    """
    config = training_config(f"simulator={simulator}", f"data.gestures={GESTURES}")
    device, seeds = build_device(config).simulated("gestures are generated"), count()
    seconds = median_seconds(lambda: device.replace(data_seed=next(seeds)).touches("train"), repeats)
    return {"gestures_per_second": GESTURES / seconds}


def measure_operator(simulator: str, repeats: int) -> dict[str, float]:
    """Return the seconds (median) to build the operator of the default skin, with nothing cached."""
    config = training_config(f"simulator={simulator}")
    body, make = instantiate(config.body), instantiate(config.simulator)
    sensors = instantiate(config.layout).sensors(body)

    def build() -> None:
        with TemporaryDirectory() as empty:
            os.environ["SKIN_CACHE"] = empty
            make(body, sensors)

    return {"build_seconds": median_seconds(build, repeats)}


def measure_training(row: str, repeats: int) -> dict[str, float]:
    """Return the median seconds per epoch of a row, on 4038 finite-element gestures."""
    quiet()
    config = training_config(f"experiment={row}", "simulator=fem", f"trainer.max_epochs={repeats + 1}")
    learner = build_learner(config)
    assert isinstance(learner, Network)
    learner.fit(build_data(config, build_device(config)))
    return {"seconds_per_epoch": learner.seconds_per_epoch}


RATE = 100.0  # Hz, of the device
_SENSORS = 25
_PIECE = 512  # bytes that a port gives at a time
# Where a row is not measured on the default skin: the largest of its distribution.
_SETTINGS = {"any_skin": ("simulator=solid", "layout=random", "layout.count=64")}
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

    One thread watches a simulated stream of touches and decides twenty times per second. ``core_ms`` is the
    99th percentile of the processor time, which excludes other processes; ``core_share`` is that of all
    frames, and ``memory_mb`` the memory of the process at its end.

    Args:
        row: of the table, untrained, because speed does not depend on the weights.
        frames: of the stream.
    """
    torch.set_num_threads(1)
    device, model, _ = _untrained(row)
    return _time_verdicts(device, model, frames)


def measure_onnx_latency(row: str, frames: int) -> dict[str, float]:
    """Return the times of :func:`measure_latency` for the exported row, without torch in the engine."""
    from skin.runs.model import OnnxModel
    from skin.runs.onnx_writer import write_model

    torch.set_num_threads(1)
    device, model, data = _untrained(row)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        write_model(model.learner.pipeline(model.places), model.describe(), data.touches("train"), path)
        return _time_verdicts(device, OnnxModel(path), frames)


def _untrained(row: str) -> tuple[AbstractSimulated, TorchModel, TouchData]:
    """Return the device of a row, its network with random weights, and a few touches."""
    config = training_config(
        *_SETTINGS.get(row, ("simulator=naive",)), f"experiment={row}", "data.gestures=100"
    )
    device, learner = build_device(config).reference, build_learner(config)
    assert device is not None
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    return device, TorchModel(device, learner, data.example, touch=_TOUCH), data


def _time_verdicts(device: AbstractSimulated, model: Model, frames: int) -> dict[str, float]:
    """Return the times of :func:`measure_latency` for a model on a stream of a device."""
    engine = Engine(
        model.probabilities, model.task, len(model.positions), model.window, model.rate, Detection(_TOUCH)
    )
    durations = np.array([_seconds(engine, frame) for frame in _stream(device, engine, frames + _WARM)])
    wall, core, _ = 1e3 * durations[_WARM:][durations[_WARM:, 2] > 0].T
    return {
        "p50_ms": float(np.median(wall)),
        "p99_ms": float(np.percentile(wall, 99)),
        "core_ms": float(np.percentile(core, 99)),
        "core_share": float(durations[_WARM:, 1].mean() * RATE),
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
    engine.remember([_conversion(engine).convert(frame) for frame in frames[:ahead]])
    return frames[ahead:]


def _conversion(engine: Engine) -> UnitConversion:
    sensors = engine.sensors
    return UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, dtype=bool))


def _seconds(engine: Engine, frame: Frame) -> tuple[float, float, int]:
    """Return the duration of a frame as wall time and as processor time, s, and its number of verdicts."""
    conversion = _conversion(engine)
    wall, core = time.perf_counter(), time.thread_time()
    verdicts = engine.push([conversion.convert(frame)])
    return time.perf_counter() - wall, time.thread_time() - core, len(verdicts)


if __name__ == "__main__":
    run_script(main)
