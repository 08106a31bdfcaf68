"""Measure what docs/results.md publishes of speed and memory.

    python -m experiments.benchmarks --repeats 3 --out results
    python -m experiments.benchmarks --only live.onnx wire --against ../other

Writes bench.json into ``--out``. With ``--against`` every figure is also measured with the package ``skin``
of that checkout, in turns, and ``ratios`` has what this checkout measures over what the other does.
"""

import json
import os
import platform
import subprocess
import sys
import time
from argparse import ArgumentParser
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

from skin.core.files import CONF, ROOT, results, write
from skin.core.messages import quiet
from skin.device.base import AbstractSimulated
from skin.device.resampling import Frame
from skin.learning.data import TouchData
from skin.learning.network import Network
from skin.live.engine import Detection, Engine
from skin.runs.build import TorchModel, build_data, build_device, build_learner
from skin.runs.configuration import Config, validate_config
from skin.runs.model import Model, OnnxModel
from skin.runs.onnx_writer import write_model
from skin.wire.channels import UnitConversion
from skin.wire.decoder import Decoder
from skin.wire.protocol import encode_line

Figures = dict[str, float]

ROWS = ("temporal_graph", "temporal_image", "sequence_graph", "sequence_image")
"""Rows whose epochs are timed."""


def benchmarks(repeats: int) -> dict[str, tuple[str, tuple[object, ...]]]:
    """Return all benchmarks: name -> function of this module and its arguments."""
    return {
        **{f"generation.{name}": ("measure_generation", (name, repeats)) for name in ("fem", "solid")},
        **{f"operator.{name}": ("measure_operator", (name, repeats)) for name in ("fem", "solid")},
        **{f"training.{row}": ("measure_training", (row, repeats)) for row in ROWS},
        **{f"live.{row}": ("measure_latency", (row,)) for row in ("best_fresh", "any_skin")},
        "live.onnx": ("measure_latency", ("best_fresh", True)),
        "wire": ("measure_decoder", ()),
    }


def main(words: Sequence[str]) -> None:
    """Run the benchmarks and write their figures."""
    parser = ArgumentParser("python -m experiments.benchmarks", description=__doc__)
    parser.add_argument("--repeats", type=int, choices=range(3, 100), default=3, metavar="3, 4, ...")
    parser.add_argument("--out", default="results")
    parser.add_argument("--only", nargs="+", choices=benchmarks(0), default=list(benchmarks(0)))
    parser.add_argument("--against", type=Path)
    settings = parser.parse_args(words)
    if settings.against and not (settings.against / "skin").is_dir():
        parser.error(f"{settings.against} has no folder skin: give another checkout of this project")
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.processor() or 'unknown'}"
    versions = {name: version(name) for name in ("torch", "pytorch-lightning", "numpy", "scipy")}
    measured: dict[str, Any] = {"repeats": settings.repeats, "machine": machine, "versions": versions}
    for name in settings.only:
        print(name, file=sys.stderr)
        task = benchmarks(settings.repeats)[name]
        measured[name] = run_alone(*task)
        if settings.against:
            baseline = run_alone(*task, settings.against)
            ratios = {key: value / baseline[key] for key, value in measured[name].items() if baseline[key]}
            measured[name] = {"here": measured[name], "there": baseline, "ratios": ratios}
    text = json.dumps(measured, indent=2)
    write(text + "\n", results(settings.out) / "bench.json")
    print(text)


def run_alone(function: str, arguments: Sequence[object], checkout: Path = ROOT) -> Figures:
    """Run a benchmark in its own process, so that its peak memory and its threads are its own.

    Args:
        function, arguments: of this module.
        checkout: folder of the package ``skin`` that is measured.
    """
    code = (
        "import json, sys; from experiments import benchmarks; "
        "print(json.dumps(getattr(benchmarks, sys.argv[1])(*json.loads(sys.argv[2]))))"
    )
    with TemporaryDirectory() as folder:
        # These benchmarks, and not those of the other checkout.
        (Path(folder) / "experiments").symlink_to(ROOT / "experiments")
        paths = os.pathsep.join([folder, str(checkout.resolve())])
        command = [sys.executable, "-P", "-c", code, function, json.dumps(arguments)]
        env = os.environ | {"PYTHONPATH": paths}
        return json.loads(
            subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=True).stdout
        )


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


def measure_generation(simulator: str, repeats: int, gestures: int = 4038) -> Figures:
    """Return gestures per second (median).

    The operator is warm; everything else starts from the seed: sampling, redraws, labels, rendering,
    readings, imperfections.
    """
    config = training_config(f"simulator={simulator}", f"data.gestures={gestures}")
    device, seeds = build_device(config).simulated("gestures are generated"), count()
    seconds = median_seconds(lambda: device.replace(data_seed=next(seeds)).touches("train"), repeats)
    return {"gestures_per_second": gestures / seconds}


