"""Check a port: print frame rate, errors and channel values; or propose an adapter for a board.

    skin listen device.port=/dev/ttyACM0
    skin listen device.port=/dev/ttyACM0 adapter=auto > board.yaml
    skin listen device.port=/dev/ttyACM0 device.adapter=board.yaml

Listens for seconds=, or until Ctrl-C.
"""

import signal
import sys
from contextlib import closing, suppress
from typing import Any

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config

_ENOUGH = 5.0  # s of a stream that show what a board sends


@command("listen")
def main(config: Config, seconds: float | None, adapter: Any) -> None:
    """Print rate and errors once a second, and statistics of each channel at the end."""
    device = config.device
    if device["port"] is None:
        raise InputError(
            "device.port is missing: add device.port=/dev/ttyACM0 or device.port=socket://HOST:NUMBER"
        )

    from skin.wire.reader import Port, SkinDisconnected, SkinTimeout
    from skin.wire.skin import PortMonitor, open_skin

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    settings = Port.select(device)
    if settings.frames.kind == "auto":
        _propose(str(settings.port), settings.baudrate, _ENOUGH if seconds is None else min(seconds, _ENOUGH))
        return
    with open_skin(settings, None) as skin:
        listener = PortMonitor(skin)
        try:
            with suppress(KeyboardInterrupt):
                for line in listener.lines(seconds):
                    print(line, flush=True)
        except (SkinTimeout, SkinDisconnected) as error:
            raise InputError(f"{device['port']}: {error}") from error
        print(listener.summary())


def _propose(port: str, baudrate: int, seconds: float) -> None:
    """Print an adapter that reads the board, as YAML to paste, with what it makes of it in comments."""
    from time import monotonic

    from skin.wire.proposal import propose
    from skin.wire.reader import PortStream

    pieces, begin = list[tuple[float, bytes]](), monotonic()
    with closing(PortStream(port, baudrate)) as stream, suppress(OSError):
        while (now := monotonic() - begin) < seconds:
            if data := stream.read():
                pieces.append((now, data))
    best, *others = propose(pieces, seconds)
    print(f"# {best.summary}", best.adapter.describe(), sep="\n")
    for other in others:
        print(f"# nearly as plausible: {other.summary}", *other.adapter.describe().splitlines(), sep="\n# ")
    print("save it, as board.yaml, and give device.adapter=board.yaml", file=sys.stderr)
