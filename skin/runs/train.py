"""One run: build, train, evaluate, log; and evaluate it again on other touches."""

import json
import logging
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from mlflow.entities import Param, Run
from mlflow.exceptions import MlflowException
from omegaconf import OmegaConf
from pytorch_lightning.loggers import MLFlowLogger
from pytorch_lightning.utilities import rank_zero_only
from rich.console import Console
from torch import Tensor

from skin.core.files import results, unwritable
from skin.core.messages import PARENT, quiet
from skin.core.progress import Steps
from skin.core.settings import import_target, option_name
from skin.device.balance import report_balance
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold, threshold_device
from skin.evaluation.metrics import OUTCOMES, compute_metrics
from skin.evaluation.report import Report, evaluate, metrics_table, publish_evaluation, write_chances
from skin.evaluation.report import print_report as show
from skin.evaluation.settings import check_evaluation
from skin.learning.learner import AbstractLearner
from skin.learning.network import LAST
from skin.plot.figures import confusions, save_figure
from skin.runs.build import build_data, build_device, build_learner
from skin.runs.configuration import (
    MACHINE,
    Config,
    Tracking,
    fingerprint,
    iterate_leaves,
    overrides,
    reveal_password,
    settings_of,
    source_tags,
)
from skin.runs.run import TAG, FinishedRun
from skin.runs.store import Store, note_reuse, shorten
from skin.runs.sweep import Reused
from skin.runs.torch_model import device_on_skin, load_model
from skin.touch.labels import Task

_log = logging.getLogger(__name__)

_STEERING = ("hydra", "shard", "tracking", "trust", "sweep")  # no result depends on them
_NETWORK = ("representation", "model", "fusion", "optimizer", "trainer")  # a network consists of these
_VALIDATION = "best_val_"  # begins the names of metrics of what was learned on the validation split
# A run's name has the first ones in any case; the others choose the machine.
_NAMED = ("experiment", "row", "seed", "simulator", *(f"trainer.{name}" for name in MACHINE))


def train(config: Config) -> float:
    """Train and evaluate a configuration; return the objective on the validation split.

    A run that finished with the same fingerprint is not repeated, and one that was killed is continued,
    unless ``tracking.resume=false``. The objective of the former is a :class:`skin.runs.sweep.Reused`.

    Raises:
        InputError: a setting cannot be used, or ``tracking.objective`` is not among the metrics.
    """
    quiet()
    if (threads := config.tracking.threads) is not None:
        if threads < 1:
            raise InputError(f"tracking.threads={threads} must be at least 1, or null")
        torch.set_num_threads(threads)
    if getattr(rank_zero_only, "rank", 0):
        _join(config)
        return math.nan
    store, identity = Store.existing(config.tracking), tags(config)
    identity["threads"] = str(torch.get_num_threads())
    if finished := _find_finished(store, config, identity):
        return Reused(_objective(config.tracking, finished.data.metrics))
    settings = check_evaluation(config.evaluation)
    device = build_device(config)
    data, learner = build_data(config, device), build_learner(config)
    source = AlarmSource(
        "this run", settings, learner, config.device, config.device, build=device_on_skin(config, config)
    )
    source = replace(source, device=device if settings.profile is None else threshold_device(source))
    learner.check(data)
    # refuses the name of no metric
    _objective(config.tracking, _score(data.task, data.example.known_labels, data.example.known_labels))
    report_balance(device, shown=PARENT not in os.environ)
    name = _name(config, identity)
    store = Store.open(config.tracking)
    with alone(config.tracking, identity["fingerprint"]):
        if finished := _find_finished(store, config, identity):  # by a process that began earlier
            return Reused(_objective(config.tracking, finished.data.metrics))
        again = find_unfinished(store, config.tracking, identity["fingerprint"])
        with store.run(name, identity, os.environ.get(PARENT), again) as run:
            learner.unfinished = _unfinished(config.tracking) / run.info.run_id
            learner.unfinished.mkdir(exist_ok=True)
            log_configuration(store, run.info.run_id, config, data.hash)
            learner.fit(data, RunLogger(store, run.info.run_id, learner.unfinished))
            point = choose_alarm_threshold(source, anew=True)
            report = evaluate(learner, device, settings, point)
            parts = [(learner.probabilities(p), p.known_labels) for p in data.parts("validation") if len(p)]
            scores = _score(data.task, *map(torch.cat, zip(*parts, strict=True))) if parts else {}
            values = {"seconds_per_epoch": learner.seconds_per_epoch, "parameters": learner.parameters}
            log_learner(store, run, learner)
            log_report(store, run, report, device.task, values | scores)
        shutil.rmtree(learner.unfinished, ignore_errors=True)
    if PARENT not in os.environ:
        show(report, f"{name}, run {run.info.run_id}")
    return _objective(config.tracking, scores)


