"""Fit the simulated device to bench measurements of a real one.

    skin calibrate session=bench.csv presses=gauge.csv
    skin calibrate session=bench.csv weight=2.0 base=0.02
    skin calibrate session=demo.csv calibrate.demo=true

A known weight (kg) on a round base (radius, m) that lay on every sensor replaces the gauge. Writes out=, for
device.calibration=. With a gauge, exits with 1 if it does not predict held-out presses better.
calibrate.demo=true first writes the session of an emulated device: no hardware is needed.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

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
    out: str,
    calibrate: dict[str, Any],
) -> None:
    """Print the errors on held-out presses, or what a known load gives, and write the calibration."""
    if session is None:
        raise InputError("which session? add session=bench.csv, or try session=demo.csv calibrate.demo=true")
    files = [presses, None if calibrate["demo"] else session]
    if missing := [name for name in files if name and not Path(name).expanduser().exists()]:
        raise InputError(f"no file {missing[0]}: calibrate.demo=true makes a session without hardware")
    by_load = weight is not None or base is not None
    if by_load and presses is not None:
        raise InputError("a known load replaces the gauge: leave out presses=, or weight= and base=")

    from rich.console import Console

    from skin.calibration import bench, known_loads
    from skin.calibration.fit import fit_presses, print_calibration
    from skin.calibration.wiring import Confirmed, device_channels, wired_bench
    from skin.device.calibration import write_calibration
    from skin.runs.build import build_device

    confirmed = Confirmed(calibrate["places"], calibrate["channels"], calibrate["broken"])
    units = bench.Units(calibrate["force_scale"], calibrate["time_scale"])
    device = build_device(config).simulated("a calibration fits the simulation to a skin")
    load = known_loads.KnownLoad.of(weight, base, device.size) if by_load else None
    if calibrate["demo"]:
        print(
            known_loads.write_demo_session(device, calibrate, session)
            if load is None
            else known_loads.write_demo_placements(device, load, calibrate, session)
        )
    shape, metadata = (calibrate["indenter"], calibrate["radius"]), dict[str, Any](session=session)
    recorded = bench.read_bench_session(session, *shape, calibrate["unit"], units)
    if load is not None:
        result = known_loads.fit_known_load(device, confirmed.ordered(recorded), load)
        known_loads.print_known_load(result)
        calibration = result.calibration
    else:
        rows = None if presses is None else bench.read_gauge(presses, *shape, calibrate["delay"], units)
        clip = device.imperfection.clip if units.force_scale is None else None
        with Console(stderr=True).status("fitting"):
            calibration, errors = fit_presses(
                wired_bench(device, recorded, rows, confirmed), calibrate["held_out"], clip
            )
        print_calibration(calibration, errors)
        if not errors.helps:
            print(
                f"The calibration does not reduce the error, so {out} was not written: is the layout, the "
                "body or the clock wrong?"
            )
            sys.exit(1)
        metadata |= {"presses_file": presses}
    metadata, channels = {**calibration.about, **metadata}, device_channels(recorded, confirmed)
    print(write_calibration(replace(calibration, about=metadata, channels=channels), out))
