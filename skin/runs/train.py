"""One run: build, train, evaluate, log; evaluate again."""

import logging
import math
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from mlflow.entities import Param, Run
from omegaconf import OmegaConf
from pytorch_lightning.loggers import MLFlowLogger
from pytorch_lightning.utilities import rank_zero_only
from rich.console import Console
from torch import Tensor

from skin.core.files import results
from skin.core.messages import PARENT, quiet
from skin.core.settings import option_name
from skin.device.simulated import check_label_leakage
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold, threshold_device
from skin.evaluation.metrics import OUTCOMES, compute_metrics
from skin.evaluation.report import Report, evaluate, metrics_table, publish_evaluation, write_probabilities
from skin.evaluation.report import print_report as show
from skin.evaluation.settings import check_evaluation
from skin.learning.learner import AbstractLearner
from skin.learning.network import LAST
from skin.plot.figures import confusions, save_figure
from skin.runs.build import build_data, build_device, build_learner, device_on_skin, load_model
from skin.runs.configuration import (
    MACHINE,
    NETWORK,
    Config,
    iterate_leaves,
    name_option,
    name_run,
    relevant_overrides,
    reveal_password,
    settings_of,
    source_tags,
    tags,
    unused_groups,
)
from skin.runs.run import TAG, find_run
from skin.runs.store import Store, note_reuse
from skin.touch.labels import Task

_log = logging.getLogger(__name__)

_OF_RECORDINGS = ("batch_size", "augment")  # settings of the data that touches of a file depend on
_VALIDATION = "best_val_"  # begins the names of metrics of what was learned on the validation split


def train(config: Config) -> float:
    """Train and evaluate a configuration; return the objective on the validation split.

    A run that finished with the same fingerprint is not repeated, and one that was killed is continued,
    unless ``tracking.resume=false``.

    Raises:
        InputError: a setting cannot be used, or ``tracking.objective`` is not among the metrics.
    """
    quiet()
    tracking, identity = config.tracking, tags(config)
    torch.set_num_threads(tracking.threads or torch.get_num_threads())
    identity["threads"] = str(torch.get_num_threads())
    if getattr(rank_zero_only, "rank", 0):
        # One of several processes (trainer.devices); the first one does all the rest.
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            data, learner = build_data(config, build_device(config)), build_learner(config)
            learner.fit(data)
        return math.nan
    store = Store.existing(tracking)
    if tracking.resume and (finished := find_finished(store, identity["fingerprint"])):
        return _objective(tracking.objective, finished.data.metrics)
    settings = check_evaluation(config.evaluation)
    device = build_device(config)
    data, learner = build_data(config, device), build_learner(config)
    source = AlarmSource(
        "this run",
        settings,
        learner,
        config.device,
        config.device,
        build=device_on_skin(config, vars(config)),
    )
    source = replace(source, device=device if settings.profile is None else threshold_device(source))
    learner.check(data)
    _objective(tracking.objective, _score(data.task, *[data.example.known_labels] * 2))  # refuses other names
    check_label_leakage(device)
    name = name_run(identity, relevant_overrides(config.learner))
    store = Store.open(tracking)
    with store.hold(identity["fingerprint"]):
        if tracking.resume and (finished := find_finished(store, identity["fingerprint"])):
            return _objective(tracking.objective, finished.data.metrics)
        again = find_unfinished(store, identity["fingerprint"]) if tracking.resume else None
        with store.run(name, identity, os.environ.get(PARENT), again) as run:
            learner.unfinished = store.folder / run.info.run_id
            learner.unfinished.mkdir(exist_ok=True)
            log_configuration(store, run.info.run_id, settings_of(config), data.hash)
            logger = RunLogger(tracking_uri=reveal_password(store.uri), run_id=run.info.run_id)
            learner.fit(data, logger)
            point = choose_alarm_threshold(source, anew=True)
            report = evaluate(learner, device, settings, point)
            parts = [(learner.probabilities(p), p.known_labels) for p in data.parts("validation") if len(p)]
            scores = _score(data.task, *map(torch.cat, zip(*parts, strict=True))) if parts else {}
            log_learner(store, run, learner)
            figures = {"seconds_per_epoch": learner.seconds_per_epoch, "parameters": learner.parameters}
            log_report(store, run, report, device.task, figures | scores)
        shutil.rmtree(learner.unfinished, ignore_errors=True)
    if PARENT not in os.environ:
        show(report, f"{name}, run {run.info.run_id}")
    return _objective(tracking.objective, scores)


def _score(task: Task, probabilities: Tensor, labels: Tensor) -> dict[str, float]:
    """Return the metrics on the validation split, ``best_val_<metric>`` over all labels and of each."""
    return {
        f"{_VALIDATION}{'_'.join(reversed(name.split('/')))}".removesuffix("_overall"): value
        for name, value in compute_metrics(probabilities, labels, task).items()
    }


def _objective(name: str | None, metrics: Mapping[str, float]) -> float:
    """Return ``tracking.objective``: by default the accuracy; of a regression the fraction of the variance.

    Raises:
        InputError: a metric is named that is missing.
    """
    scores = {key: value for key, value in metrics.items() if key.startswith(_VALIDATION)}
    if name and name not in scores:
        raise InputError(
            f"tracking.objective={name} is not a metric of the validation data: give one of "
            f"{', '.join(scores) or 'those that another run logs'}"
        )
    # Runs of earlier versions have none.
    return scores.get(name or f"{_VALIDATION}accuracy", scores.get(f"{_VALIDATION}r2", math.nan))


