"""When is the alarm raised, and does a held press stay one? python experiments/holds.py run=latest

Plays dangerous taps, presses, holds of 1 s to 10 min and slow ramps before the live engine of a finished run,
in the time of the device. Prints a line for each kind and writes holds_<row>_<run>.csv into out=.
"""

import csv
from functools import partial
from math import inf

from skin.command import command
from skin.config import DictConfig, overrides, plain
from skin.errors import InputError
from skin.files import results

_OWN = ("holds", "out", "run")


@command("holds")
def main(config: DictConfig) -> None:
    """Play every course of held touches to a finished run; print and write when it raises the alarm."""
    settings = plain(config)["holds"]
    count, rate = settings["gestures"], settings["rate"]
    if not (isinstance(count, int) and count > 0 and isinstance(rate, int | float) and 0 < rate < inf):
        raise InputError(f"holds.gestures={count} and holds.rate={rate} must be above 0: as in 40 and 100")

    import torch
    from rich.progress import track

    from skin.console import quiet
    from skin.files import whole
    from skin.hardware.live import start
    from skin.hardware.live.holds import FIELDS, courses
    from skin.hardware.live.verdict import Patience
    from skin.reload import changed, configuration, find
    from skin.tracking import Store
    from skin.trained import trained

    quiet()
    torch.set_num_threads(config.tracking.threads or 1)
    store = Store.open(config.tracking)
    run = find(store, config.run)
    given = [one for one in overrides() if one.lstrip("+~").split("=")[0].split(".")[0] not in _OWN]
    stored = configuration(store, run, config.trust)
    own = changed(stored, config, given)
    of = trained(store, run, own, stored)
    if (device := of.device.simulation) is None:
        raise InputError("held touches are simulated: give a run of simulated touches")
    engine = start.engine(of, Patience(), settings["touch"], settings["drift"])
    lines = [FIELDS]
    for said in courses(engine, device.replace(stream=False), count, rate, partial(track, transient=True)):
        lines.append(said)
        print(", ".join(f"{name} {value}" for name, value in zip(FIELDS, said, strict=True) if value != ""))
    path = results(config.out) / f"holds_{own.row}_{run.info.run_id[:8]}.csv"
    with whole(path) as partly, partly.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    print(path)


if __name__ == "__main__":
    main()
