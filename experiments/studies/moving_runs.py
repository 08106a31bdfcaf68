"""Finished runs on misplaced sensors and uneven skins; trainings that track moving sensors."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import Any

from hydra import compose
from mlflow.entities import Run
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from skin.build import build_data, build_device, build_learner
from skin.config import checked, fingerprint
from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.evaluation.metrics import metrics
from skin.learner.base import AbstractLearner
from skin.reload import changed, configuration, restore
from skin.run import PARENT, train
from skin.tracking import Store
from studies.settings import MovingSettings

__all__ = ["LINES", "Trial", "children_of", "conditions", "latest", "train_lines", "try_run"]

LINES = {
    "layout": [],
    "oracle": ["device.track=oracle", "representation.positions=deformed"],
    "estimated": ["device.track=estimated", "representation.positions=deformed"],
}
"""Overrides of the trainings that are compared."""
# Neither the default device (0) nor the default skin's moduli (0) is among them.
_FIRST = 1


@dataclass(frozen=True)
class Trial:
    """The accuracy of one trained row under one condition, by seed of the device.

    Attributes:
        row: name of the experiment.
        condition: what differs.
        accuracy: seed -> overall accuracy, per cent.
    """

    row: str
    condition: str
    accuracy: Mapping[str, float]

    @property
    def cell(self) -> str:
        """Mean and deviation."""
        values = list(self.accuracy.values())
        return f"{fmean(values):.1f}" + (f" ± {stdev(values):.1f}" if len(values) > 1 else "")


def latest(store: Store, simulator: str, rows: str | Sequence[str]) -> list[Run]:
    """Return the newest finished training run of each row on a simulator's data.

    Args:
        store: where runs are.
        simulator: as their tag has it.
        rows: names; ``all`` takes every row that has one.

    Raises:
        InputError: a row that is named has none.
    """
    found: dict[str, Run] = {}
    for run in store.find("FINISHED", simulator=simulator):
        # Runs of this study train on other skins, those on streams know another task; a peer of another
        # environment cannot be brought back.
        other = run.data.tags["row"].startswith("moving_") or run.data.params.get("stream") == "True"
        if "learned" in run.data.tags and not other:
            found.setdefault(run.data.tags["row"], run)
    if rows == "all":
        return [found[row] for row in sorted(found)]
    names = [rows] if isinstance(rows, str) else list(rows)
    if missing := [row for row in names if row not in found]:
        raise InputError(
            f"no finished run of {', '.join(missing)} on {simulator} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={simulator} makes one"
        )
    return [found[row] for row in names]


def conditions(
    device: AbstractSimulated, errors: Sequence[float], variation: float, seed: int, gestures: int
) -> list[AbstractSimulated]:
    """Return devices of another seed: one per error of the sensors' places, and one with moduli that vary.

    Args:
        device: of the training.
        errors: standard deviations of the true places about the layout, m.
        variation: as ``body.variation``.
        seed: 0, 1, ...: of gains, offsets, noise, places and moduli alike.
        gestures: number of test gestures.
    """
    number = _FIRST + seed
    varied = replace(device.body, variation=variation, variation_seed=number)
    changes: list[dict[str, Any]] = [{"position_error": float(error)} for error in errors]
    return [
        device.replace(seed=number, test_gestures=gestures, **change)
        for change in [*changes, {"body": varied}]
    ]


def try_run(store: Store, run: Run, config: DictConfig, settings: MovingSettings) -> list[Trial]:
    """Return what a finished run makes of misplaced sensors and of moduli that vary.

    Its figures are logged beside it, and taken from there when the same is asked again.

    Args:
        store: where runs are.
        run: a finished training on simulated touches.
        config: where runs are logged; the rest is the run's own.
        settings: what to try.
    """
    asked = {name: getattr(settings, name) for name in ("errors", "variation", "gestures", "devices")}
    key = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:16]
    known = store.find("FINISHED", evaluated=run.info.run_id, moving=key)
    found = known[0].data.metrics if known else _try(store, run, config, settings)
    if not known:
        tags = {"evaluated": run.info.run_id, "moving": key}
        with store.run(f"misplaced sensors of {run.info.run_name}", tags, run.info.run_id) as logged:
            store.log_metrics(logged, found)
    names = [f"{1e3 * error:g} mm" for error in settings.errors]
    names.append(f"modulus ± {settings.variation:.0%}")
    seeds = range(settings.devices)
    return [
        Trial(run.data.tags["row"], name, {str(seed): found[_metric(number, seed)] for seed in seeds})
        for number, name in enumerate(names)
    ]


def _try(store: Store, run: Run, config: DictConfig, settings: MovingSettings) -> dict[str, float]:
    own = changed(configuration(store, run, config.trust), config, [])
    device, learner = build_device(own).simulation, build_learner(own)
    if device is None:
        raise InputError(f"run {run.info.run_id} was not trained on a simulated skin: leave its row out")
    restore(store, run, learner, build_data(own, device))
    found: dict[str, float] = {}
    for seed in range(settings.devices):
        others = conditions(device, settings.errors, settings.variation, seed, settings.gestures)
        found |= {_metric(number, seed): _accuracy(learner, other) for number, other in enumerate(others)}
    return found


def _metric(condition: int, seed: int) -> str:
    return f"moving/condition_{condition}/device_{seed}"


def _accuracy(learner: AbstractLearner, device: AbstractSimulated) -> float:
    """Return the overall accuracy on a device's test touches, per cent."""
    touches = device.touches("test")
    assert touches.labels is not None
    return 100 * metrics(learner.probabilities(touches), touches.labels, device.task)["overall/accuracy"]


def train_lines(overrides: Sequence[str], seeds: Sequence[int]) -> list[Trial]:
    """Train sequence_graph on the layout, on true and on estimated positions where sensors may move.

    What a finished run did before is not repeated. All are children of one run.

    Args:
        overrides: of the command line; those that a training does not know are left aside.
        seeds: of the trainings.
    """
    own = [one for one in overrides if not one.lstrip("+~").startswith(("moving.", "n=", "out="))]
    common = ["experiment=sequence_graph", "simulator.constraint=free", *own]
    configs = {
        (name, str(seed)): checked(compose("train", [*common, *line, f"row=moving_{name}", f"seed={seed}"]))
        for seed in seeds
        for name, line in LINES.items()
    }
    store = Store.open(next(iter(configs.values())).tracking)
    todo = [one for one in configs.values() if not store.find("FINISHED", fingerprint=fingerprint(one))]
    if todo:
        with store.run("moving", {"sweep": "moving"}) as parent, children_of(parent):
            for config in track(todo, "training", console=Console(stderr=True)):
                train(config)
    found: dict[str, dict[str, float]] = {}
    for (line, seed), config in configs.items():
        run = store.find("FINISHED", fingerprint=fingerprint(config))[0]
        found.setdefault(line, {})[seed] = 100 * run.data.metrics["same/overall/accuracy"]
    return [Trial("moving_*", line, accuracy) for line, accuracy in found.items()]


@contextmanager
def children_of(parent: Run) -> Iterator[None]:
    """Make trainings in this process children of a run, as those of a sweep are."""
    before = os.environ.get(PARENT)
    os.environ[PARENT] = parent.info.run_id
    try:
        yield
    finally:
        if before is None:
            del os.environ[PARENT]
        else:
            os.environ[PARENT] = before
