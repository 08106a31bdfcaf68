"""Check the scale of a skin at a port with a known load on three sensors.

    skin check device.port=/dev/ttyACM0 device.scale=0.039 weight=0.5 base=0.006
    skin check device.port=/dev/ttyACM0 device.calibration=mine.yaml

The load is a second reference: a weight (kg) on a round base (radius, m), or a finger while a kitchen scale
below the skin shows the weight. It lies on any three sensors for ten seconds each; no key is needed. If the
readings agree with simulator= within 25 %, the check is stored, and skin live no longer says "unverified".
"""

import sys
from dataclasses import asdict
from datetime import UTC, datetime

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config


@command("check")
def main(config: Config) -> None:
    """Compare readings under the load with predicted ones, and store the result."""
    from skin.hardware.check import (
        Check,
        describe_setup,
        measure_ratios,
        require_agreement,
        store_check,
    )
    from skin.hardware.known_loads import KnownLoad, base_readings
    from skin.hardware.serial import require_port
    from skin.hardware.wire.reader import SkinDisconnected, SkinTimeout
    from skin.runs.build import build_device, build_skin

    load = KnownLoad(config.weight, config.base, None)
    device = require_port(build_device(config))
    load.check(device.size)
    if config.base is None or not config.seconds or config.seconds < 3:
        raise InputError(f"seconds={config.seconds}: each load must lie for at least 3 s, as in seconds=10")
    expected = load.force * base_readings(build_skin(config), config.base)
    try:
        with device.wire.open()[0] as skin:
            first, conversion = device.wire.warm_up(skin, _notify)
            _notify(
                f"put {load.weight:g} kg on three sensors in turn, for {config.seconds:g} s each: far from "
                "each other, and from the rim"
            )
            ratios = measure_ratios(skin, first, conversion, expected, config.seconds, _notify)
            setup = describe_setup(
                device.wire, skin.header, conversion, device.sensors.positions, device.size
            )
    except (SkinTimeout, SkinDisconnected) as error:
        raise InputError(f"{config.device['port']}: {error}") from error
    require_agreement(ratios)
    rest = conversion.zero if conversion.rest is None else conversion.raw(conversion.rest)
    date = datetime.now(UTC).isoformat(timespec="seconds")
    path = store_check(Check(**asdict(setup), date=date, ratios=ratios, rest=rest.tolist()))
    print(f"{path}: the scale agrees, times {', '.join(f'{ratio:.3g}' for ratio in ratios.values())}")


def _notify(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
