"""Frame to verdict on one core; run in a process of its own.

python experiments/benchmarks/live.py 1000
"""

import json
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch

from benchmarks.setting import configuration
from skin.build import build_data, build_device, build_learner
from skin.device.simulated import Simulated
from skin.gate import Threshold, gates
from skin.learner.network import Network
from skin.live.engine import Engine
from skin.port.frame import Frame

__all__ = ["measure"]

RATE = 100.0  # Hz, of the device
ROW = "best_fresh"
_WARM = 50  # verdicts that are not counted


def measure(frames: int = 1000, row: str = ROW) -> dict[str, float]:
    """Return the time from a frame at 100 Hz to the verdict on it, ms: median and the 99th percentile.

    One thread, a simulated stream of touches, every frame classified. Weights do not matter to speed, so the
    network is untrained. ``core_ms`` is the 99th percentile of the core's own time: what is beyond it is the
    machine's other work.
    """
    torch.set_num_threads(1)
    config = configuration("simulator=naive", f"experiment={row}", "data.gestures=10")
    device = build_device(config)
    assert isinstance(device, Simulated)
    engine = _engine(device, config)
    taken = np.array([_seconds(engine, frame) for frame in _stream(device, engine, frames + _WARM)])[_WARM:]
    wall, core = 1e3 * taken.T
    return {
        "p50_ms": float(np.median(wall)),
        "p99_ms": float(np.percentile(wall, 99)),
        "core_ms": float(np.percentile(core, 99)),
        "core_share": float(core.mean() * RATE / 1e3),
    }


def _engine(device: Simulated, config) -> Engine:
    learner, data = build_learner(config), build_data(config, device)
    assert isinstance(learner, Network)
    learner.build(data)
    gate = gates(Threshold(0.3), device.task)["threshold"]
    positions = data.touches("train").positions
    return Engine(learner, device.task, positions, device.window, device.rate, gate)


def _stream(device: Simulated, engine: Engine, count: int) -> list[Frame]:
    """Return frames at 100 Hz after those that fill the window, which the engine has then seen."""
    held = round(RATE / device.rate)
    ahead = held * device.window
    whole = device.strip((ahead + count) // held + 1).whole.touches
    values = np.repeat(whole.readings[0].double().numpy(), held, axis=0)[: ahead + count]
    valid = np.ones(values.shape[1], dtype=bool)
    frames = [Frame(n, n / RATE, n / RATE, row, valid) for n, row in enumerate(values)]
    for frame in frames[:ahead]:
        engine.add(frame)
    return frames[ahead:]


def _seconds(engine: Engine, frame: Frame) -> tuple[float, float]:
    """Return how long a verdict takes, by the clock on the wall and by the core's, s."""
    wall, core = time.perf_counter(), time.thread_time()
    assert engine.push(frame) is not None
    return time.perf_counter() - wall, time.thread_time() - core


if __name__ == "__main__":
    print(json.dumps(measure(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)))
