"""Set up a skin of your own at a port, from the board to the live view.

    skin setup device.port=/dev/ttyACM0
    skin setup device.port=/dev/ttyACM0 step=calibrate

Explains each step, prints the command that it runs, and keeps its output in the folder out=, which shows that
it is done: the same command continues with the next one. Ctrl-C ends the command of a step, q the guide.
"""

import os
import shlex
import signal
import sys
from contextlib import suppress
from math import ceil, inf
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

from skin.commands._command import command, notify
from skin.core.files import results, write
from skin.errors import InputError
from skin.runs.configuration import Config, overrides


@command("setup")
def main(config: Config, out: str, step: str | None, steps: dict[str, Any]) -> None:
    """Offer each step, from the first that is not done, and run its command."""
    if config.device["port"] is None:
        raise InputError("device.port is missing: add device.port=/dev/ttyACM0, the port of your board")
    if step not in (None, *steps):
        raise InputError(f"there is no step={step}: give one of {', '.join(steps)}")
    folder, order = results(out), list(steps)
    given = [word for word in overrides() if not word.startswith("step=")]
    files = (folder / about.get("file", "") for about in steps.values())
    times = [file.stat().st_mtime if file.is_file() else inf for file in files]
    # A step is due again if one before it was repeated.
    due = (number for number, time in enumerate(times) if time == inf or time < max(times[: number + 1]))
    number = order.index(step) if step else next(due)
    with suppress(EOFError, KeyboardInterrupt):
        while number < len(order):
            about = steps[order[number]]
            notify(f"\n{number + 1} of {len(order)}: {order[number]} {about['aim']}")
            answer = input(f"Enter runs it, q ends, or go to {', '.join(order)}: ").strip()
            if answer == "q":
                break
            if answer in order:
                number = order.index(answer)
            elif answer:
                notify(f"there is no step {answer}")
            else:
                number += _succeeds(folder, [word for word in given if word.startswith("device.")], **about)
    notify(f"\nto continue: skin setup {shlex.join(given)}")


def _succeeds(folder: Path, port: list[str], aim: str, command: str, file: str = "", load: str = "") -> bool:
    """Ask what a step needs, print its command and run it; return whether it succeeded.

    Args:
        folder: of the guide.
        port: settings of the port, as overrides.
        aim, command, file, load: of the step, as in conf/setup.yaml.
    """
    if command.startswith("design"):
        _describe(folder)
    if load:
        mass, radius = _ask("its mass, kg, and the radius of its round base, mm", load)
        load = f"weight={mass:g} base={1e-3 * radius:g}"
    words = [
        os.path.expanduser(word) for word in shlex.split(command.format(port=shlex.join(port), load=load))
    ]
    notify(f"$ skin {shlex.join(words)}" + f" | tee {folder / file}" * bool(file))
    # This command lets Hydra raise its errors; the other one shall explain them.
    environment = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}
    program, output, text = [sys.executable, "-m", "skin", *words], PIPE if file else None, ""
    signal.signal(signal.SIGINT, lambda *_: None)  # Ctrl-C ends the other command alone
    with Popen(program, stdout=output, text=True, env=environment) as process:
        for line in process.stdout or ():
            print(line, end="", flush=True)
            text += line
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if file and not process.returncode:
        write(text, folder / file)
    return not process.returncode


def _ask(question: str, usual: str, unit: float = 1.0) -> list[float]:
    """Ask until the answer is as many numbers above 0 as the usual one; return them times a unit."""
    while True:
        words = input(f"{question} [{usual}]: ").replace(",", " ").split() or usual.split()
        with suppress(ValueError):
            numbers = [unit * float(word) for word in words]
            if len(numbers) == len(usual.split()) and 0 < min(numbers) <= max(numbers) < inf:
                return numbers
        notify(f"give {len(usual.split())} numbers above 0, as in {usual}")


_QUESTIONS = (
    ("size of the skin along x and y, mm", "160 160", 1e-3),
    ("thickness of the layers below and above the sensors, mm", "10 5", 1e-3),
    ("their Young's moduli, kPa (Dragon Skin 10 Medium 560, EcoFlex 00-30 170)", "560 170", 1e3),
    ("sensing area of a sensor along x and y, mm", "10 10", 1e-3),
    ("rows and columns of sensors, in the order of channels", "3 3"),
)
_SKIN = """\
# @package _global_
# docs/your-skin.md explains what stands here.
defaults:
  - override /simulator: solid
body:
  _target_: skin.body.sheet.Sheet
  _convert_: all
  size: [{size[0]:g}, {size[1]:g}]  # m
  cells: {cells}
  layers:  # from the bottom up; m, Pa
    - {{material: {{name: lower, young: {young[0]:g}, poisson: 0.49}}, thickness: {layers[0]:g}}}
    - {{material: {{name: upper, young: {young[1]:g}, poisson: 0.49}}, thickness: {layers[1]:g}}}
layout:
  path: {path}
  footprint: [{area[0]:g}, {area[1]:g}]  # m
"""


def _describe(folder: Path) -> None:
    """Ask for body and sensors, and write them as docs/your-skin.md does; files that exist may be kept."""
    body, path = folder / "body" / "mine.yaml", folder / "sensors.csv"
    if body.exists() and input(f"Enter keeps {body} and {path}, which you may edit; n asks anew: ") != "n":
        return
    size, layers, young, area, grid = (_ask(*question) for question in _QUESTIONS)
    rows, columns = map(ceil, grid)
    pitch = _ask(
        f"pitch of the sensors along x and y, mm (centred; {path} may say otherwise)",
        " ".join(f"{1e3 * side / count:g}" for side, count in zip(size, (columns, rows), strict=True)),
        1e-3,
    )
    places = [
        f"{size[0] / 2 + pitch[0] * (column - (columns - 1) / 2):.6g},"
        f"{size[1] / 2 + pitch[1] * (row - (rows - 1) / 2):.6g}"
        for row in range(rows)
        for column in range(columns)
    ]
    write("\n".join(["x_m,y_m", *places, ""]), path)
    cells = [max(8, round(side / 0.005)) for side in size]  # m, as that page advises
    write(_SKIN.format(size=size, cells=cells, layers=layers, young=young, path=path, area=area), body)
