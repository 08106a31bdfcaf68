"""Measure speed and memory.

    python -m experiments.benchmarks repeats=3 out=results
    python -m experiments.benchmarks only=live.onnx,wire against=../other

Writes bench.json into ``out``. With ``against=`` every figure is also measured with the package ``skin`` of
that checkout, in turns, and ``ratios`` has what this checkout measures over what the other does.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from skin.core.files import ROOT, results, write
from skin.errors import InputError

Figures = dict[str, float]
Benchmark = tuple[str, str, tuple[object, ...]]
"""Module, function and arguments."""

ROWS = ("temporal_graph", "temporal_image", "sequence_graph", "sequence_image")
"""Rows whose epochs are timed."""

_FRAMES = 1000  # of which each is classified
_PACKAGES = ("torch", "pytorch-lightning", "numpy", "scipy", "scikit-fem")
_DEFAULTS = {"repeats": "3", "out": "results", "only": "", "against": ""}


def benchmarks(repeats: int) -> dict[str, Benchmark]:
    """Return all benchmarks by name."""
    chosen: dict[str, Benchmark] = {}
    for name in ("naive", "fem", "solid"):
        chosen[f"generation.{name}"] = ("training", "measure_generation", (name, repeats))
    for name in ("fem", "solid"):
        chosen[f"operator.{name}"] = ("training", "measure_operator", (name, repeats))
    for row in (*ROWS, "any_skin"):
        chosen[f"training.{row}"] = ("training", "measure_training", (row, repeats))
    for row in ("best_fresh", "any_skin"):
        chosen[f"live.{row}"] = ("live", "measure_latency", (row, _FRAMES))
    chosen["live.onnx"] = ("live", "measure_onnx_latency", ("best_fresh", _FRAMES))
    return chosen | {"wire": ("live", "measure_decoder", ())}


def main(arguments: Sequence[str]) -> None:
    """Run the benchmarks and write their figures.

    Raises:
        InputError: an unknown setting, benchmark or checkout.
    """
    settings = read_settings(arguments)
    known = benchmarks(int(settings["repeats"]))
    names = [name for name in settings["only"].split(",") if name] or list(known)
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"only={','.join(unknown)} is none of {', '.join(known)}")
    from experiments.benchmarks.harness import machine, versions

    about = {"repeats": int(settings["repeats"]), "machine": machine(), "versions": versions(_PACKAGES)}
    measured: dict[str, Any] = about
    for name in names:
        print(name, file=sys.stderr)
        measured[name] = run_alone(*known[name])
        if settings["against"]:
            other = run_alone(*known[name], checkout=Path(settings["against"]))
            ratios = {key: value / other[key] for key, value in measured[name].items() if other[key]}
            measured[name] = {"here": measured[name], "there": other, "ratios": ratios}
    text = json.dumps(measured, indent=2)
    write(text + "\n", results(settings["out"]) / "bench.json")
    print(text)


def read_settings(arguments: Sequence[str]) -> dict[str, str]:
    """Return all settings from words ``name=value``.

    Raises:
        InputError: an unknown name or a bad value.
    """
    settings = dict(_DEFAULTS)
    for word in arguments:
        name, _, value = word.partition("=")
        if name not in settings or not value:
            raise InputError(f"{word} is no setting: give some of {', '.join(f'{key}=' for key in settings)}")
        settings[name] = value
    if not settings["repeats"].isdecimal() or int(settings["repeats"]) < 3:
        raise InputError(
            f"repeats={settings['repeats']} must be a number of at least 3: medians are returned"
        )
    if settings["against"] and not (Path(settings["against"]) / "skin").is_dir():
        raise InputError(
            f"against={settings['against']} has no folder skin: give another checkout of this project"
        )
    return settings


def run_alone(module: str, function: str, arguments: Sequence[object], checkout: Path = ROOT) -> Figures:
    """Run a benchmark in its own process, so that its peak memory and its threads are its own.

    Args:
        module, function, arguments: of this package.
        checkout: folder of the package ``skin`` that is measured.
    """
    command = [sys.executable, "-P", "-m", "experiments.benchmarks.harness", module, function]
    with TemporaryDirectory() as folder:
        # These benchmarks, and not those of the other checkout.
        (Path(folder) / "experiments").symlink_to(ROOT / "experiments")
        paths = os.pathsep.join([folder, str(checkout.resolve())])
        done = subprocess.run(
            [*command, json.dumps(arguments)],
            env=os.environ | {"PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return json.loads(done.stdout)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
