"""Frame to verdict of an exported model on one core, and the start of the live view; in a process of its own.

skin bench benchmark=onnx_latency                        # the best row, untrained
skin bench benchmark=onnx_latency benchmark.model=x.onnx # a file of skin export, of a 25-sensor skin
"""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread

import numpy as np
import torch
from omegaconf import DictConfig

from experiments.benchmarks.harness import training_config
from experiments.benchmarks.live_latency import ROW, time_verdicts
from skin.build import build_data, build_device, build_learner
from skin.device.base import AbstractSimulated
from skin.exported.model import ExportedModel
from skin.exported.writer import write_model
from skin.hardware.live.engine import Detection, Engine
from skin.learner.network import Network
from skin.model_of_run import RunModel
from skin.paths import ROOT
from skin.wire.text import Header, encode_header, encode_line

_TOUCH = 0.3  # N


def measure_onnx_latency(frames: int = 1000, row: str = ROW, model: str | None = None) -> dict[str, float]:
    """Return the times of :func:`experiments.benchmarks.live_latency.measure_latency`, and ``start_s``.

    ``start_s`` is the time from the start of ``skin live`` to its first line, s.

    Args:
        frames: number of classified frames.
        row: of the table, untrained, because speed does not depend on the weights.
        model: file of ``skin export`` to use instead.
    """
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        config = training_config("simulator=naive", f"experiment={row}", "data.gestures=100")
        device = build_device(config).simulated("the stream is simulated")
        path = Path(model) if model else _untrained(config, device, Path(folder) / "model.onnx")
        exported = ExportedModel(path)
        about = exported.metadata
        engine = Engine(
            exported.probabilities,
            about.task,
            len(about.positions),
            about.window,
            about.rate,
            Detection(_TOUCH),
        )
        found = time_verdicts(device, engine, frames)
        return found | {"start_s": _start(path, len(about.positions))}


def _untrained(config: DictConfig, device: AbstractSimulated, path: Path) -> Path:
    learner = build_learner(config)
    assert isinstance(learner, Network)
    data = build_data(config, device)
    learner.build(data)
    of = RunModel(device, learner, data.example, touch=_TOUCH)
    write_model(learner.pipeline(of.places), of.describe(), data.touches("train"), path)
    return path


def _start(path: Path, sensors: int) -> float:
    """Return the time until the live view of a skin at a socket says its first word, s."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = Thread(target=_send, args=(server, sensors), daemon=True)
        thread.start()
        port = f"device.port=socket://127.0.0.1:{server.getsockname()[1]}"
        words = ["live", f"run={path}", "device=serial", port, "live.verdicts=stdout"]
        began = time.perf_counter()
        with subprocess.Popen(
            [sys.executable, "-m", "skin", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        ) as live:
            assert live.stdout is not None
            live.stdout.readline()
            taken = time.perf_counter() - began
            live.terminate()
        thread.join(10)
    return taken


def _send(server: socket.socket, sensors: int) -> None:
    """Send idle frames to one client until it leaves."""
    client = server.accept()[0]
    try:
        with client:
            client.sendall(encode_header(Header(n=sensors, rate=100.0, unit="N")))
            for number in range(10**6):
                client.sendall(encode_line(np.zeros(sensors).tolist(), number, 10_000 * number))
                time.sleep(0.01)
    except OSError:
        return
