"""The cost of dead sensors, and whether a mask in training helps."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from mlflow.entities import Run
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from skin.build import build_data, build_device, build_learner
from skin.errors import InputError
from skin.evaluation.metrics import metrics
from skin.files import write
from skin.reload import changed, configuration, restore
from skin.tracking import Store
from studies.moving_runs import Trial
from studies.moving_table import comparison
from studies.settings import DeadSettings
from studies.table import markdown

__all__ = ["newest", "publish", "try_run"]

# The default device (0) is not among them.
_FIRST = 1
_MASK = ", mask"
_ABOUT = """
Accuracy: overall, per cent, mean and deviation over devices, which differ in the sensors that are dead, each
the mean over the trainings; in the lines "mask" and "no mask" over trainings, each the mean over devices.
Difference: from the row's first line, mean and standard error over the same seeds; "better" or "worse" only
beyond two standard errors over three seeds or more. A dead sensor reads 0 N; a mask tells the network so,
which helps only if it saw dead ones in training.
"""


def newest(store: Store, config: DictConfig, rows: str | Sequence[str]) -> dict[str, dict[str, Run]]:
    """Return finished runs on ``config.data.name`` data: row with how it was trained -> seed -> newest run.

    Raises:
        InputError: a row that is named has none.
    """
    found: dict[str, dict[str, Run]] = {}
    seen = set()
    for run in store.find("FINISHED", simulator=config.data.name):
        row = run.data.tags["row"] if "learned" in run.data.tags else None
        if row is None or (rows != "all" and row not in rows):
            continue
        seen.add(row)
        own = configuration(store, run, config.trust)
        if "dead" in own.device:
            found.setdefault(_line(row, own), {}).setdefault(str(own.seed), run)
    names = [] if rows == "all" else [rows] if isinstance(rows, str) else rows
    if missing := [row for row in names if row not in seen]:
        raise InputError(
            f"no finished run of {', '.join(missing)} on {config.data.name} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={config.data.name} makes one"
        )
    return dict(sorted(found.items()))


def _line(row: str, own: DictConfig) -> str:
    dead = own.device.dead if isinstance(own.device.dead, int) else " to ".join(map(str, own.device.dead))
    trained = f", trained with {dead} dead" if dead else ""
    return f"{row}{_MASK if own.representation.get('mask') else ''}{trained}"


def try_run(store: Store, line: str, run: Run, config: DictConfig, settings: DeadSettings) -> list[Trial]:
    """Return the accuracy of a run on devices with ever more dead sensors, by ``seed.device``.

    The training's own number of dead sensors, or a device per gesture, does not count.
    """
    own = changed(configuration(store, run, config.trust), config, [])
    device, learner = build_device(own).simulation, build_learner(own)
    if device is None:
        raise InputError(f"run {run.info.run_id} was not trained on a simulated skin: leave its row out")
    restore(store, run, learner, build_data(own, device))
    trials = []
    for count in settings.counts:
        accuracy = {}
        for number in range(settings.devices):
            touches = device.replace(
                seed=_FIRST + number, dead=count, randomise=False, test_gestures=settings.gestures
            ).touches("test")
            assert touches.labels is not None
            figures = metrics(learner.probabilities(touches), touches.labels, device.task)
            accuracy[f"{own.seed}.{number}"] = 100 * figures["overall/accuracy"]
        trials.append(Trial(line, f"{count} of {len(device.sensors)} dead", accuracy))
    return trials


def publish(folder: Path, trials: Sequence[Trial]) -> None:
    """Write ``dead.md`` and ``dead.csv`` whole, and print what they hold.

    Args:
        folder: where to.
        trials: of all runs, by ``seed.device``.
    """
    whole: dict[tuple[str, str], dict[str, float]] = {}
    for one in trials:
        whole.setdefault((one.row, one.condition), {}).update(one.accuracy)
    joined = [Trial(*names, accuracy) for names, accuracy in whole.items()]
    lines = comparison([_mean(one, 1) for one in joined]) + comparison(list(_masks(joined)))
    head = list(lines[0]) if lines else ["row"]
    table = [head, *(list(line.values()) for line in lines)]
    write(markdown(table, "Dead sensors") + _ABOUT, folder / "dead.md")
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(table)
    write(buffer.getvalue(), folder / "dead.csv")
    shown = Table(*head, box=None, pad_edge=False)
    for line in table[1:]:
        shown.add_row(*line)
    Console().print(shown)
    print(f"{folder / 'dead.md'} and {folder / 'dead.csv'}")


def _masks(trials: Sequence[Trial]) -> Iterator[Trial]:
    """Yield, for lines that were trained with a mask and without, both by seed of the training."""
    known = {(one.row, one.condition): one for one in trials}
    for one in trials:
        other = known.get((one.row.replace(_MASK, "", 1), one.condition))
        if _MASK in one.row and other is not None:
            row = f"{other.row}: {one.condition}"
            yield replace(_mean(other, 0), row=row, condition="no mask")
            yield replace(_mean(one, 0), row=row, condition="mask")


def _mean(trial: Trial, part: int) -> Trial:
    """Return a trial by training (0), averaged over devices, or by device (1), averaged over trainings."""
    groups: dict[str, list[float]] = {}
    for key, value in trial.accuracy.items():
        groups.setdefault(key.split(".")[part], []).append(value)
    return replace(trial, accuracy={seed: fmean(values) for seed, values in groups.items()})
