"""Emulate a skin at a pseudo-terminal or TCP port, with simulated gestures.

    skin emulate port=pty link=./skin-port

Prints the settings that connect to it, then sends gestures until Ctrl-C.
"""

import signal
from contextlib import suppress
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from skin.commands._command import command
from skin.core.settings import configured
from skin.runs.configuration import Config


@command("emulate")
def main(
    config: Config,
    port: Annotated[int, Ge(0), Le(65535)] | Literal["pty"],
    link: str | None,
    seconds: float | None,
    gestures: int | None,
    emulate: dict[str, Any],
) -> None:
    """Send gestures of the configured simulator, device and layout in real time."""
    from skin.runs.build import build_device
    from skin.wire.emulator import Emulator, EmulatorSettings, PtyPort, TcpPort

    settings = configured(EmulatorSettings, emulate, "emulate")
    device = build_device(config).simulated("only simulated gestures can be emulated")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    opened = PtyPort(link) if port == "pty" else TcpPort(port)
    try:
        emulator = Emulator(
            device,
            opened,
            settings,
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
