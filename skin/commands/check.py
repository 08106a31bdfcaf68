"""Check the scale of a skin at a port with a known load on three sensors.

    skin check device.port=/dev/ttyACM0 device.scale=0.039 weight=1.5 base=0.006
    skin check device.port=/dev/ttyACM0 device.calibration=mine.yaml

The load is a second reference: a weight (kg) on a round base (radius, m), or a finger while a kitchen scale
below the skin shows the weight. It lies on any three sensors for ten seconds each; no key is needed. If the
readings agree with simulator= within 25 %, the check is stored, and skin live no longer says "unverified".
"""

from datetime import UTC, datetime
from typing import Annotated

from annotated_types import Ge

from skin.commands._command import command, notify
from skin.errors import InputError
from skin.runs.configuration import Config


@command("check")
def main(config: Config, weight: float | None, base: float | None, seconds: Annotated[float, Ge(2)]) -> None:
    """Compare readings under the load with predicted ones, and store the result."""
    from skin.calibration.check import Check, describe_setup, store_check
    from skin.calibration.known_loads import KnownLoad, firm_readings, measure_ratios
    from skin.record.serial import require_port
    from skin.runs.build import build_device, build_skin
    from skin.touch.fingertips import read_touch
    from skin.wire.reader import SkinDisconnected, SkinTimeout

    device = require_port(build_device(config))
    load = KnownLoad.of(weight, base, device.size)
    expected = firm_readings(
        build_skin(config).simulator(device.body, device.sensors),
        device.body,
        device.sensors,
        load,
        read_touch(config.touch).danger,
    )
    try:
        with device.wire.open() as skin:
            first, conversion = device.wire.warm_up(skin, notify)
            notify(
                f"put {load.weight:g} kg on {min(3, len(expected))} sensors in turn, far from each other and "
                f"from the rim, each for {seconds:g} s and until it is counted"
            )
            ratios = measure_ratios(skin, first, conversion, expected, seconds, notify)
    except (SkinTimeout, SkinDisconnected) as error:
        raise InputError(f"{config.device['port']}: {error}") from error
    setup = describe_setup(device.wire, skin.header, conversion, device.sensors.positions, device.size)
    rest = conversion.zero if conversion.rest is None else conversion.raw(conversion.rest)
    path = store_check(Check(setup, datetime.now(UTC).isoformat(timespec="seconds"), ratios, rest.tolist()))
    print(f"{path}: the scale agrees, times {', '.join(f'{ratio:.3g}' for ratio in ratios.values())}")
