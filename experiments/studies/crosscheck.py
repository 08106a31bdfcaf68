"""How much the mechanics matter: train on one simulator, test on another."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev

from mlflow.entities import Run
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from skin.build import build_data, build_device, build_learner
from skin.config import fingerprint
from skin.evaluation.metrics import metrics
from skin.files import write
from skin.recording import Touches
from skin.reload import restore
from skin.tracking import Store
from studies.table import markdown

__all__ = ["MECHANICS", "Trial", "found", "publish", "tests", "try_run"]

MECHANICS: Mapping[str, tuple[str, ...]] = {
    "naive": ("simulator=naive",),
    "fem, equation 10": ("simulator=fem", "simulator.reading=equation10"),
    "fem, interface": ("simulator=fem", "simulator.reading=interface"),
    "solid": ("simulator=solid",),
}
"""What is compared -> overrides that choose it."""

_ABOUT = """
Accuracy over the labels on the same test gestures, per cent, mean and deviation over trainings. Lines:
what the touches were simulated with in training; columns: in the test. All else is the same for all.
"""


@dataclass(frozen=True)
class Trial:
    """The figures of one run on the test gestures of one simulator.

    Attributes:
        row: of the table.
        trained: name of the mechanics in training, a key of :data:`MECHANICS`.
        tested: name of the mechanics in the test.
        seed: of the training.
        accuracy: label, or ``overall``, -> share of 1.
    """

    row: str
    trained: str
    tested: str
    seed: str
    accuracy: Mapping[str, float]


def found(store: Store, config: DictConfig) -> Run | None:
    """Return the newest finished run of a configuration."""
    return next(iter(store.find("FINISHED", fingerprint=fingerprint(config))), None)


def tests(configs: Mapping[str, DictConfig]) -> dict[str, Touches]:
    """Return the test gestures as each simulator feels them: the same gestures, device and noise."""
    return {name: build_device(config).touches("test") for name, config in configs.items()}


def try_run(
    store: Store, run: Run, config: DictConfig, trained: str, touches: Mapping[str, Touches]
) -> list[Trial]:
    """Return what a run makes of the gestures of every simulator.

    Args:
        store: where the run is.
        run: what learned.
        config: of the run.
        trained: name of its mechanics.
        touches: as :func:`tests` gives them.
    """
    device, learner = build_device(config), build_learner(config)
    restore(store, run, learner, build_data(config, device))
    trials = []
    for name, felt in touches.items():
        assert felt.labels is not None
        figures = metrics(learner.probabilities(felt), felt.labels, device.task)
        labels = {label: figures[f"{label}/accuracy"] for label in ("overall", *device.task.names)}
        trials.append(Trial(config.row, trained, name, str(config.seed), labels))
    return trials


def publish(folder: Path, trials: Sequence[Trial]) -> None:
    """Write ``crosscheck.md`` and ``crosscheck.csv`` whole, and print a matrix per row of the table."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    labels = list(trials[0].accuracy) if trials else []
    writer.writerow(["row", "trained", "tested", "seed", *labels])
    for one in trials:
        values = (f"{value:.4f}" for value in one.accuracy.values())
        writer.writerow([one.row, one.trained, one.tested, one.seed, *values])
    write(buffer.getvalue(), folder / "crosscheck.csv")
    pages = []
    for row in dict.fromkeys(one.row for one in trials):
        head, *lines = _matrix([one for one in trials if one.row == row])
        pages.append(markdown([head, *lines], row))
        shown = Table(*head, title=row, box=None, pad_edge=False)
        for line in lines:
            shown.add_row(*line)
        Console().print(shown)
    write("\n".join(pages) + _ABOUT, folder / "crosscheck.md")
    print(f"{folder / 'crosscheck.md'} and {folder / 'crosscheck.csv'}")


def _matrix(trials: Sequence[Trial]) -> list[list[str]]:
    """Return a table of one row's trials, the head first."""
    names = list(dict.fromkeys(one.tested for one in trials))
    lines = [["trained \\ tested", *names]]
    for trained in dict.fromkeys(one.trained for one in trials):
        cells = ([one for one in trials if (one.trained, one.tested) == (trained, name)] for name in names)
        lines.append([trained, *(_cell([100 * one.accuracy["overall"] for one in cell]) for cell in cells)])
    return lines


def _cell(values: Sequence[float]) -> str:
    deviation = f" ± {stdev(values):.1f}" if len(values) > 1 else ""
    return f"{fmean(values):.1f}{deviation}" if values else ""
