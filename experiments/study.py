"""Check what the report says about variants: python experiments/study.py graph_pooling activation

Trains the runs that are missing, over paired seeds, and prints what they found beside what the report says.
Settings of one's own follow as overrides: layout.path=sensors.csv simulator=naive
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from skin.commands import train
from skin.files import results
from studies.cli import refusing
from studies.study import SMOKE, Study, Variant, choose, read


@refusing
def main() -> None:
    """Run studies one after another; exit code 1 if a run failed, 2 for bad input."""
    arguments, studies = _arguments(), read()
    if arguments.list:
        print("\n\n".join(map(str, studies.values())))
        return
    overrides = [f"seed={','.join(map(str, range(arguments.seeds)))}", *(SMOKE if arguments.smoke else ())]
    if arguments.config_dir:
        overrides.append(f"hydra.searchpath=[{arguments.config_dir.expanduser().resolve()}]")
    overrides += [word for word in arguments.what if "=" in word]
    chosen = choose(studies, [word for word in arguments.what if "=" not in word])
    planned = [(study, study.variants(overrides)) for study in chosen]
    folder = arguments.out or results(None) / ("smoke" if arguments.smoke else "")
    missing = [run(study, variants, overrides, folder) for study, variants in planned]
    sys.exit(1 if any(missing) else 0)


def run(study: Study, variants: Sequence[Variant], overrides: list[str], folder: Path) -> int:
    """Train what a study lacks, then write and print what it found; return how many runs are missing."""
    from skin.tracking import Store
    from studies.findings import collect, conclusions
    from studies.study_table import publish

    store = Store.open(next(iter(variants[0].configs.values())).tracking)
    if any(finding.missing for finding in collect(store, variants)):
        for sweep in study.sweeps:
            # In this process, as it is the longest way into torch and mlflow; what fails is missing below.
            try:
                train.main(["-m", f"sweep={sweep}", *overrides])
            except SystemExit as stop:
                if isinstance(stop.code, int) and stop.code > 128:  # a signal: train nothing more
                    raise
    findings = collect(store, variants, study.self_share)
    outcomes = conclusions(study.statements, findings)
    settings = [word for word in overrides[1:] if not word.startswith("tracking.")]
    smoke = set(SMOKE) <= set(overrides)
    title = "SMOKE, little data and one epoch, these numbers mean nothing: " * smoke
    title += ", ".join([f"{study.name}: {study.about}", *settings])
    publish(folder / f"study_{study.name}", title, findings, outcomes)
    return sum(finding.missing for finding in findings)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", nargs="*", help="studies, or all (but the costly); overrides of the training")
    parser.add_argument("--list", action="store_true", help="list the studies and what they check")
    parser.add_argument("--seeds", type=int, default=3, help="runs per variant: seeds 0, 1, ...")
    parser.add_argument("--smoke", action="store_true", help="little data, one epoch: ignore the scores")
    parser.add_argument("--out", type=Path, help="folder of the results; default: results/")
    parser.add_argument("--config-dir", type=Path, help="folder of your own configuration, as of skin train")
    arguments = parser.parse_intermixed_args()
    if arguments.seeds < 1:
        parser.error(f"{arguments.seeds} is no number of seeds: give --seeds 1 or more")
    return arguments


if __name__ == "__main__":
    main()