def _score(task: Task, probabilities: Tensor, labels: Tensor) -> dict[str, float]:
    """Return the metrics on the validation split, ``best_val_<metric>`` over all labels and of each."""
    return {
        f"{_VALIDATION}{'_'.join(reversed(name.split('/')))}".removesuffix("_overall"): value
        for name, value in compute_metrics(probabilities, labels, task).items()
    }


def _objective(settings: Tracking, metrics: Mapping[str, float]) -> float:
    """Return ``tracking.objective``: by default the accuracy; of a regression the share of the variance.

    Raises:
        InputError: a metric is named that is missing.
    """
    scores = {name: value for name, value in metrics.items() if name.startswith(_VALIDATION)}
    if settings.objective and settings.objective not in scores:
        raise InputError(
            f"tracking.objective={settings.objective} is no metric of the validation data: give one of "
            f"{', '.join(scores) or 'those that another run logs'}"
        )
    # Runs of earlier versions have none.
    return scores.get(
        settings.objective or f"{_VALIDATION}accuracy", scores.get(f"{_VALIDATION}r2", math.nan)
    )


class RunLogger(MLFlowLogger):
    """Logs a training to its run and leaves the run open.

    Lightning's own calls a run FINISHED when the fit ends; one that is killed during its evaluation would
    then count as finished without having any result.

    Args:
        store: of the run.
        run: its id.
        folder: for metrics that a server did not take, which the next logger of the run sends.
    """

    def __init__(self, store: Store, run: str, folder: Path) -> None:
        super().__init__(tracking_uri=reveal_password(store.uri), run_id=run)
        self._left = folder / "metrics.json"
        if self._left.is_file():
            super().log_metrics(**json.loads(self._left.read_text()))
            self._left.unlink()

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log the metrics of an epoch; those of one that is in a checkpoint are not measured again."""
        try:
            super().log_metrics(metrics, step)
        except MlflowException:
            self._left.write_text(json.dumps({"metrics": dict(metrics), "step": step}))
            raise

    def finalize(self, status: str = "success") -> None:
        """Do nothing: the run ends with its evaluation."""


@contextmanager
def alone(settings: Tracking, identity: str) -> Iterator[None]:
    """Keep other processes from the same training; the system frees the lock of a process that was killed.

    Args:
        settings: whose folder of artifacts all these processes share.
        identity: fingerprint of the run.

    Raises:
        InputError: another process trains it, or the folder cannot be written.
    """
    folder = _unfinished(settings)
    lock = FileLock(folder / f"{identity}.lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(
            f"a training with the same configuration ({identity}) is in progress in another process: "
            "wait for it"
        ) from None
    except OSError as error:
        raise unwritable(folder, error, "tracking.artifacts=FOLDER") from error
    try:
        yield
    finally:
        lock.release()


def find_unfinished(store: Store, settings: Tracking, identity: str) -> Run | None:
    """Return the last killed run that the same code on the same processor can continue; call it alone.

    Args:
        store: where.
        settings: with ``resume=False``, no run is continued.
        identity: fingerprint of the run.
    """
    for run in store.find("RUNNING", fingerprint=identity):
        if (_unfinished(settings) / run.info.run_id).is_dir():  # else of a process with another folder
            store.client.set_terminated(run.info.run_id, "KILLED")
    source = source_tags()
    for run in store.find("KILLED", fingerprint=identity) if settings.resume else ():
        same = all(run.data.tags.get(key) == value for key, value in source.items())
        if same and (_unfinished(settings) / run.info.run_id / LAST).is_file():
            _log.info(
                "run %s was interrupted and continues: tracking.resume=false repeats it", run.info.run_id
            )
            return run
    return None


def _unfinished(settings: Tracking) -> Path:
    """Return the folder of the checkpoints and locks of all trainings."""
    return Path(settings.artifacts or "mlartifacts").expanduser() / "unfinished"


def _find_finished(store: Store, config: Config, identity: dict[str, str]) -> Run | None:
    """Return the run that did a training before and may replace it; print its metrics."""
    finished = store.find("FINISHED", fingerprint=identity["fingerprint"]) if config.tracking.resume else []
    for run in finished[:1]:
        note_reuse(run)
        if PARENT not in os.environ:  # a sweep prints the metrics of all its runs
            _log.info("run %s did this before: tracking.resume=false repeats it", run.info.run_id)
            Console().print(metrics_table(run.data.metrics, run.info.run_name))
    return finished[0] if finished else None


def log_learner(store: Store, run: Run, learner: AbstractLearner) -> None:
    """Log what a learner has learned, for :meth:`skin.runs.run.FinishedRun.load_weights`."""
    with tempfile.TemporaryDirectory() as folder:
        path = learner.save(Path(folder))
        store.client.log_artifact(run.info.run_id, str(path))
        store.client.set_tag(run.info.run_id, "learned", path.name)


def _join(config: Config) -> None:
    """Train in one of several processes (``trainer.devices``); the first one does all the rest."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        data, learner = build_data(config, build_device(config)), build_learner(config)
        learner.fit(data)


