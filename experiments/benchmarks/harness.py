"""Common parts of the benchmarks: configuration, timing, peak memory, versions; and the process of one.

python -m experiments.benchmarks.harness training measure_generation '["naive", 3]'
"""

import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from skin.core.files import CONF
from skin.runs.configuration import validate_config


def training_config(*overrides: str) -> DictConfig:
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


def peak_memory() -> int:
    """Return the peak resident memory of this process, bytes.

    On Linux ru_maxrss is inherited from the parent process; VmHWM is that of this process.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Return the versions of the installed packages among the given ones."""
    found = {}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def machine() -> str:
    """Return a description of the machine."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {_processor()}"


def _processor() -> str:
    """Return the name of the processor, if known."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


if __name__ == "__main__":
    module, function, arguments = sys.argv[1:]
    measure = getattr(import_module(f"experiments.benchmarks.{module}"), function)
    print(json.dumps(measure(*json.loads(arguments))))
