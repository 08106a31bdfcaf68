"""The same presses, simulated and recorded: python experiments/compare.py session=bench.csv presses=gauge.csv

Writes compare.md and compare.png into out=; run=latest also compares a run's verdicts. Without hardware,
experiments/calibrate.py session=demo.csv calibrate.demo=true makes a session.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from skin.config import ROOT, DictConfig, command, plain
from skin.errors import InputError

if TYPE_CHECKING:
    from skin.device.simulated import Simulated
    from skin.results.compare import Comparison


@command("compare")
def main(config: DictConfig) -> None:
    """Simulate the presses of a session, compare readings and, given a run, verdicts; write one page."""
    if config.session is None:
        raise InputError("which session? add session=bench.csv; calibrate.py calibrate.demo=true makes one")

    from skin.build import build_device
    from skin.calibration import gauge, session
    from skin.calibration.bench import bench
    from skin.console import quiet
    from skin.device.simulated import Simulated
    from skin.results.compare import compare, figure, page
    from skin.results.verdicts import whole

    quiet()
    settings = plain(config)["compare"]
    device = build_device(config)
    if not isinstance(device, Simulated):
        raise InputError("the other side is the session: leave out device=")
    shape = settings["indenter"], settings["radius"]
    said = session.read(config.session, *shape, settings["unit"])
    rows = None if config.presses is None else gauge.read(config.presses, *shape, settings["delay"])
    found = compare(device, bench(device, said, rows), settings["scale"])
    if not found.presses:
        raise InputError("no press has frames in the session: check the clocks, see compare.delay")
    agree = None if config.run is None else _agreement(config, device, found)
    about = f"Session {config.session}, simulated by {type(device.model).__name__}" + (
        f" with {device.calibration}." if device.calibration else ", not calibrated."
    )
    folder = ROOT / Path(config.out).expanduser()
    picture = figure(found, settings["shown"], folder / "compare.png")
    text = page(found, agree, about)
    print(text, whole(text, folder / "compare.md"), picture, sep="\n")


def _agreement(config: DictConfig, device: "Simulated", found: "Comparison") -> list[tuple[str, int]]:
    """Return on how many presses a run says the same of both sides, label by label."""
    from skin.build import build_data, build_learner
    from skin.device._blank import Blank
    from skin.reload import configuration, find, restore
    from skin.results.compare import touches
    from skin.tracking import Store

    store = Store.open(config.tracking)
    run = find(store, config.run)
    trained = configuration(store, run)
    learner = build_learner(trained)
    both = touches(found, device.sensors.positions, float(trained.device.rate), int(trained.touch.window))
    restore(store, run, learner, build_data(trained, Blank.of(device.task, device.size, both[0])))
    simulated, recorded = (learner.probabilities(side) > 0.5 for side in both)
    same = (simulated == recorded).sum(dim=0).tolist()
    return list(zip(device.task.names, same, strict=True))


if __name__ == "__main__":
    main()