def tags(config: Config) -> dict[str, str]:
    """Return the tags that identify a run."""
    return {
        "fingerprint": fingerprint(config),
        "row": str(config.row),
        "simulator": simulator(config),
        "seed": str(config.seed),
    }


def simulator(config: Config) -> str:
    """Return the name of the simulator that touches come from; without one, of the device."""
    name = "simulator" if "simulator" in config.device else "device"
    return _option(config.device["simulator"] if name == "simulator" else config.device, name)


def _option(part: dict[str, Any], name: str) -> str:
    """Return the name of the option that a part of a configuration builds."""
    if "_target_" not in part:
        raise InputError(f"{name} chooses no option: leave it out, or give one that --help lists")
    return option_name(import_target(part["_target_"], name))


def log_configuration(store: Store, run: str, config: Config, data_hash: str) -> None:
    """Log the configuration of a run before it starts.

    Args:
        store: where.
        run: its id.
        config: its configuration; unused groups may be left out.
        data_hash: of the touches of its training.
    """
    chosen = settings_of(config)
    store.client.log_text(run, OmegaConf.to_yaml(OmegaConf.create(chosen)), "config.yaml")
    store.client.set_tag(run, "data_hash", data_hash)
    groups = ("simulator", "device", "representation", "model", "fusion", "learner")
    unused = _unused(config)
    used = [group for group in groups if group in chosen and group not in unused]
    choices = {group: _option(chosen[group], group) for group in used}
    parts = {part: chosen.get(part, {}) for part in ("data", *_NETWORK, "learner") if part not in unused}
    if "simulator" not in config.device:
        choices.pop("simulator", None)
        parts["data"] = {"batch_size": chosen["data"]["batch_size"], "augment": chosen["data"]["augment"]}
    settings = {
        ".".join(path): value
        for path, value in iterate_leaves(parts)
        if not path[-1].startswith("_") and not {"body", *_NETWORK, *MACHINE}.intersection(path[1:])
    }
    params = settings | relevant_overrides(config) | choices | {"seed": config.seed, "row": config.row}
    store.client.log_batch(run, params=[Param(name, str(value)) for name, value in params.items()])


def _name(config: Config, identity: Mapping[str, str]) -> str:
    """Return the name of a run, which tells it from those of other changes."""
    changes = [
        f"{key.split('.')[-1]}={value}"
        for key, value in relevant_overrides(config).items()
        if key not in _NAMED
    ]
    name = " ".join(filter(None, (identity["row"], identity["simulator"], *changes)))
    return shorten(name, f" seed {config.seed}")


def relevant_overrides(config: Config) -> dict[str, str]:
    """Return the overrides of the running command that affect its result; empty without a command."""
    if not HydraConfig.initialized():
        return {}
    unused = _unused(config)
    return {
        override.key_or_group: override.get_value_element_as_str()
        for override in OverridesParser.create().parse_overrides(overrides())
        if not override.is_delete()
        and not override.key_or_group.startswith(_STEERING)
        and override.key_or_group.split(".")[0] not in unused
    }


def _unused(config: Config) -> tuple[str, ...]:
    """Return the groups that have no part in a run, because its learner holds no network."""
    return () if _holds(config.learner, "model") else _NETWORK


