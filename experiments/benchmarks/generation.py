"""Gestures per second and peak memory, from the seed to imperfect readings; run in a process of its own."""

import time
from statistics import median

import numpy as np

from experiments.benchmarks.harness import peak_memory, training_config
from skin.build import build_device

GESTURES = 4038


def measure_generation(simulator: str, repeats: int) -> dict[str, float]:
    """Return gestures per second (median), distinct frames per second and peak memory, bytes.

    The operator is warm; everything else starts from the seed: sampling, redraws, labels, rendering,
    readings, imperfections.
    """
    config = training_config(f"simulator={simulator}", f"data.gestures={GESTURES}")
    device = build_device(config).simulated("gestures are generated")
    taken = []
    for seed in range(repeats + 1):
        began = time.perf_counter()
        device.replace(data_seed=seed).touches("train")
        taken.append(time.perf_counter() - began)
    speed = GESTURES / median(taken[1:])
    movie = device.sampler.sample(1024, np.random.default_rng(0))
    return {
        "gestures_per_second": speed,
        "frames_per_second": speed * len(movie.frames) / len(movie),
        "peak_memory_bytes": peak_memory(),
    }
