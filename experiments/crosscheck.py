"""Train on one mechanics, test on another: python experiments/crosscheck.py features gru --seeds 3

Trains what is missing, by default features, on naive touches, on both readings of the plates and beams, and
on the solid; everything else is the same (data=fem). Settings follow as overrides: layout.path=sensors.csv
"""

import argparse
import sys
from contextlib import suppress
from pathlib import Path

from omegaconf import DictConfig

from skin.commands import train
from skin.files import results
from studies.cli import configuration, refusing

SAME = ("data=fem", "evaluation.devices=0", "evaluation.layouts=0", "tracking.experiment=mechanics")


@refusing
def main() -> None:
    """Train, try every run on every simulator, print and write the matrices; 1 if a run failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", nargs="*", help="rows of the table, and overrides of `skin train`")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each: seeds 0, 1, ...")
    parser.add_argument("--out", type=Path, default=results(None), help="folder of crosscheck.md and .csv")
    arguments = parser.parse_intermixed_args()
    overrides = [*SAME, *(word for word in arguments.what if "=" in word)]
    rows = [word for word in arguments.what if "=" not in word] or ["features"]
    for row in rows:
        configuration(f"experiment={row}", *overrides)  # a mistake must not wait for heavy imports
    sys.exit(1 if run(rows, range(arguments.seeds), overrides, arguments.out) else 0)


def run(rows: list[str], seeds: range, overrides: list[str], folder: Path) -> int:
    """Train what is missing and try all of it; return how many runs failed."""
    from skin.tracking import Store
    from studies.crosscheck import MECHANICS, found, publish, tests, try_run

    def composed(row: str, name: str, seed: int = 0) -> DictConfig:
        return configuration(f"experiment={row}", *MECHANICS[name], *overrides, f"seed={seed}")

    planned = {
        (row, name, seed): composed(row, name, seed) for row in rows for name in MECHANICS for seed in seeds
    }
    store = Store.open(next(iter(planned.values())).tracking)
    for row, name in dict.fromkeys(key[:2] for key in planned):
        lacking = [str(seed) for seed in seeds if found(store, planned[row, name, seed]) is None]
        if lacking:
            words = [f"experiment={row}", *MECHANICS[name], *overrides, f"seed={','.join(lacking)}"]
            with suppress(SystemExit):
                train.main(["-m", *words])
    touches = tests({name: composed(rows[0], name) for name in MECHANICS})
    trials, missing = [], 0
    for (_, name, _), config in planned.items():
        finished = found(store, config)
        missing += finished is None
        trials += [] if finished is None else try_run(store, finished, config, name, touches)
    publish(folder, trials)
    return missing


if __name__ == "__main__":
    main()
