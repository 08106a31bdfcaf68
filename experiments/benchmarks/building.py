"""How long a simulator takes to build with nothing cached, and its memory; run in a process of its own."""

import os
import tempfile

from hydra.utils import instantiate

from experiments.benchmarks.harness import median_seconds, peak_memory, training_config


def measure_building(simulator: str, repeats: int) -> dict[str, float]:
    """Return the seconds to build the default skin's operator (median) and the peak memory, bytes."""
    config = training_config(f"simulator={simulator}")
    body, make = instantiate(config.body), instantiate(config.simulator)
    sensors = instantiate(config.layout).sensors(body)

    def build() -> None:
        with tempfile.TemporaryDirectory() as empty:
            os.environ["SKIN_CACHE"] = empty
            make(body, sensors)

    return {"build_seconds": median_seconds(build, repeats), "peak_memory_bytes": peak_memory()}