def measure_operator(simulator: str, repeats: int) -> Figures:
    """Return the seconds (median) to build the operator of the default skin, with nothing cached."""
    config = training_config(f"simulator={simulator}")
    body, make = instantiate(config.body), instantiate(config.simulator)
    sensors = instantiate(config.layout).sensors(body)

    def build() -> None:
        with TemporaryDirectory() as empty:
            os.environ["SKIN_CACHE"] = empty
            make(body, sensors)

    return {"build_seconds": median_seconds(build, repeats)}


def measure_training(row: str, repeats: int) -> Figures:
    """Return the median seconds per epoch of a row, on 4038 finite-element gestures."""
    quiet()
    config = training_config(f"experiment={row}", "simulator=fem", f"trainer.max_epochs={repeats + 1}")
    learner = build_learner(config)
    assert isinstance(learner, Network)
    learner.fit(build_data(config, build_device(config)))
    return {"seconds_per_epoch": learner.seconds_per_epoch}


def measure_decoder(rate: float = 1000.0, frames: int = 20_000, sensors: int = 25) -> Figures:
    """Return the fraction of one core that decoding channels at ``rate`` Hz takes."""
    values = [
        [(number * (7 + channel) + 31 * channel) % 1024 for channel in range(sensors)]
        for number in range(frames)
    ]
    data = b"".join(
        encode_line(line, number, round(1e6 * number / rate)) for number, line in enumerate(values)
    )
    decoder, decoded, began = Decoder(sensors), 0, time.process_time()
    piece = 512  # bytes that a port gives at a time
    for start in range(0, len(data), piece):
        decoded += len(decoder.feed(data[start : start + piece], start / len(data) * frames / rate))
    assert decoded == frames
    return {"decode_core_share": (time.process_time() - began) / frames * rate}


def measure_latency(row: str, onnx: bool = False, frames: int = 3000, rate: float = 100.0) -> Figures:
    """Return the time from a frame at ``rate`` Hz to the verdict on it, ms: median and the 99th percentile.

    One thread watches a simulated stream of touches and decides twenty times per second. ``core_ms`` is the
    99th percentile of the processor time, which excludes other processes; ``core_fraction`` is the fraction
    of a core for all frames, and ``memory_mb`` the memory of the process at its end.

    Args:
        row: of the table, untrained, because speed does not depend on the weights.
        onnx: whether it is exported, so that torch is not in the engine.
        frames: of the stream.
        rate: of the device, Hz.
    """
    torch.set_num_threads(1)
    device, model, data = _untrained(row)
    if not onnx:
        return _time_verdicts(device, model, frames, rate)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        write_model(model.learner.pipeline(model.sites), model.describe(), data.touches("train"), path)
        return _time_verdicts(device, OnnxModel(path), frames, rate)


def _untrained(row: str) -> tuple[AbstractSimulated, TorchModel, TouchData]:
    """Return the device of a row, its network with random weights, and a few touches."""
    # A row for any skin is not measured on the default one, but on the largest of its distribution.
    skin = (
        ("simulator=solid", "layout=random", "layout.count=64") if row == "any_skin" else ("simulator=naive",)
    )
    config = training_config(*skin, f"experiment={row}", "data.gestures=100")
    device, learner = build_device(config).reference, build_learner(config)
    assert device is not None
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    return device, TorchModel(device, learner, data.example, touch=0.3), data


def _time_verdicts(device: AbstractSimulated, model: Model, frames: int, rate: float) -> Figures:
    """Return the times of :func:`measure_latency` for a model on a stream of a device."""
    detection, warm = Detection(0.3), 50  # N, and verdicts that are not counted
    engine = Engine(
        model.probabilities, model.task, len(model.positions), model.window, model.rate, detection
    )
    stream = _stream(device, engine, frames + warm, rate)
    durations = np.array([_seconds(engine, frame) for frame in stream])[warm:]
    wall, core, _ = 1e3 * durations[durations[:, 2] > 0].T
    return {
        "p50_ms": float(np.median(wall)),
        "p99_ms": float(np.percentile(wall, 99)),
        "core_ms": float(np.percentile(core, 99)),
        "core_share": float(durations[:, 1].mean() * rate),
        "memory_mb": psutil.Process().memory_info().rss / 1e6,
    }


def _stream(device: AbstractSimulated, engine: Engine, count: int, rate: float) -> list[Frame]:
    """Return frames at ``rate`` Hz, after the engine's window has been filled with frames."""
    repeats = round(rate / device.model_rate)
    ahead = repeats * device.window
    touches = device.simulate_stream((ahead + count) // repeats + 1).whole.touches
    values = np.repeat(touches.readings[0].double().numpy(), repeats, axis=0)[: ahead + count]
    valid = np.ones(values.shape[1], dtype=bool)
    frames = [Frame(n, n / rate, n / rate, row, valid) for n, row in enumerate(values)]
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
    main(sys.argv[1:])
