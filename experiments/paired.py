"""Compare two rows over paired seeds: python experiments/paired.py sequence_image:fem temporal_image:fem

Each is ``row:simulator`` or ``row:simulator:column``, with a column of the evaluation: same, holdout,
device_shift or unseen_layout. Runs of the row's present settings count, with the overrides that follow.
"""

import argparse
import sys
from collections.abc import Sequence
from statistics import fmean

from hydra import compose, initialize_config_dir

from skin.config import CONF, checked, fingerprint
from studies.cli import refusing
from studies.study import FEWEST, paired


@refusing
def main() -> None:
    """Print both means, their difference and its standard error; exit code 2 without paired seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("one")
    parser.add_argument("other")
    parser.add_argument("overrides", nargs="*", help="settings of both, as of skin train")
    arguments = parser.parse_intermixed_args()
    one, other = (_overall(name, arguments.overrides) for name in (arguments.one, arguments.other))
    found = paired(one, other)
    if found is None or found.seeds < 2:
        seeds = found.seeds if found else 0
        print(f"{seeds} paired seeds: make reproduce-table SEEDS=3 gives three", file=sys.stderr)
        sys.exit(2)
    differ = found.seeds >= FEWEST and abs(found.mean) > 2 * found.error
    means = [fmean(values[seed] for seed in one.keys() & other.keys()) for values in (one, other)]
    figures = f"{means[0]:.1f} {means[1]:.1f} {found.mean:+.1f} ± {found.error:.2f} points"
    print(f"{figures} over {found.seeds} seeds: {'differ' if differ else 'undecided'}")


def _overall(name: str, overrides: Sequence[str]) -> dict[str, float]:
    """Return the overall accuracy in per cent, by seed, of finished runs with the row's present settings."""
    row, simulator, column = (name.split(":") + ["fem", "same"][name.count(":") :])[:3]
    settings, metric = (
        [f"experiment={row}", f"simulator={simulator}", *overrides],
        f"{column}/overall/accuracy",
    )
    found: dict[str, float] = {}
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = checked(compose("train", settings))

        from skin.tracking import Store  # after the door: it is heavy

        for run in Store.open(config.tracking).find("FINISHED", row=config.row):
            seed = run.data.tags["seed"]
            same = fingerprint(checked(compose("train", [*settings, f"seed={seed}"])))
            if run.data.tags.get("fingerprint") == same and metric in run.data.metrics:
                # Newest first: that one counts.
                found.setdefault(seed, 100 * run.data.metrics[metric])
    return found


if __name__ == "__main__":
    main()
