"""Measure speed and memory, each against a peer in the same run.

    skin bench

Writes bench.json into out=.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

from annotated_types import Ge
from omegaconf import DictConfig

from skin.command import command
from skin.config import plain
from skin.files import results
from skin.paths import ROOT
from skin.settings import check_settings

HERE = ROOT / "experiments"
SIMULATORS = ("naive", "fem", "solid")
PACKAGES = ("torch", "pytorch-lightning", "torch-geometric", "numpy", "scipy", "scikit-fem", "PyNiteFEA")


@command("bench")
def main(config: DictConfig) -> None:
    """Run all benchmarks and write bench.json; progress goes to standard error."""
    settings = plain(config)["bench"]
    check_settings(figures, settings, "bench")

    from skin.files import write

    text = json.dumps(figures(**settings), indent=2)
    write(text + "\n", results(config.out) / "bench.json")
    print(text)


def figures(
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
    found["generation"] = {name: _own("generation", name, str(repeats)) for name in SIMULATORS}
    found["device"] = {"decode_core_share": decode_core_share()}
    found["live"] = _own("live_latency", "1000")
    say("operator")
    found["operator"] = {name: _own("building", name, str(repeats)) for name in SIMULATORS}
    say("peers of the finite-element skins: about two minutes")
    _compare(found["generation"], repeats, say)
    say("start")
    command = [sys.executable, "-m", "skin", "train", "--help"]
    help_seconds = median_seconds(lambda: subprocess.run(command, capture_output=True, check=True), repeats)
    found["startup"] = {"help_seconds": help_seconds}
    found["training"] = {}
    for row in rows:
        say(f"training of {row}")
        found["training"][row] = training.measure_training(row, repeats)
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


def _own(module: str, *arguments: str) -> dict[str, float]:
    """Run a benchmark in its own process, with its own peak memory and threads."""
    command = [sys.executable, str(HERE / "benchmarks" / f"{module}.py"), *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
