"""Show the predictions of a trained run for a skin in real time.

    skin live device=serial device.port=/dev/ttyACM0
    skin live run=skin.onnx device=serial device.port=/dev/ttyACM0
    skin live web=true
    skin live demo=true

run=latest names the run, or a file of skin export, which starts faster; web=true also serves a page. Without
device= the simulator of the run is used: no hardware is needed. demo=true emulates the skin of a pretrained
model at a port of this machine and serves the page. Ctrl-C stops.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from threading import Thread
from typing import Any

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config, overrides

_SKIN = {"body", "layout", "simulator"}
_DEMO = (
    "touch=fingertips",
    "touch.force=2",
    "layout=grid",
    "layout.rows=6",
    "layout.columns=6",
    "body.layers=[{material: Dragon Skin 10 Medium, thickness: 0.01}, "
    "{material: EcoFlex 00-30, thickness: 0.01}]",
)
"""Settings of a demonstration, unless others are given: fingertips, on a skin that separates them."""


@command("live")
def main(
    config: Config, run: str, demo: bool, web: bool, seconds: float | None, live: dict[str, Any]
) -> None:
    """Load a run or an exported model, open the skin, and show verdicts until the command is ended."""
    from skin.core.messages import quiet
    from skin.live.engine_builder import LiveSettings
    from skin.live.view import show
    from skin.runs.run import find_run

    words, settings = overrides(), LiveSettings.of(live)
    if not demo:
        show(run, config, words, settings, web, seconds)
        return
    if devices := [word for word in words if word.startswith("device=")]:
        raise InputError(f"demo=true emulates a skin at a port: leave out {devices[0]}, or demo=true")
    given = {_group(word) for word in words}
    run = run if "run" in given else "any_skin"
    quiet()
    find_run(config.tracking, run, config.trust)  # refused before a page is opened
    replaced = given | (_SKIN if given & {"run", *_SKIN} else set())
    words = [*(word for word in _DEMO if _group(word) not in replaced), *words]
    skin = [word for word in words if _group(word) in {"touch", *_SKIN}]
    words = [word for word in words if _group(word) != "touch"]
    show(
        run,
        config,
        words,
        settings,
        web or "web" not in given,
        seconds,
        emulated=_emulated_skin(run, config, skin),
    )


def _group(word: str) -> str:
    return re.split(r"[.=]", word, maxsplit=1)[0]


@contextmanager
def _emulated_skin(run: str, config: Config, overrides: Sequence[str]) -> Iterator[list[str]]:
    """Emulate the skin of a run, without the imperfections of its training, at a port of this machine.

    Args:
        run: name of a run that was trained on a simulated skin.
        config: of the command.
        overrides: settings that replace those of the run.

    Yields:
        The settings of a device at this port, as overrides.

    Raises:
        InputError: there is no such run, or its skin cannot be emulated.
    """
    from skin.runs.build import build_device
    from skin.runs.run import find_run
    from skin.wire.emulator import Emulator, EmulatorSettings, TcpPort

    device = build_device(
        find_run(config.tracking, run, config.trust).configured(["device=simulated", *overrides])
    ).simulated("a skin is emulated")
    port = TcpPort(0)
    # At rest until the view has its baseline.
    emulator = Emulator(device, port, EmulatorSettings(idle=10.0))
    thread = Thread(target=emulator.run, name="skin-emulator", daemon=True)
    thread.start()
    try:
        yield ["device=serial", f"device.port={port.address}", f"device.scale={emulator.converter.scale}"]
    finally:
        emulator.stop()
        thread.join()
        port.unplug()
