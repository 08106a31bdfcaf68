"""The release check: train a few models again, and compare them with the recorded results."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from tempfile import TemporaryDirectory

from hydra import compose

from experiments.studies.comparison import t_quantile
from experiments.studies.recorded_runs import Record, read_records
from experiments.studies.runs import newest_finished, run_command
from experiments.studies.tables import print_table
from skin.commands import train
from skin.config import fingerprint, validate_config
from skin.errors import InputError
from skin.source import source_tags
from skin.tracking import Store

_SEEDS = range(10)  # that a row may have been trained with
_COMPARED = (
    "same/overall/accuracy",
    "holdout/overall/accuracy",
    "device_shift/overall/accuracy",
    "unseen_layout/overall/accuracy",
)
_HEAD = ["row", "metric", "recorded", "trained again", "allowed", "verdict"]


@dataclass(frozen=True)
class Comparison:
    """A metric of a training beside the recorded one.

    Attributes:
        metric: name.
        recorded: value of the same seed, or mean over seeds.
        again: value of the new training; NaN where it has none.
        allowed: largest difference.
    """

    metric: str
    recorded: float
    again: float
    allowed: float

    @property
    def holds(self) -> bool:
        """Whether the values are equal, or differ by no more than is allowed."""
        return abs(self.again - self.recorded) <= self.allowed


def release_check(path: Path, rows: Sequence[str], simulator: str, seed: int, words: Sequence[str]) -> int:
    """Train rows again in an empty database and print how they compare; return 1 if a value differs.

    Args:
        path: of the recorded results.
        rows: names of experiments.
        simulator: that they are trained on.
        seed: of the new trainings.
        words: further overrides of the recorded and the new trainings.

    Raises:
        InputError: the file lacks a row, or has it with fewer than two seeds.
    """
    records = read_records(path)
    lines = {row: [f"experiment={row}", f"simulator={simulator}", *words] for row in rows}
    committed = {row: recorded_seeds(records, line, path) for row, line in lines.items()}
    for row, found in committed.items():
        if len(found) < 2 or seed not in found:
            raise InputError(
                f"{path} has {row} on {simulator} data with seeds {sorted(found)}: the check needs two, and "
                "results.check.seed among them"
            )
    table, failed = [_HEAD], False
    for row, found in committed.items():
        again = _train([*lines[row], f"seed={seed}"], found[seed])
        compared = compare(found, seed, again, source_tags()["processor"])
        failed |= not again or not all(one.holds for one in compared)
        # Of values that must be equal to the digit, the main ones and those that are not.
        shown = [one for one in compared if one.metric in _COMPARED or not one.holds]
        table += [_line(row, one) for one in shown]
    print_table(table, f"Trained again on {simulator} data with seed {seed}")
    return int(failed)


def recorded_seeds(records: Sequence[Record], line: Sequence[str], path: Path) -> dict[int, Record]:
    """Return the recorded trainings of a configuration by seed."""
    known = {one["tags"].get("fingerprint"): one for one in records}
    configs = {seed: validate_config(compose("train", [*line, f"seed={seed}"])) for seed in _SEEDS}
    prints = {seed: fingerprint(config) for seed, config in configs.items()}
    return {seed: known[value] for seed, value in prints.items() if value in known}


def compare(
    committed: dict[int, Record], seed: int, again: dict[str, float], processor: str
) -> list[Comparison]:
    """Compare a training with recorded ones of the same configuration.

    On the processor of the recorded training with the same seed, every metric but times must be equal to the
    digit. On another one rounding makes it another draw: its accuracies may differ from the mean of the
    recorded seeds by ``t sd sqrt(1 + 1/n)`` with n seeds, the margin of another draw; t is the quantile of
    Student's distribution with n - 1 degrees of freedom.

    Args:
        committed: seed -> record.
        seed: of the training.
        again: its metrics.
        processor: that it ran on.
    """
    own = committed[seed]
    if own["tags"].get("processor") == processor:
        names = [name for name in own["metrics"] if not name.startswith("seconds")]
        return [Comparison(name, own["metrics"][name], again.get(name, math.nan), 0.0) for name in names]
    found = []
    for name in _COMPARED:
        values = [one["metrics"][name] for one in committed.values() if name in one["metrics"]]
        if len(values) > 1:
            allowed = t_quantile(len(values)) * stdev(values) * math.sqrt(1 + 1 / len(values))
            found.append(Comparison(name, fmean(values), again.get(name, math.nan), allowed))
    return found


def _train(line: Sequence[str], record: Record) -> dict[str, float]:
    """Train in an empty database and return the metrics; none if the training failed."""
    with TemporaryDirectory() as folder:
        own = [f"tracking.uri=sqlite:///{folder}/runs.db", f"tracking.artifacts={folder}/artifacts"]
        # The number of threads changes the order of sums.
        own += [f"tracking.threads={record['tags'].get('threads', 'null')}"]
        config = validate_config(compose("train", [*line, *own]))
        if run_command(train.main, [*line, *own]):
            return {}
        run = newest_finished(Store.open(config.tracking), config)
        return dict(run.data.metrics) if run else {}


def _line(row: str, one: Comparison) -> list[str]:
    allowed = f"{one.allowed:.4f}" if one.allowed else "equal"
    values = [f"{one.recorded:.6g}", f"{one.again:.6g}", allowed]
    return [row, one.metric, *values, "as recorded" if one.holds else "DIFFERS"]
