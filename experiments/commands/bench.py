"""Measure speed and memory, each against a peer in the same run.

    skin bench
    skin bench benchmark=wire benchmark.seconds=600 benchmark.check=crc16

benchmark=all measures each in relation to a peer. Writes bench.json, or bench_<benchmark>.json, into out=.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, Literal

from annotated_types import Ge
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from skin.command import command
from skin.config import plain
from skin.files import results
from skin.settings import configured, import_target

SIMULATORS = ("naive", "fem", "solid")
PACKAGES = ("torch", "pytorch-lightning", "torch-geometric", "numpy", "scipy", "scikit-fem", "PyNiteFEA")


@command("bench")
def main(config: DictConfig) -> None:
    """Run a benchmark and write its results; exit code 1 if the decoder missed frames."""
    settings = plain(config)["benchmark"]
    target = import_target(settings.pop("_target_"), "benchmark")

    from skin.files import write

    found = configured(target, settings, "benchmark")
    chosen = HydraConfig.get().runtime.choices["benchmark"]
    text = json.dumps(found, indent=2)
    write(text + "\n", results(config.out) / f"bench{'' if chosen == 'all' else f'_{chosen}'}.json")
    print(text)
    sys.exit(1 if found.get("missed") else 0)


def run_all(
    repeats: Annotated[int, Ge(3)],
    rows: Sequence[Literal["temporal_graph", "temporal_image", "sequence_graph", "sequence_image"]],
) -> dict[str, Any]:
    """Return the results of all benchmarks.

    Args:
        repeats: number of repetitions; medians are returned.
        rows: rows whose training is timed; each has a reference model.
    """
    from rich.console import Console

    from experiments.benchmarks import training
    from experiments.benchmarks.harness import machine, median_seconds, versions
    from experiments.benchmarks.wire import decode_core_share

    say = Console(stderr=True).print
    found: dict[str, Any] = {"repeats": repeats, "machine": machine(), "versions": versions(PACKAGES)}
    say("generation, device, live")
    found["generation"] = {
        name: run_alone("generation", "measure_generation", name, repeats) for name in SIMULATORS
    }
    found["generate"] = run_alone("data_sets", "measure_data_set", 16 * 4096, repeats)
    found["device"] = {"decode_core_share": decode_core_share()}
    found["live"] = run_alone("live_latency", "measure_latency", 1000) | {
        "any_skin": run_alone("live_latency", "measure_latency", 1000, "any_skin")
    }
    found["live"]["onnx"] = run_alone("onnx_latency", "measure_onnx_latency", 1000)
    say("operator")
    found["operator"] = {
        name: run_alone("building", "measure_building", name, repeats) for name in SIMULATORS
    }
    say("bound and placement: about two minutes")
    found["design"] = run_alone("designing", "measure_design", repeats)
    say("peers of the finite-element skins: about two minutes")
    _compare(found["generation"], repeats, say)
    say("start")
    command = [sys.executable, "-m", "skin", "train", "--help"]
    start = partial(subprocess.run, command, capture_output=True, check=True)
    found["startup"] = {"help_seconds": median_seconds(start, repeats)}
    found["training"] = {}
    for row in rows:
        say(f"training of {row}")
        found["training"][row] = training.measure_training(row, repeats)
    say("training of any_skin")
    found["training"]["any_skin"] = training.measure_drawn_skins(repeats)
    return found


def _compare(generation: dict[str, dict[str, float]], repeats: int, say: Callable[[str], None]) -> None:
    """Add the speed of each finite-element skin relative to other solvers, per frame."""
    from experiments.benchmarks import mechanics
    from experiments.benchmarks.generation import GESTURES

    pynite = mechanics.pynite_seconds_per_frame(repeats)
    if pynite is None:
        say("PyNite is not installed: the ratio to it is left out")
    for name in SIMULATORS[1:]:
        own = generation[name]
        frames = round(GESTURES * own["frames_per_second"] / own["gestures_per_second"])
        direct = mechanics.direct_seconds_per_frame(name, frames, repeats)
        if pynite is not None:
            own["ratio_to_pynite"] = pynite * own["frames_per_second"]
        own["ratio_to_direct_solve"] = direct * own["frames_per_second"]


def run_alone(module: str, function: str, *arguments: object) -> dict[str, float]:
    """Run a benchmark in its own process, so that its peak memory and its threads are its own."""
    imports = f"import json; from experiments.benchmarks.{module} import {function}"
    command = [sys.executable, "-c", f"{imports}; print(json.dumps({function}(*{arguments!r})))"]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
