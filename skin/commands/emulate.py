"""Emulate a skin at a pseudo-terminal or TCP port, with simulated gestures.

    skin emulate port=pty link=./skin-port

Prints the settings that connect to it, then sends gestures until Ctrl-C.
"""

import signal
from contextlib import suppress

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config

_FORMATS = ("text", "binary")


@command("emulate")
def main(config: Config) -> None:
    """Send gestures of the configured simulator, device and layout in real time."""
    if config.format not in _FORMATS:
        raise InputError(f"format must be one of {', '.join(_FORMATS)}, got {config.format}")

    from skin.core.settings import configured
    from skin.hardware.emulator import Emulator, EmulatorSettings, Faults, open_port
    from skin.runs.build import build_device

    settings = configured(EmulatorSettings, config.emulate, "emulate")
    faults = configured(Faults, config.faults, "faults")
    device = build_device(config).simulated("only simulated gestures can be emulated")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    port = open_port(str(config.port), config.link)
    try:
        emulator = Emulator(device, port, settings, faults, config.format == "binary", _notify)
        # Includes the first line, because its reader may stop the command at once.
        with suppress(KeyboardInterrupt):
            print(port.address, flush=True)
            scale = f" device.scale={emulator.converter.scale:g}" if settings.bits else ""
            print(f"device=serial device.port={port.address}{scale}", flush=True)
            emulator.run(config.seconds, config.gestures)
        print(f"{emulator.frames} frames")
    finally:
        port.unplug()


def _notify(t: float, text: str) -> None:
    print(f"{t:8.2f} s  {text}", flush=True)
