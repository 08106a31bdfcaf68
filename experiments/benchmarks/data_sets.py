"""Rate, size and peak memory of generating a data set; run in a process of its own."""

import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated

from annotated_types import Ge

from experiments.benchmarks.generation import GESTURES
from experiments.benchmarks.harness import peak_memory, training_config
from skin.build import build_device
from skin.generation import generate_data_set


def measure_data_set(
    gestures: Annotated[int, Ge(10)], repeats: Annotated[int, Ge(1)] = 3
) -> dict[str, float]:
    """Return the rate, gestures per second, relative to drawing alone, the size and the peak memory, bytes.

    Drawing alone is what ``measure_generation`` times: gestures of the same finite-element skin, in memory.

    Args:
        gestures: of the data set.
        repeats: number of draws before the data set, and after it; their median counts.
    """
    config = training_config("simulator=fem", f"data.gestures={gestures}")
    device = build_device(config).simulated("gestures are generated")
    drawn = device.replace(gestures=GESTURES)

    def seconds(seed: int) -> float:
        began = time.perf_counter()
        drawn.replace(data_seed=seed).touches("train")
        return time.perf_counter() - began

    seconds(0)  # warms up
    alone = [seconds(1 + number) for number in range(repeats)]
    with TemporaryDirectory() as folder:
        place = Path(folder) / "touches"
        began = time.perf_counter()
        generate_data_set(device, config, place)
        rate = gestures / (time.perf_counter() - began)
        size = sum(path.stat().st_size for path in place.rglob("*.parquet"))
    alone += [seconds(1 + repeats + number) for number in range(repeats)]
    return {
        "gestures_per_second": rate,
        "ratio_to_generation": rate * median(alone) / GESTURES,
        "bytes_per_gesture": size / gestures,
        "peak_memory_bytes": peak_memory(),
    }
