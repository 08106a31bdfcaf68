"""Measure what docs/results.md publishes of speed and memory.

    python -m experiments.benchmarks --repeats 3 --out results
    python -m experiments.benchmarks --only live.onnx wire

Writes bench.json into ``--out``.
"""

import json
import os
import platform
import subprocess
import sys
import time
import timeit
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from functools import partial
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
from skin.device.resampling import Frame
from skin.device.simulated import Simulated
from skin.inference.noise import Noise
from skin.inference.posterior import Posterior
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


def main(words: Sequence[str]) -> None:
    """Run the benchmarks and write their figures."""
    parser = ArgumentParser("python -m experiments.benchmarks", description=__doc__)
    parser.add_argument("--repeats", type=int, choices=range(3, 100), default=3, metavar="3, 4, ...")
    parser.add_argument("--out", default="results")
    parser.add_argument("--only", nargs="+", choices=BENCHMARKS, default=list(BENCHMARKS))
    settings = parser.parse_args(words)
    measured: dict[str, Any] = {
        "repeats": settings.repeats,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.processor() or 'unknown'}",
        "versions": {name: version(name) for name in ("torch", "pytorch-lightning", "numpy", "scipy")},
    }
    for name in settings.only:
        print(name, file=sys.stderr)
        measured[name] = run_alone(name, settings.repeats)
    text = json.dumps(measured, indent=2)
    write(text + "\n", results(settings.out) / "bench.json")
    print(text)


