"""Adapt a finished run to another skin: fine-tune its network and log the result as a new run."""

from collections.abc import Sequence

import torch
from mlflow.entities import Run
from omegaconf import DictConfig
from rich.console import Console

from skin.adaptation_target import Target, choose_gestures, find_target
from skin.alarm_threshold import alarm_point
from skin.build import build_data, build_learner
from skin.config import plain
from skin.device.base import AbstractDevice
from skin.evaluation.metrics import metrics
from skin.evaluation.metrics_table import metrics_table
from skin.evaluation.operating_point import OperatingPoint, choose_operating_point
from skin.evaluation.report import evaluate
from skin.fine_tuning import Adaptation, FineTuning, fine_tune
from skin.finished_run import TAG, FinishedRun
from skin.learner.base import AbstractLearner
from skin.progress import Steps
from skin.recording import Touches, touches_hash
from skin.run import describe, log_learner, log_report, tags
from skin.settings import configured
from skin.source import note_reuse
from skin.tracking import Store

ADAPTED = "adapted"
"""Tag of an adapted run: the id of the run that it was made from."""


# Expected seconds of each step, for the share in the progress.
_STEPS = {
    "loading the run": 10.0,
    "reading or simulating the gestures": 15.0,
    "choosing the threshold of the alarm": 15.0,
    "fine-tuning": 60.0,
    "evaluating the result": 40.0,
}


def adapt(config: DictConfig, overrides: Sequence[str]) -> None:
    """Adapt a finished run to the skin of a configuration: log a new run and print the figures.

    Nothing is done if a run with the same fingerprint has finished, unless ``tracking.resume=false``.

    Args:
        config: of ``skin adapt``.
        overrides: of the command line.

    Raises:
        InputError: the run is no network or does not fit the skin, the gestures have no labels, or there are
            fewer than wanted.
    """
    with Steps(_STEPS) as steps:
        _adapt(config, overrides, steps)


def _adapt(config: DictConfig, overrides: Sequence[str], steps: Steps) -> None:
    settings = configured(FineTuning, plain(config)["adapt"], "adapt")
    if config.tracking.threads:
        torch.set_num_threads(config.tracking.threads)
    parent = FinishedRun.named(config)
    store = parent.store
    target = find_target(parent, config, settings, overrides)
    identity = tags(target.config) | {ADAPTED: parent.identity, "target": " ".join(overrides)}
    done = store.find("FINISHED", fingerprint=identity["fingerprint"]) if config.tracking.resume else []
    if done:
        note_reuse(done[0])
        print(f"run {done[0].info.run_id} did this before: tracking.resume=false repeats it")
        return
    learner, data = build_learner(target.config), build_data(target.config, target.device.blank())
    parent.load_weights(learner, data)
    network = learner.network  # refuses another learner before gestures are read from a port
    steps.begin("reading or simulating the gestures")
    steps.silent = target.device.wired is not None
    touches, others = choose_gestures(target.device, settings)
    steps.silent = False
    steps.begin("choosing the threshold of the alarm")
    point = alarm_point(parent, learner, target.config, one_skin=True, device=target.twin)
    values = {} if others is None else _before(learner, others, point)
    name = f"{target.config.row} {identity['simulator']} {len(touches)} gestures seed {settings.seed}"
    store = Store.open(config.tracking)
    with store.run(name, identity, parent.identity) as run:
        describe(store, run.info.run_id, target.config, touches_hash(touches))
        steps.begin("fine-tuning")
        found = fine_tune(network, data, touches, settings)
        log_learner(store, run, learner)
        steps.begin("evaluating the result")
        if found.better and point is not None:
            point = choose_operating_point(learner, target.twin, target.config.evaluation)
        values |= _validation(found, touches, target.device)
        values |= _log(store, run, learner, target, others, point, values)
        _log_trials(store, run, found)
    Console().print(metrics_table(values, f"{name}, run {run.info.run_id}"))
    print(_sentence(found, parent, others))


def _before(
    learner: AbstractLearner, others: AbstractDevice, point: OperatingPoint | None
) -> dict[str, float]:
    """Return the metrics of the original network on the test gestures."""
    touches = others.touches("test")
    found = metrics(learner.probabilities(touches), touches.known_labels, others.task, point)
    return {f"before/{name}": value for name, value in found.items()}


def _validation(found: Adaptation, touches: Touches, device: AbstractDevice) -> dict[str, float]:
    """Return the metrics on the gestures, each held out once, of the original and of the result."""
    chances = {"validation_before": found.before, "validation": found.after if found.better else found.before}
    return {
        f"{column}/{name}": value
        for column, chance in chances.items()
        for name, value in metrics(chance, touches.known_labels, device.task).items()
    }


def _log(
    store: Store,
    run: Run,
    learner: AbstractLearner,
    target: Target,
    others: AbstractDevice | None,
    point: OperatingPoint | None,
    values: dict[str, float],
) -> dict[str, float]:
    """Log metrics and operating point, and return the metrics on the test gestures, if there are any."""
    if others is None:
        store.client.set_tag(run.info.run_id, TAG, "null" if point is None else point.text())
        store.log_metrics(run, values)
        return {}
    report = evaluate(learner, others, target.config.evaluation, point)
    log_report(store, run, report, target.device.task, values)
    return {name: value for name, value in report.metrics.items() if name.startswith("same/")}


def _log_trials(store: Store, run: Run, found: Adaptation) -> None:
    """Log the held-out loss of each trial and epoch as ``adapt.csv``, and the choice as a tag."""
    rows = [
        f"{trial.layers},{trial.lr:g},{epoch},{loss:.6f}"
        for trial in found.trials
        for epoch, loss in enumerate(trial.losses)
    ]
    store.client.log_text(run.info.run_id, "\n".join(["layers,lr,epoch,loss", *rows, ""]), "adapt.csv")
    store.client.set_tag(run.info.run_id, "chosen", found.choice)


def _sentence(found: Adaptation, parent: FinishedRun, others: AbstractDevice | None) -> str:
    """Return what was done, and which gestures the figures are for."""
    about = "validation: the gestures to adapt on, each predicted by a network that was not trained on it"
    about += "" if others is None else "; before, same: other gestures of the skin"
    if found.better:
        return f"{about}\nfine-tuned: {found.choice}"
    return (
        f"{about}\nfine-tuning is not better on held-out gestures: the new run keeps the weights of run "
        f"{parent.identity}"
    )
