"""Emulate a skin at a pseudo-terminal or TCP port, with simulated gestures.

    skin emulate port=pty link=./skin-port

Prints the settings that connect to it, then sends gestures until Ctrl-C.
"""

import signal
from contextlib import suppress
from typing import Any, Literal

from skin.commands._command import command
from skin.core.settings import configured
from skin.runs.configuration import Config


@command("emulate")
def main(
    config: Config,
    port: str,
    link: str | None,
    seconds: float | None,
    gestures: int | None,
    format: Literal["text", "binary"],
    emulate: dict[str, Any],
    faults: dict[str, Any],
) -> None:
    """Send gestures of the configured simulator, device and layout in real time."""
    from skin.runs.build import build_device
    from skin.wire.emulator import Emulator, EmulatorSettings, Faults, open_port

    settings = configured(EmulatorSettings, emulate, "emulate")
    failures = configured(Faults, faults, "faults")
    device = build_device(config).simulated("only simulated gestures can be emulated")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    opened = open_port(port, link)
    try:
        emulator = Emulator(
            device,
            opened,
            settings,
            failures,
            format == "binary",
            lambda t, text: print(f"{t:8.2f} s  {text}", flush=True),
        )
        # Includes the first line, because its reader may stop the command at once.
        with suppress(KeyboardInterrupt):
            print(opened.address, flush=True)
            scale = f" device.scale={emulator.converter.scale:g}" if settings.bits else ""
            print(f"device=serial device.port={opened.address}{scale}", flush=True)
            emulator.run(seconds, gestures)
        print(f"{emulator.frames} frames")
    finally:
        opened.unplug()
