"""Fit the simulated device to bench measurements of a real one.

    skin calibrate session=bench.csv presses=gauge.csv
    skin calibrate session=demo.csv calibrate.demo=true

Writes out=, for device.calibration=. Exits with 1 if it does not predict held-out presses better.
calibrate.demo=true first writes the session of an emulated device: no hardware is needed.
"""

import sys
from dataclasses import replace
from pathlib import Path

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config

_CONFIRMED = ("places", "channels", "broken")


@command("calibrate")
def main(config: Config) -> None:
    """Print the errors on held-out presses, and write a calibration with all presses."""
    if config.session is None:
        raise InputError("which session? add session=bench.csv, or try session=demo.csv calibrate.demo=true")
    files = [config.presses, None if config.calibrate["demo"] else config.session]
    if missing := [name for name in files if name and not Path(name).expanduser().is_file()]:
        raise InputError(f"no file {missing[0]}: calibrate.demo=true makes a session without hardware")

    from rich.console import Console

    from skin.core.settings import configured
    from skin.device.calibration import write_calibration
    from skin.hardware.bench import read_bench_session, read_gauge, write_demo_session
    from skin.hardware.calibration import (
        evaluate_held_out,
        fit_calibration,
        print_calibration,
    )
    from skin.hardware.wiring import Confirmed, check_usable, device_channels, wired_bench
    from skin.runs.build import build_device

    settings = config.calibrate
    confirmed = configured(Confirmed, {name: settings[name] for name in _CONFIRMED}, "calibrate")
    device = build_device(config).simulated("a calibration fits the simulation to a skin")
    if settings["demo"]:
        print(write_demo_session(device, settings, config.session))
    shape = settings["indenter"], settings["radius"]
    session = read_bench_session(config.session, *shape, settings["unit"])
    rows = None if config.presses is None else read_gauge(config.presses, *shape, settings["delay"])
    with Console(stderr=True).status("fitting"):
        bench = wired_bench(device, session, rows, confirmed)
        calibration = fit_calibration(bench)
        check_usable(calibration)
        outcome = evaluate_held_out(bench, settings["held_out"])
    print_calibration(calibration, outcome)
    if not outcome.helps:
        print(
            f"The calibration does not reduce the error, so {config.out} was not written: is the layout, the "
            "body or the clock wrong?"
        )
        sys.exit(1)
    rmse = {name: round(getattr(outcome, name), 6) for name in ("simulated", "tared", "calibrated")}
    about = dict(calibration.about) | {"held_out": list(outcome.held_out), "rmse": rmse}
    about |= {"session": config.session, "presses_file": config.presses}
    channels = device_channels(session, confirmed)
    print(write_calibration(replace(calibration, about=about, channels=channels), str(config.out)))
