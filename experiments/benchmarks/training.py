"""What a training waits for: gestures, the operator of a skin, epochs. Each runs in a process of its own."""

import os
import tempfile
import time
from statistics import median

import numpy as np
from hydra.utils import instantiate

from experiments.benchmarks.harness import median_seconds, peak_memory, training_config
from skin.body.layout.random import Random
from skin.core.messages import quiet
from skin.learning.learner.network import Network
from skin.runs.build import build_data, build_device, build_learner

GESTURES = 4038
_SKINS = 20  # of the 200 of any_skin: a batch mixes skins in the same way
_SKIN_GESTURES = 8000  # a fifth of those of any_skin


def measure_generation(simulator: str, repeats: int) -> dict[str, float]:
    """Return gestures per second (median), distinct frames per second and peak memory, bytes.

    The operator is warm; everything else starts from the seed: sampling, redraws, labels, rendering,
    readings, imperfections.
    """
    config = training_config(f"simulator={simulator}", f"data.gestures={GESTURES}")
    device = build_device(config).simulated("gestures are generated")
    durations = []
    for seed in range(repeats + 1):
        began = time.perf_counter()
        device.replace(data_seed=seed).touches("train")
        durations.append(time.perf_counter() - began)
    speed = GESTURES / median(durations[1:])
    movie = device.sampler.sample(1024, np.random.default_rng(0))
    return {
        "gestures_per_second": speed,
        "frames_per_second": speed * len(movie.frames) / len(movie),
        "peak_memory_bytes": peak_memory(),
    }


def measure_operator(simulator: str, repeats: int) -> dict[str, float]:
    """Return the seconds (medians) to build an operator, and the peak memory, bytes.

    ``build_seconds``: of the default skin, with nothing cached. ``layout_seconds``: of a layout that was not
    seen before, on a body that was.
    """
    config = training_config(f"simulator={simulator}")
    body, make = instantiate(config.body), instantiate(config.simulator)
    sensors = instantiate(config.layout).sensors(body)
    unseen = iter([Random(seed=seed).sensors(body) for seed in range(repeats + 1)])

    def build() -> None:
        with tempfile.TemporaryDirectory() as empty:
            os.environ["SKIN_CACHE"] = empty
            make(body, sensors)

    build_seconds = median_seconds(build, repeats)
    with tempfile.TemporaryDirectory() as warm:
        os.environ["SKIN_CACHE"] = warm
        make(body, sensors)
        layout_seconds = median_seconds(lambda: make(body, next(unseen)), repeats)
    return {
        "build_seconds": build_seconds,
        "layout_seconds": layout_seconds,
        "peak_memory_bytes": peak_memory(),
    }


def measure_training(row: str, repeats: int) -> dict[str, float]:
    """Return the median seconds per epoch of a row, on 4038 finite-element gestures (any_skin: its own)."""
    quiet()
    settings, share = ["simulator=fem"], 1.0
    if row == "any_skin":
        settings = ["simulator=solid", f"device.count={_SKINS}", f"data.gestures={_SKIN_GESTURES}"]
        share = training_config("experiment=any_skin").data.gestures / _SKIN_GESTURES
    config = training_config(f"experiment={row}", *settings, f"trainer.max_epochs={repeats + 1}")
    learner = build_learner(config)
    assert isinstance(learner, Network)
    learner.fit(build_data(config, build_device(config)))
    return {"seconds_per_epoch": share * learner.seconds_per_epoch}
