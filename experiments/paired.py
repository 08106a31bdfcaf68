"""Compare two rows over paired seeds: python experiments/paired.py sequence_image:fem temporal_image:fem

Each is ``row:simulator`` or ``row:simulator:column``, with a column of
the evaluation: same, holdout, device_shift or unseen_layout.
"""

import argparse
import sys
from statistics import fmean, stdev

from benchmarks.setting import configuration

from skin.tracking import Store


def main() -> None:
    """Print both means, their difference and its standard error; exit code 2 without paired seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("one")
    parser.add_argument("other")
    arguments = parser.parse_args()
    store = Store.open(configuration().tracking)
    one, other = _overall(store, arguments.one), _overall(store, arguments.other)
    seeds = sorted(one.keys() & other.keys())
    if len(seeds) < 2:
        print(f"{len(seeds)} paired seeds: make reproduce-table SEEDS=3 gives three", file=sys.stderr)
        sys.exit(2)
    differences = [100 * (one[seed] - other[seed]) for seed in seeds]
    mean, error = fmean(differences), stdev(differences) / len(seeds) ** 0.5
    verdict = "differ" if abs(mean) > 2 * error else "undecided"
    means = [100 * fmean(values[seed] for seed in seeds) for values in (one, other)]
    print(
        f"{means[0]:.1f} {means[1]:.1f} {mean:+.1f} ± {error:.2f} points over {len(seeds)} seeds: {verdict}"
    )


def _overall(store: Store, name: str) -> dict[str, float]:
    """Return the overall accuracy by seed of the newest finished runs."""
    row, simulator, column = (name.split(":") + ["fem", "same"][name.count(":") :])[:3]
    runs = reversed(store.find("FINISHED", row=row, simulator=simulator))
    metric = f"{column}/overall/accuracy"
    return {run.data.tags["seed"]: run.data.metrics[metric] for run in runs if metric in run.data.metrics}


if __name__ == "__main__":
    main()
