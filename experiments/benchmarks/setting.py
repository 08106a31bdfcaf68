"""What every measurement starts from: the default configuration, and how a figure is taken."""

import time
from collections.abc import Callable
from statistics import median

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from skin.config import CONF, checked

__all__ = ["configuration", "seconds"]


def configuration(*overrides: str) -> DictConfig:
    """Return the configuration of a training with overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(compose("train", list(overrides)))


def seconds(task: Callable[[], object], repeats: int) -> float:
    """Return the median duration of a task, s, after one call that is not counted."""
    task()
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        task()
        taken.append(time.perf_counter() - began)
    return median(taken)