def run_alone(name: str, repeats: int) -> Figures:
    """Run a benchmark in its own process, so that its peak memory and its threads are its own.

    Args:
        name: of the benchmark.
        repeats: of what it measures.
    """
    code = (
        "import json, sys; from experiments.benchmarks import BENCHMARKS; "
        "print(json.dumps(BENCHMARKS[sys.argv[1]](int(sys.argv[2]))))"
    )
    command = [sys.executable, "-c", code, name, str(repeats)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def training_config(*overrides: str) -> Config:
    """Return the configuration of a training with overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return validate_config(compose("train", list(overrides)))


def median_seconds(task: Callable[[], object], repeats: int) -> float:
    """Return the median duration of a task, s, after one warm-up call."""
    return median(timeit.repeat(task, number=1, repeat=repeats + 1)[1:])


def measure_generation(simulator: str, repeats: int, gestures: int = 4038) -> Figures:
    """Return gestures per second (median).

    The operator is warm; everything else starts from the seed: sampling, redraws, labels, rendering,
    readings, imperfections.
    """
    device = build_device(training_config(f"simulator={simulator}", f"data.gestures={gestures}")).simulated(
        "gestures are generated"
    )
    seeds = count()
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


def measure_contacts(number: int, repeats: int) -> Figures:
    """Return the processor time of an estimate of so many contacts, ms: median and 99th percentile.

    Of the default skin after its tare, in the frame of most force of a touch of 5 N or more, on one thread.
    """
    device = build_device(
        training_config(
            "simulator=solid",
            "device.offset=0.0",
            "touch=fingertips",
            "touch.force=5.0",
            f"touch.contacts=[{number},{number}]",
        )
    ).simulated("contacts are estimated")
    posterior, clock = Posterior(device.model, Noise(0.05, gain=0.05), device.body), time.process_time
    seconds = [
        timeit.timeit(partial(posterior.estimate, touch[touch.sum(1).argmax()]), timer=clock, number=1)
        for touch in device.replace(test_gestures=100 * repeats).touches("test").readings.double().numpy()
    ]
    return dict(zip(("p50_ms", "p99_ms"), 1e3 * np.percentile(seconds, [50, 99]), strict=True))


def measure_decoder(repeats: int, rate: float = 1000.0, sensors: int = 25) -> Figures:
    """Return the fraction of one core that decoding channels at ``rate`` Hz takes."""
    frames, piece = 20 * round(rate), 512  # bytes that a port gives at a time
    lines = (
        encode_line(
            [(n * (7 + channel) + 31 * channel) % 1024 for channel in range(sensors)],
            n,
            round(1e6 * n / rate),
        )
        for n in range(frames)
    )
    data, decoder = b"".join(lines), Decoder(sensors)
    began = time.process_time()
    decoded = [
        len(decoder.feed(data[start : start + piece], start / len(data) * frames / rate))
        for start in range(0, len(data), piece)
    ]
    assert sum(decoded) == frames
    return {"decode_core_share": (time.process_time() - began) / frames * rate}


def measure_latency(row: str, repeats: int, onnx: bool = False, rate: float = 100.0) -> Figures:
    """Return the time from a frame at ``rate`` Hz to the verdict on it, ms: median and the 99th percentile.

    One thread watches a simulated stream of touches and decides twenty times per second. ``core_ms`` is the
    99th percentile of the processor time, which excludes other processes; ``core_fraction`` is the fraction
    of a core for all frames, and ``memory_mb`` the memory of the process at its end.

    Args:
        row: of the table, untrained, because speed does not depend on the weights.
        repeats: thousands of frames of the stream.
        onnx: whether it is exported, so that torch is not in the engine.
        rate: of the device, Hz.
    """
    torch.set_num_threads(1)
    # A row for any skin is not measured on the default one, but on the largest of its distribution.
    largest = "simulator=solid", "layout=random", "layout.count=64"
    skin = largest if row == "any_skin" else ("simulator=naive",)
    config = training_config(*skin, f"experiment={row}", "data.gestures=100")
    device, learner = build_device(config).reference, build_learner(config)
    assert device is not None
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    model = TorchModel(device, learner, data.example, touch=0.3)
    if not onnx:
        return _time_verdicts(device, model, 1000 * repeats, rate)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        write_model(learner.pipeline(model.sites), model.describe(), data.touches("train"), path)
        return _time_verdicts(device, OnnxModel(path), 1000 * repeats, rate)


def _time_verdicts(device: Simulated, model: Model, count: int, rate: float) -> Figures:
    """Return the times of :func:`measure_latency` for a model on a stream of a device."""
    sensors, repeats, warm = len(model.positions), round(rate / device.model_rate), 50  # verdicts not counted
    engine = Engine(model.probabilities, model.task, sensors, model.window, model.rate, Detection(0.3))  # N
    conversion = UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, dtype=bool))
    ahead = repeats * device.window  # frames that fill the window of the engine
    touches = device.simulate_stream((ahead + count + warm) // repeats + 1).whole.touches
    values = np.repeat(touches.readings[0].double().numpy(), repeats, axis=0)[: ahead + count + warm]
    frames = [Frame(n, n / rate, n / rate, row, np.ones(sensors, dtype=bool)) for n, row in enumerate(values)]
    engine.remember([conversion.convert(frame) for frame in frames[:ahead]])
    seconds = list[tuple[float, float, int]]()
    for frame in frames[ahead:]:
        wall, core = time.perf_counter(), time.thread_time()
        verdicts = engine.push([conversion.convert(frame)])
        seconds.append((time.perf_counter() - wall, time.thread_time() - core, len(verdicts)))
    durations = np.array(seconds)[warm:]
    wall_ms, core_ms, _ = 1e3 * durations[durations[:, 2] > 0].T
    return {
        "p50_ms": float(np.median(wall_ms)),
        "p99_ms": float(np.percentile(wall_ms, 99)),
        "core_ms": float(np.percentile(core_ms, 99)),
        "core_share": float(durations[:, 1].mean() * rate),
        "memory_mb": psutil.Process().memory_info().rss / 1e6,
    }


BENCHMARKS: dict[str, Callable[[int], Figures]] = {
    **{f"generation.{name}": partial(measure_generation, name) for name in ("fem", "solid")},
    **{f"operator.{name}": partial(measure_operator, name) for name in ("fem", "solid")},
    **{
        f"training.{row}": partial(measure_training, row)
        for row in ("temporal_graph", "temporal_image", "sequence_graph", "sequence_image")
    },
    **{f"live.{row}": partial(measure_latency, row) for row in ("best_fresh", "any_skin")},
    "live.onnx": partial(measure_latency, "best_fresh", onnx=True),
    **{f"contacts.{number}": partial(measure_contacts, number) for number in (1, 3)},
    "wire": measure_decoder,
}
"""Name -> function of the number of repeats."""

if __name__ == "__main__":
    main(sys.argv[1:])
