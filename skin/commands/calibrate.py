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
    if missing := [name for name in files if name and not Path(name).expanduser().exists()]:
        raise InputError(f"no file {missing[0]}: calibrate.demo=true makes a session without hardware")

    if weight is not None or base is not None:
        if presses is not None:
            raise InputError("a known load replaces the gauge: leave out presses=, or weight= and base=")
        _calibrate_by_load(config, calibrate, weight, base, session, out)
    else:
        _calibrate_by_gauge(config, calibrate, presses, session, out)


def _calibrate_by_load(
    config: Config, settings: dict[str, Any], weight: float | None, base: float | None, path: str, out: str
) -> None:
    """Calibrate from placements of a weight."""
    from skin.calibration.bench import Units, read_bench_session, write_bench_session
    from skin.calibration.known_loads import KnownLoad, emulate_known_load, fit_known_load, print_known_load
    from skin.calibration.wiring import Confirmed, device_channels
    from skin.core.settings import configured
    from skin.device.calibration import write_calibration
    from skin.runs.build import build_device

    confirmed = configured(Confirmed, {name: settings[name] for name in _CONFIRMED}, "calibrate")
    device = build_device(config).simulated("a calibration fits the simulation to a skin")
    load = KnownLoad.of(weight, base, device.size)
    if settings["demo"]:
        session = emulate_known_load(device, load, settings)
        print(f"{write_bench_session(session, path)}: {session.time[-1]:.0f} s")
    units = configured(Units, {name: settings[name] for name in _UNITS}, "calibrate")
    shape = settings["indenter"], settings["radius"]
    session = read_bench_session(path, *shape, settings["unit"], units)
    result = fit_known_load(device, confirmed.ordered(session), load)
    print_known_load(result)
    about = dict(result.calibration.about) | {"session": path}
    calibration = replace(result.calibration, about=about, channels=device_channels(session, confirmed))
    print(write_calibration(calibration, out))


def _calibrate_by_gauge(
    config: Config, settings: dict[str, Any], presses: str | None, path: str, out: str
) -> None:
    """Calibrate from presses of a force gauge."""
    from rich.console import Console

    from skin.calibration.bench import Units, read_bench_session, read_gauge
    from skin.calibration.bench_protocol import write_demo_session
    from skin.calibration.fit import (
        check_force,
        evaluate_held_out,
        fit_calibration,
        print_calibration,
    )
    from skin.calibration.gauge_drift import check_gauge
    from skin.calibration.wiring import Confirmed, check_usable, device_channels, wired_bench
    from skin.core.settings import configured
    from skin.device.calibration import write_calibration
    from skin.runs.build import build_device

    confirmed = configured(Confirmed, {name: settings[name] for name in _CONFIRMED}, "calibrate")
    device = build_device(config).simulated("a calibration fits the simulation to a skin")
    if settings["demo"]:
        print(write_demo_session(device, settings, path))
    shape = settings["indenter"], settings["radius"]
    units = configured(Units, {name: settings[name] for name in _UNITS}, "calibrate")
    session = read_bench_session(path, *shape, settings["unit"], units)
    rows = None if presses is None else read_gauge(presses, *shape, settings["delay"], units)
    with Console(stderr=True).status("fitting"):
        bench = wired_bench(device, session, rows, confirmed)
        check_gauge(bench)
        calibration = fit_calibration(bench)
        check_usable(calibration)
        if units.force_scale is None:
            check_force(calibration, device.imperfection.clip)
        outcome = evaluate_held_out(bench, settings["held_out"])
    print_calibration(calibration, outcome)
    if not outcome.helps:
        print(
            f"The calibration does not reduce the error, so {out} was not written: is the layout, the "
            "body or the clock wrong?"
        )
        sys.exit(1)
    rmse = {name: round(getattr(outcome, name), 6) for name in ("simulated", "tared", "calibrated")}
    about = dict(calibration.about) | {"held_out": list(outcome.held_out), "rmse": rmse}
    about |= {"session": path, "presses_file": presses}
    channels = device_channels(session, confirmed)
    print(write_calibration(replace(calibration, about=about, channels=channels), out))
