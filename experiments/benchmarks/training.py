"""Seconds per epoch of each row, compared with a plain implementation of the same network."""

import torch

from experiments.benchmarks.harness import median_seconds, training_config
from experiments.benchmarks.reference_models import PLAIN, train_epoch
from skin.build import build_data, build_device, build_learner
from skin.console import quiet
from skin.datamodule import TouchData
from skin.learner.network import Network


def measure_training(row: str, repeats: int) -> dict[str, float]:
    """Return the median seconds per epoch on 4038 finite-element gestures, and the plain twin's times that.

    Both train on the same touches with batches of 64; samples of the twin are made beforehand.
    """
    quiet()
    config = training_config("simulator=fem", f"experiment={row}", f"trainer.max_epochs={repeats + 1}")
    data, learner = build_data(config, build_device(config)), build_learner(config)
    assert isinstance(learner, Network)
    learner.fit(data)
    ours = learner.seconds_per_epoch
    return {"seconds_per_epoch": ours, "ratio_to_plain": plain_seconds(row, data, repeats) / ours}


def measure_drawn_skins(repeats: int) -> dict[str, float]:
    """Return the median seconds per epoch of any_skin, for its number of gestures, from a fifth of them.

    Twenty skins instead of 200: a batch mixes skins in the same way.
    """
    quiet()
    settings = ("device.count=20", "data.gestures=8000", f"trainer.max_epochs={repeats + 1}")
    config = training_config("simulator=solid", "experiment=any_skin", *settings)
    learner = build_learner(config)
    assert isinstance(learner, Network)
    learner.fit(build_data(config, build_device(config)))
    return {"seconds_per_epoch": 5 * learner.seconds_per_epoch}


def plain_seconds(row: str, data: TouchData, repeats: int) -> float:
    """Return the seconds per epoch of a row's plain twin, from a few batches: its slowest takes minutes."""
    touches = data.touches("train")
    assert touches.labels is not None
    twin = PLAIN[row]()
    samples, labels = twin.samples(touches, data.device.size), touches.labels
    optimizer = torch.optim.Adam(twin.parameters(), 1e-3)
    some = 8 * data.batch_size
    taken = median_seconds(lambda: train_epoch(twin, optimizer, samples, labels[:some]), repeats)
    return taken * len(labels) / some
