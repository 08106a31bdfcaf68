"""Record touches of a skin at a port.

    skin record out=session device.port=/dev/ttyACM0 device.scale=0.039

Prompts for each gesture. Ctrl-C stops; the same command resumes. Writes a folder, and session.parquet for
device=recording; record.finish=true writes only that.
"""

from contextlib import suppress
from typing import Any

from skin.commands._command import command, notify, output
from skin.runs.configuration import Config


@command("record")
def main(config: Config, out: str | None, seconds: float | None, record: dict[str, Any]) -> None:
    """Record raw frames to a session, then convert its gestures to a recording."""
    path = output(out, "session", "")

    from skin.record.serial import convert_session, record_session, require_port
    from skin.runs.build import build_device

    device = require_port(build_device(config))
    if not record["finish"]:
        with suppress(KeyboardInterrupt):
            record_session(device, path, seconds, record["free"], notify)
    written, count = convert_session(device, path)
    print(f"{written}: {count} gestures")
