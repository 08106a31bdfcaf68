"""Check a port: print frame rate, errors and channel values.

    skin listen device.port=/dev/ttyACM0

Listens for seconds=, or until Ctrl-C.
"""

import signal
from contextlib import suppress

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config


@command("listen")
def main(config: Config) -> None:
    """Print rate and errors once a second, and statistics of each channel at the end."""
    device = config.device
    if device["port"] is None:
        raise InputError(
            "device.port is missing: add device.port=/dev/ttyACM0 or device.port=socket://HOST:NUMBER"
        )

    from skin.hardware.wire.reader import PortSettings, SkinDisconnected, SkinTimeout
    from skin.hardware.wire.skin import PortMonitor, open_skin

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sensors = None if config.n is None else range(config.n)
    with open_skin(PortSettings.select(device), sensors) as skin:
        listener = PortMonitor(skin)
        try:
            with suppress(KeyboardInterrupt):
                for line in listener.lines(config.seconds):
                    print(line, flush=True)
        except (SkinTimeout, SkinDisconnected) as error:
            raise InputError(f"{device['port']}: {error}") from error
        print(listener.summary())
