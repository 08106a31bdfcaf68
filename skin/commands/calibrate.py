"""Fit the simulated device to bench measurements of a real one.

    skin calibrate session=bench.csv presses=gauge.csv
    skin calibrate session=bench.csv weight=2.0 base=0.02
    skin calibrate session=bench.csv weight=2.0 base=0.04 incline=20 downhill=[45,225] height=0.02
    skin calibrate session=demo.csv calibrate.demo=true

A known weight (kg) on a round base (radius, m) that lay on every sensor replaces the gauge. Writes out=, for
device.calibration=. With a gauge, exits with 1 if it does not predict held-out presses better.
calibrate.demo=true first writes the session of an emulated device: no hardware is needed.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Lt

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config


@command("calibrate")
def main(
    config: Config,
    session: str | None,
    presses: str | None,
    weight: float | None,
    base: float | None,
    incline: Annotated[float, Gt(0), Lt(45)] | None,
    downhill: Sequence[float] | None,
    height: Annotated[float, Ge(0)] | None,
    out: str,
    calibrate: dict[str, Any],
) -> None:
    """Print the errors on held-out presses, or what a known load gives, and write the calibration."""
    if session is None or (calibrate["demo"] and Path(session).expanduser().exists()):
        raise InputError("which session? add session=bench.csv; for a demo, a file that does not exist")
    by_load = any(value is not None for value in (weight, base, incline, downhill, height))
    if by_load and presses is not None:
        raise InputError("a known load replaces the gauge: leave out presses=, or weight= and base=")

    from skin.calibration.bench import BenchSettings, read_bench_session
    from skin.calibration.fit import fit_presses, print_calibration
    from skin.calibration.known_loads import KnownLoad, fit_known_load, write_demo
    from skin.calibration.wiring import ordered, wired_bench
    from skin.device.calibration import write_calibration
    from skin.runs.build import build_device

    settings = BenchSettings.of(calibrate, "calibrate")
    device = build_device(config).simulated("a calibration fits the simulation to a skin")
    load = KnownLoad.of(weight, base, device.size, incline, downhill, height) if by_load else None
    if calibrate["demo"]:
        print(write_demo(device, load, calibrate["bits"], session))
        settings = replace(settings, unit="adc" if calibrate["bits"] else settings.unit)
    recorded = read_bench_session(session, settings, presses)
    if load is not None:
        calibration, errors = fit_known_load(device, ordered(recorded, settings), load), None
    else:
        calibration, errors = fit_presses(
            device,
            wired_bench(device, recorded, settings),
            calibrate["held_out"],
            settings.force_scale is not None,
        )
    print_calibration(calibration, errors)
    if errors and not errors.helps:
        print(
            f"The calibration does not reduce the error, so {out} was not written: is the layout, the body "
            "or the clock wrong?"
        )
        sys.exit(1)
    channels = list(ordered(recorded, settings).channels or ())
    print(
        write_calibration(
            replace(
                calibration,
                about={**calibration.about, "session": session, "presses_file": presses},
                channels=channels * (channels != sorted(channels)),
            ),
            out,
        )
    )
