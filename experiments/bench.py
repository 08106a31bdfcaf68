"""Measure speed and memory, each against a peer in the same run, and write results/bench.json."""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from benchmarks.setting import ROWS, machine, seconds, versions
from skin.files import results

HERE = Path(__file__).parent
SIMULATORS = ("naive", "fem", "solid")
PACKAGES = ("torch", "pytorch-lightning", "torch-geometric", "numpy", "scipy", "scikit-fem", "PyNiteFEA")


def main() -> None:
    """Take every figure and write the file whole; progress goes to standard error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, choices=range(3, 100), default=3, metavar="N >= 3")
    parser.add_argument("--rows", nargs="*", choices=ROWS, default=ROWS)
    arguments = parser.parse_args()

    from benchmarks import training
    from benchmarks.wire import decode_core_share
    from skin.files import write

    repeats, say = arguments.repeats, Console(stderr=True).print
    figures = {
        "repeats": repeats,
        "machine": machine(),
        "versions": versions(PACKAGES),
    }
    say("generation, device, live")
    figures["generation"] = {name: _own("generation", name, str(repeats)) for name in SIMULATORS}
    figures["device"] = {"decode_core_share": decode_core_share()}
    figures["live"] = _own("live", "1000")
    say("operator")
    figures["operator"] = {name: _own("building", name, str(repeats)) for name in SIMULATORS}
    say("peers of the finite-element skins: about two minutes")
    _compare(figures["generation"], repeats, say)
    say("start")
    command = [sys.executable, str(HERE / "train.py"), "--help"]
    help_seconds = seconds(lambda: subprocess.run(command, capture_output=True, check=True), repeats)
    figures["startup"] = {"help_seconds": help_seconds}
    figures["training"] = {}
    for row in arguments.rows:
        say(f"training of {row}")
        figures["training"][row] = training.measure(row, repeats)
    text = json.dumps(figures, indent=2)
    write(text + "\n", results(None) / "bench.json")
    print(text)


def _compare(generation: dict[str, dict[str, float]], repeats: int, say: Callable[[str], None]) -> None:
    """Add to each finite-element skin how many times faster it is than its peers, per frame."""
    from benchmarks import mechanics
    from benchmarks.generation import GESTURES

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
    """Measure in a process of its own, so that its peak memory and its threads are its own."""
    command = [sys.executable, str(HERE / "benchmarks" / f"{module}.py"), *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


if __name__ == "__main__":
    main()