def _holds(value: Any, name: str) -> bool:
    """Return whether a setting has this name, however deep."""
    return isinstance(value, dict) and (name in value or any(_holds(entry, name) for entry in value.values()))


def log_report(store: Store, run: Run, report: Report, task: Task, values: dict[str, float]) -> None:
    """Log an evaluation, with its predictions and confusion matrices, and further values.

    The operating point is stored as the tag ``TAG``; :attr:`skin.runs.run.FinishedRun.point` reads
    it.
    """
    point = report.point
    if point is not None:
        values = values | {"alarm/threshold": point.threshold, "alarm/safe_gestures": point.safe}
        if point.warning():
            _log.warning("warning: %s", point.warning())
    store.client.set_tag(run.info.run_id, TAG, "null" if point is None else point.text())
    store.client.set_tag(run.info.run_id, "split", report.split)
    store.log_metrics(run, report.metrics | values)
    with tempfile.TemporaryDirectory() as folder:
        _write(report, task, Path(folder))
        store.client.log_artifacts(run.info.run_id, folder)
    for column, reason in report.cannot.items():
        store.client.set_tag(run.info.run_id, f"cannot_{column}", reason)


def _write(report: Report, task: Task, folder: Path) -> None:
    """Write predictions, and confusion matrices as a picture."""
    pq.write_table(report.predictions, folder / "predictions.parquet")
    if report.outcomes is not None:
        np.save(folder / OUTCOMES, report.outcomes)
    if report.confusion is not None:
        named = dict(zip(task.binary, report.confusion.numpy(), strict=True))
        save_figure(confusions(named, ("no", "yes")), folder / "confusion.png")


# Evaluate a finished run again.


# Expected seconds of each step, for the share in the progress.
_STEPS = {
    "loading the run and the threshold of its alarm": 20.0,
    "reading or simulating the touches": 10.0,
    "evaluating them": 30.0,
}


def evaluate_run(config: Config, run: str, out: str | None, changes: Sequence[str]) -> None:
    """Evaluate a finished run on the touches that a command describes; print and log the metrics.

    Args:
        config: of ``skin evaluate``.
        run: name of the run.
        out: folder of the page; None: ``results/``.
        changes: the overrides of the command line.

    Raises:
        InputError: the run cannot be loaded, or does not fit the touches.
    """
    quiet()
    with Steps(_STEPS) as steps:
        _evaluate(FinishedRun.named(run, config), results(out), changes, steps)


def _evaluate(run: FinishedRun, folder: Path, changes: Sequence[str], steps: Steps) -> None:
    config = run.configured(changes)
    settings = check_evaluation(config.evaluation)
    model = load_model(run, config)
    device, learner, point = model.device, model.learner, model.point
    steps.begin("reading or simulating the touches")
    if device.real:
        steps.stop()  # a person may be prompted
    touches = device.touches("test")  # read before anything is logged, because a port may fail
    steps.start()
    steps.begin("evaluating them")
    title = f"{run.title} ({run.identity})"
    tags = {"evaluated": run.identity, "overrides": " ".join(changes)}
    store = Store.open(config.tracking)
    with store.run(f"evaluation of {run.title}", tags, run.identity) as evaluation:
        # Evaluations do not overwrite each other's files.
        name = f"evaluation_{option_name(device)}_{evaluation.info.run_id[:8]}"
        if touches.labels is None:
            path = folder / f"{name}.csv"
            text = write_chances(learner.probabilities(touches), device.task, point, path)
            store.client.log_artifact(evaluation.info.run_id, str(path))
            print(f"{title}\n{text}\n{path}")
            return
        report = evaluate(learner, device, settings, point)
        log_report(store, evaluation, report, device.task, {})
        about = describe_evaluation(title, changes, len(report.predictions))
        written = publish_evaluation(folder / f"{name}.md", report, device.task, run.title, about)
        for path in written:
            store.client.log_artifact(evaluation.info.run_id, str(path))
    show(report, title)
    print(*written, sep="\n")


def describe_evaluation(title: str, changes: Sequence[str], count: int) -> str:
    """Return a sentence about an evaluation of ``count`` gestures.

    Args:
        title: of the run.
        changes: the overrides; none keep the settings of the run.
        count: number of gestures.
    """
    settings = f"`{' '.join(changes)}`" if changes else "the settings of the run"
    return f"Run {title}, evaluated with {settings}, {count} gestures."
