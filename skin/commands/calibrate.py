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
from typing import TYPE_CHECKING, Any

from skin.commands._command import command
from skin.core.settings import configured
from skin.errors import InputError
from skin.runs.configuration import Config

if TYPE_CHECKING:
    from skin.calibration.bench import BenchSession, Gauge
    from skin.calibration.wiring import Confirmed
    from skin.device.base import AbstractSimulated
    from skin.device.calibration import Calibration

_UNITS = ("force_scale", "time_scale")
_CONFIRMED = ("places", "channels", "broken")


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
    if missing := [name for name in files if name and not Path(name).expanduser().is_file()]:
        raise InputError(f"no file {missing[0]}: calibrate.demo=true makes a session without hardware")
    by_load = weight is not None or base is not None
    if by_load and presses is not None:
        raise InputError("a known load replaces the gauge: leave out presses=, or weight= and base=")

    from skin.calibration import bench, known_loads
    from skin.calibration.bench_protocol import write_demo_session
    from skin.calibration.wiring import Confirmed, device_channels
    from skin.device.calibration import write_calibration
    from skin.runs.build import build_device

    confirmed = configured(Confirmed, {name: calibrate[name] for name in _CONFIRMED}, "calibrate")
    units = configured(bench.Units, {name: calibrate[name] for name in _UNITS}, "calibrate")
    device = build_device(config).simulated("a calibration fits the simulation to a skin")
    shape = calibrate["indenter"], calibrate["radius"]
    about: dict[str, Any] = {"session": session}
    load = known_loads.KnownLoad.of(weight, base, device.size) if by_load else None
    if calibrate["demo"] and load is not None:
        print(known_loads.write_demo_placements(device, load, calibrate, session))
    elif calibrate["demo"]:
        print(write_demo_session(device, calibrate, session))
    recorded = bench.read_bench_session(session, *shape, calibrate["unit"], units)
    if load is not None:
        result = known_loads.fit_known_load(device, confirmed.ordered(recorded), load)
        known_loads.print_known_load(result)
        calibration = result.calibration
    else:
        rows = None if presses is None else bench.read_gauge(presses, *shape, calibrate["delay"], units)
        calibration, errors = _fit_presses(device, recorded, rows, confirmed, calibrate, out)
        about = {**errors, **about, "presses_file": presses}
    about, channels = {**calibration.about, **about}, device_channels(recorded, confirmed)
    print(write_calibration(replace(calibration, about=about, channels=channels), out))


def _fit_presses(
    device: "AbstractSimulated",
    session: "BenchSession",
    rows: "Gauge | None",
    confirmed: "Confirmed",
    settings: dict[str, Any],
    out: str,
) -> tuple["Calibration", dict[str, Any]]:
    """Return a calibration and its errors on held-out presses; end the command where it does not help."""
    from rich.console import Console

    from skin.calibration import fit as fitting
    from skin.calibration.gauge_drift import check_gauge
    from skin.calibration.wiring import check_usable, wired_bench

    with Console(stderr=True).status("fitting"):
        bench = wired_bench(device, session, rows, confirmed)
        check_gauge(bench)
        calibration = fitting.fit_calibration(bench)
        check_usable(calibration)
        if settings["force_scale"] is None:
            fitting.check_force(calibration, device.imperfection.clip)
        outcome = fitting.evaluate_held_out(bench, settings["held_out"])
    fitting.print_calibration(calibration, outcome)
    if not outcome.helps:
        print(
            f"The calibration does not reduce the error, so {out} was not written: is the layout, the "
            "body or the clock wrong?"
        )
        sys.exit(1)
    rmse = {name: round(getattr(outcome, name), 6) for name in ("simulated", "tared", "calibrated")}
    return calibration, {"held_out": list(outcome.held_out), "rmse": rmse}