def evaluate_run(config: Config, name: str, out: str | None, changes: Sequence[str]) -> None:
    """Evaluate a finished run on other touches, or on a skin; print, write and log what is found.

    Args:
        config: of the command.
        name: of the run.
        out: folder of the files; None: ``results``.
        changes: overrides of the configuration of the run.

    Raises:
        InputError: the run, its device or a setting cannot be used.
    """
    quiet()
    finished = find_run(config.tracking, name, config.trust)
    configured = finished.configured(changes)
    settings, model = check_evaluation(configured.evaluation), load_model(finished, configured)
    device, learner, point = model.device, model.learner, model.point
    touches = device.touches("test")  # read before anything is logged, because a port may fail
    title = f"{finished.title} ({finished.identity})"
    # An address of a store, which may hold a password, changes no figure.
    changes = [word for word in changes if not word.startswith("tracking.")]
    tags = {"evaluated": finished.identity, "overrides": " ".join(changes)}
    store = Store.open(configured.tracking)
    with store.run(f"evaluation of {finished.title}", tags, finished.identity) as evaluation:
        # Evaluations do not overwrite each other's files.
        path = results(out) / f"evaluation_{option_name(device)}_{evaluation.info.run_id[:8]}.md"
        if touches.labels is None:
            written = [path.with_suffix(".csv")]
            probabilities = learner.probabilities(touches)
            print(title, write_probabilities(probabilities, device.task, point, *written), sep="\n")
        else:
            report = evaluate(learner, device, settings, point)
            log_report(store, evaluation, report, device.task, {})
            words = f"`{' '.join(changes)}`" if changes else "the settings of the run"
            description = f"Run {title}, evaluated with {words}, {len(report.predictions)} gestures."
            written = publish_evaluation(path, report, device.task, finished.title, description)
            show(report, title)
        for file in written:
            store.client.log_artifact(evaluation.info.run_id, str(file))
    print(*written, sep="\n")


class RunLogger(MLFlowLogger):
    """Logs a training to its run and leaves the run open.

    Lightning's own calls a run FINISHED when the fit ends; one that is killed during its evaluation would
    then count as finished without having any result.
    """

    def finalize(self, status: str = "success") -> None:
        """Do nothing: the run ends with its evaluation."""


def find_unfinished(store: Store, fingerprint: str) -> Run | None:
    """Return the last killed run that the same code on the same processor can continue; hold its lock.

    Args:
        store: where.
        fingerprint: of the run.
    """
    source = source_tags().items()
    killed = store.find("KILLED", fingerprint=fingerprint)
    same = (run for run in killed if source <= run.data.tags.items())
    run = next((run for run in same if (store.folder / run.info.run_id / LAST).is_file()), None)
    if run is not None:
        _log.info("run %s was interrupted and continues: tracking.resume=false repeats it", run.info.run_id)
    return run


def find_finished(store: Store, fingerprint: str) -> Run | None:
    """Return the newest run that did a training before; print its metrics, unless a sweep does."""
    run = next(iter(store.find("FINISHED", fingerprint=fingerprint)), None)
    if run is not None:
        note_reuse(run)
        _log.info("run %s did this before: tracking.resume=false repeats it", run.info.run_id)
        if PARENT not in os.environ:
            Console().print(metrics_table(run.data.metrics, run.info.run_name))
    return run


def log_learner(store: Store, run: Run, learner: AbstractLearner) -> None:
    """Log what a learner has learned, for :meth:`skin.runs.run.FinishedRun.load_weights`."""
    with tempfile.TemporaryDirectory() as folder:
        path = learner.save(Path(folder))
        store.client.log_artifact(run.info.run_id, str(path))
        store.client.set_tag(run.info.run_id, "learned", path.name)


def log_configuration(store: Store, run: str, settings: dict[str, Any], data_hash: str) -> None:
    """Log the configuration of a run before it starts.

    Args:
        store: where.
        run: its id.
        settings: its configuration in plain containers; unused groups may be left out.
        data_hash: of the touches of its training.
    """
    store.client.log_text(run, OmegaConf.to_yaml(OmegaConf.create(settings)), "config.yaml")
    store.client.set_tag(run, "data_hash", data_hash)
    unused, simulated = unused_groups(settings["learner"]), "simulator" in settings["device"]
    groups = ("simulator", "device", "representation", "model", "fusion", "learner")[0 if simulated else 1 :]
    data = {name: settings["data"][name] for name in (settings["data"] if simulated else _OF_RECORDINGS)}
    parts = {part: settings.get(part, {}) for part in (*NETWORK, "learner") if part not in unused}
    values = {
        ".".join(path): value
        for path, value in iterate_leaves({"data": data, **parts})
        if not path[-1].startswith("_") and not {"body", *NETWORK, *MACHINE}.intersection(path[1:])
    }
    values |= relevant_overrides(settings["learner"]) | {
        "seed": settings["seed"],
        "row": settings.get("row"),
        **{name: name_option(settings[name], name) for name in groups if name in settings.keys() - {*unused}},
    }
    store.client.log_batch(run, params=[Param(name, str(value)) for name, value in values.items()])


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
        pq.write_table(report.predictions, Path(folder) / "predictions.parquet")
        if report.outcomes is not None:
            np.save(Path(folder) / OUTCOMES, report.outcomes)
        if report.confusion is not None:
            named = dict(zip(task.binary, report.confusion.numpy(), strict=True))
            save_figure(confusions(named, ("no", "yes")), Path(folder) / "confusion.png")
        store.client.log_artifacts(run.info.run_id, folder)
    for column, reason in report.unavailable.items():
        store.client.set_tag(run.info.run_id, f"cannot_{column}", reason)
