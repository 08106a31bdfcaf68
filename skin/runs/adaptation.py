"""Adapt a finished run to another skin: fine-tune its network on few gestures, or learn anew, if better.

The gestures are split into folds with equal fractions of each combination of labels. Candidates are the
network as it is, copies of it that were trained with each choice of layers and learning rate for each number
of epochs, and learners from scratch (:mod:`skin.learning.small_data`). Each candidate predicts the gestures
of a fold after a training on the other folds.

The lowest of many held-out losses is too low by chance. So each fold is judged with the candidate that has
the lowest loss on the other folds. The run is changed only if this loss is lower than the loss of the
original network by more than two standard errors of the difference, and the accuracy is not lower. Then the
candidate with the lowest loss is trained on all gestures.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import islice, product
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Ge, Le, MinLen
from hydra.utils import instantiate
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from rich.console import Console
from torch import nn

from skin.core.rng import Stream, generator
from skin.core.settings import checked, configured
from skin.device.base import AbstractDevice, Blank
from skin.device.touches import Touches, touches_hash
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold, threshold_device
from skin.evaluation.metrics import compute_metrics
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.report import evaluate, metrics_table
from skin.evaluation.settings import check_evaluation
from skin.learning.data import TouchData
from skin.learning.learner import AbstractLearner
from skin.learning.network import TouchClassifier, probabilities
from skin.learning.small_data import (
    SmallDataLearner,
    predict_held_out,
    small_data_features,
    split_folds,
    touch_losses,
)
from skin.runs.build import (
    alarm_source,
    build_data,
    build_device,
    build_learner,
    default_option,
    device_on_skin,
)
from skin.runs.configuration import Config, settings_of, tags
from skin.runs.run import TAG, FinishedRun, find_run
from skin.runs.store import Store
from skin.runs.train import find_finished, log_configuration, log_learner, log_report
from skin.touch.labels import Task

ADAPTED = "adapted"
"""Tag of an adapted run: the id of the run that it was made from."""
LEAST = 8
"""Smallest number of gestures to fine-tune on."""
_COMMAND = ("adapt", "data", "evaluation")  # groups that are taken from the command, not from the run


@checked("adapt")
@dataclass(frozen=True, kw_only=True)
class FineTuning:
    """Settings of a fine-tuning, explained in ``conf/adapt.yaml``; InputError where they are invalid."""

    gestures: Annotated[int, Ge(LEAST)] | None = None
    folds: Annotated[int, Ge(2), Le(LEAST)] = 4
    layers: Annotated[Sequence[Literal["head", "all"]], MinLen(1)] = ("head", "all")
    lr: Annotated[Sequence[PositiveFloat], MinLen(1)] = (1e-4, 5e-4)
    epochs: PositiveInt = 60
    patience: PositiveInt = 10
    batch_size: PositiveInt = 32
    seed: NonNegativeInt = 0
    scratch: Sequence[Literal["kernel_ridge", "extra_trees"]] = ("kernel_ridge", "extra_trees")


@dataclass(frozen=True)
class Candidate:
    """A way to adapt a run.

    Attributes:
        name: what is done, for people; empty: nothing.
        probabilities: probabilities (B, L) of the gestures, each from a learner that was not trained on it.
        train: returns a learner that was trained on all gestures.
        settings: of the learner; empty: those of the run.
    """

    name: str
    probabilities: np.ndarray
    train: Callable[[], AbstractLearner]
    settings: dict[str, Any] = field(default_factory=dict)


def fine_tune(
    learner: AbstractLearner, data: TouchData, touches: Touches, settings: FineTuning
) -> list[Candidate]:
    """Return the network as it is, and fine-tuned after each epoch until the held-out loss rises.

    Args:
        learner: of the run, with a network; :attr:`Candidate.train` changes it.
        data: representation and augmentation of the touches.
        touches: B labelled gestures, at least one per fold.
        settings: of the fine-tuning.

    Raises:
        InputError: gestures without labels, or a learner without a network.
    """
    network, labels = learner.network.eval(), touches.known_labels
    fold = split_folds(labels, settings.folds, settings.seed)
    candidates = [Candidate("", _predict(network, data, touches), lambda: learner)]

    @torch.random.fork_rng()
    def finish(layers: str, lr: float, epochs: int) -> AbstractLearner:
        torch.manual_seed(settings.seed)
        steps = _train(network, data, touches, settings, (layers, lr, settings.folds))
        network.load_state_dict(next(islice(steps, epochs - 1, None)).state_dict())
        return learner

    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        for layers, lr in product(settings.layers, settings.lr):
            trainings = [
                _train(network, data, touches[fold != number], settings, (layers, lr, number))
                for number in range(settings.folds)
            ]
            losses = [float(touch_losses(candidates[0].probabilities, labels.numpy(), network.task).mean())]
            while len(losses) <= settings.epochs and len(losses) - np.argmin(losses) <= settings.patience:
                predicted = np.empty_like(candidates[0].probabilities)
                for number, training in enumerate(trainings):
                    predicted[fold == number] = _predict(next(training), data, touches[fold == number])
                choice = f"layers={layers} lr={lr:g} epochs={len(losses)}"
                candidates.append(Candidate(choice, predicted, partial(finish, layers, lr, len(losses))))
                losses.append(float(touch_losses(predicted, labels.numpy(), network.task).mean()))
            text = f"layers={layers} lr={lr:g}: held-out loss {losses[0]:.4f} before, {min(losses):.4f} after"
            print(f"{text} {np.argmin(losses)} epochs", file=sys.stderr, flush=True)
    return candidates


def _train(
    network: TouchClassifier,
    data: TouchData,
    touches: Touches,
    settings: FineTuning,
    choice: tuple[str, float, int],
) -> Iterator[TouchClassifier]:
    """Yield a copy of a network after each epoch.

    Args:
        network: where the training starts.
        data, touches, settings: as of :func:`fine_tune`.
        choice: layers; learning rate; number, which selects the order of the gestures.
    """
    layers, lr, number = choice
    network, augment = deepcopy(network).requires_grad_(False), data.augmentation
    trained = network.head if layers == "head" else network
    parameters = list(trained.requires_grad_(True).parameters())
    optimizer = torch.optim.Adam(parameters, lr)
    draw = torch.Generator().manual_seed(1000 * settings.seed + number)
    while True:
        network.train()
        for module in network.modules():
            # Few gestures of one skin would distort their statistics.
            if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
                module.eval()
        for rows in torch.randperm(len(touches), generator=draw).split(settings.batch_size):
            frames, labels = data.frames(augment(touches[rows], draw) if augment else touches[rows])
            optimizer.zero_grad()
            network.loss(network(frames), labels).backward()
            nn.utils.clip_grad_norm_(parameters, 1.0)  # a gesture unlike all others must not undo the rest
            optimizer.step()
        yield network.eval()


@torch.no_grad()
def _predict(network: TouchClassifier, data: TouchData, touches: Touches) -> np.ndarray:
    """Return probabilities (B, L) of a network in evaluation mode."""
    parts = torch.arange(len(touches)).split(64)  # bounds memory
    logits = torch.cat([network(data.show(touches[rows])) for rows in parts])
    return probabilities(logits, network.task).numpy()


def learn_from_scratch(
    touches: Touches, task: Task, settings: FineTuning, options: Mapping[str, dict[str, Any]]
) -> Iterator[Candidate]:
    """Yield learners from scratch; none if too few gestures tell a label.

    Args:
        touches: B labelled gestures.
        task: the labels.
        settings: whose folds are held out.
        options: name -> settings of a learner.
    """
    fold = split_folds(touches.known_labels, settings.folds, settings.seed).numpy()
    matrix, labels = small_data_features(touches, task), touches.known_labels.numpy()
    for name, option in options.items():
        make: Callable[[], SmallDataLearner] = partial(instantiate, option, seed=settings.seed)
        try:
            predicted = predict_held_out(make, matrix, labels, task, fold)
        except InputError as reason:
            print(f"from scratch: {name} is not compared: {reason}", file=sys.stderr)
            continue
        print(f"{name}: held-out loss {touch_losses(predicted, labels, task).mean():.4f}", file=sys.stderr)
        train = partial(lambda make: make().learn(matrix, labels, task), make)
        yield Candidate(f"{name}, from scratch", predicted, train, option)


def choose_candidate(
    candidates: Sequence[Candidate], touches: Touches, task: Task, settings: FineTuning
) -> tuple[Candidate, np.ndarray]:
    """Return the best candidate, and probabilities (B, L) of the gestures by candidates not chosen on them.

    Args:
        candidates: the first one changes nothing, and is returned if no other one is clearly better.
        touches: B labelled gestures.
        task: the labels; of a regression r2 takes the place of the accuracy.
        settings: whose folds were held out.
    """
    labels, before = touches.known_labels, candidates[0]
    fold = split_folds(labels, settings.folds, settings.seed)
    losses = np.stack([touch_losses(one.probabilities, labels.numpy(), task) for one in candidates])
    judged = np.empty_like(before.probabilities)
    for number in range(settings.folds):
        held = (fold == number).numpy()
        judged[held] = candidates[losses[:, ~held].mean(axis=1).argmin()].probabilities[held]
    gain = losses[0] - touch_losses(judged, labels.numpy(), task)
    name = "overall/r2" if task.kind == "regression" else "overall/accuracy"
    scores = [
        compute_metrics(torch.from_numpy(side), labels, task)[name] for side in (before.probabilities, judged)
    ]
    if gain.mean() <= 2 * gain.std(ddof=1) / len(gain) ** 0.5 or not scores[1] >= scores[0]:
        return before, before.probabilities
    return candidates[losses.mean(axis=1).argmin()], judged


def find_target(
    parent: FinishedRun, command: Config, settings: FineTuning, overrides: Sequence[str]
) -> tuple[AbstractDevice, AbstractDevice, Config]:
    """Return the skin that a command describes.

    Args:
        parent: the run to adapt.
        command: its configuration: the evaluation, and the augmentation of the gestures.
        settings: of the fine-tuning.
        overrides: of the command line.

    Returns:
        The skin, or its recording; a simulated device with the body and layout of the skin, whose
        imperfections are those of the run, or of ``evaluation.profile``; configuration of the adapted run.

    Raises:
        InputError: no skin is given, or its gestures have other labels than the run.
    """
    groups = {word: word.lstrip("+~").split("=")[0].split(".")[0] for word in overrides}
    words = [word for word in overrides if groups[word] not in _COMMAND]
    measured = parent.configured(words)
    if "test" in measured.device:  # a recording, which is used as a whole
        measured = replace(measured, device=measured.device | {"test": "all"})
    # The device of the run, on this skin: its fresh gestures determine the threshold of the alarm.
    words = [word for word in words if groups[word] not in ("device", "profile")]
    words += [] if "simulator" in parent.stored.device else ["device=simulated"]
    simulated = replace(parent.configured(words), evaluation=command.evaluation)
    device, trained = build_device(measured), simulated.device
    build = device_on_skin(simulated, vars(simulated))
    twin = threshold_device(AlarmSource("", command.evaluation, None, trained, trained, build=build))
    _check(parent, device, twin)
    assert simulated.data is not None and command.data is not None  # noqa: PT018
    adapted = replace(
        simulated,
        row=f"{str(simulated.row).removesuffix('_adapted')}_adapted",
        adapt=asdict(settings) | {"run": parent.run.data.tags["fingerprint"], "device": measured.device},
        data=replace(simulated.data, augment=command.data.augment),
    )
    return device.with_labels(twin.task), twin, adapted


def _check(parent: FinishedRun, device: AbstractDevice, twin: AbstractDevice) -> None:
    """Raise InputError if a device has no touches of one skin, or other labels than the run."""
    if device.reference is not None:
        raise InputError(
            f"run {parent.identity} is adapted to gestures of one skin: add device=recording "
            "device.path=session.parquet (skin record, or skin generate for simulated ones)"
        )
    plain = twin.task.kind == "binary" and twin.task.gate is None and not twin.task.direction
    some = plain and device.task == replace(twin.task, names=device.task.names)
    if device.task != twin.task and not (some and set(device.task.names) <= set(twin.task.names)):
        raise InputError(
            f"run {parent.identity} predicts {', '.join(twin.task.names)}, the gestures have the labels "
            f"{', '.join(device.task.names)}: give gestures with the labels of the run"
        )


def choose_gestures(device: AbstractDevice, settings: FineTuning) -> tuple[Touches, AbstractDevice | None]:
    """Return the gestures to fine-tune on, drawn from all, and a device with the others for the report.

    Raises:
        InputError: there are fewer gestures than wanted, or than can be used.
    """
    touches = device.all_touches()
    touches.known_labels  # noqa: B018 - raises InputError without labels
    count = settings.gestures or len(touches)
    if len(touches) < LEAST:
        raise InputError(f"{len(touches)} gestures are too few to adapt to a skin: record {LEAST} or more")
    if count > len(touches):
        raise InputError(
            f"adapt.gestures={count} is more than the {len(touches)} gestures of the device: "
            f"use adapt.gestures={len(touches)}"
        )
    order = torch.from_numpy(generator(Stream.SPLIT, settings.seed).permutation(len(touches)))
    left = touches[order[count:]]
    return touches[order[:count]], Blank(device.task, device.size, left) if len(left) else None


def adapt(config: Config, run: str, overrides: Sequence[str]) -> None:
    """Adapt a finished run to the skin of a configuration: log a new run and print the figures.

    Nothing is done if a run with the same fingerprint has finished, unless ``tracking.resume=false``.

    Args:
        config, run, overrides: configuration, name of the run, and overrides of ``skin adapt``.

    Raises:
        InputError: the run has no network or does not fit the skin, or there are too few labelled gestures.
    """
    settings, tracking = configured(FineTuning, config.adapt, "adapt"), config.tracking
    options = {str(name): default_option("learner", name) for name in settings.scratch}
    torch.set_num_threads(tracking.threads or torch.get_num_threads())
    parent = find_run(tracking, run, config.trust)
    device, twin, target = find_target(parent, config, settings, overrides)
    identity = tags(target) | {ADAPTED: parent.identity, "target": " ".join(overrides)}
    if tracking.resume and find_finished(Store.existing(tracking), identity["fingerprint"]):
        return
    learner, data = build_learner(target), build_data(target, device.blank())
    parent.load_weights(learner, data)
    learner.network  # noqa: B018 - refuses another learner before gestures are read from a port
    touches, others = choose_gestures(device, settings)
    source, task = replace(alarm_source(parent, learner, target), device=twin), twin.task
    choose = partial(choose_alarm_threshold, one_skin=True)
    point = choose(source)
    figures: dict[str, float] = {}
    if others is not None:
        tests = others.touches("test")
        figures |= _figures("before", learner.probabilities(tests).numpy(), tests, task, point)
    name = f"{target.row} {identity['simulator']} {len(touches)} gestures seed {settings.seed}"
    store = Store.open(tracking)
    with store.run(name, identity, parent.identity) as made:
        candidates = fine_tune(learner, data, touches, settings)
        candidates += learn_from_scratch(touches, task, settings, options)
        best, after = choose_candidate(candidates, touches, task, settings)
        learner = best.train()
        chosen = settings_of(replace(target, learner=best.settings or target.learner))
        log_configuration(store, made.info.run_id, chosen, touches_hash(touches))
        log_learner(store, made, learner)
        if best.name and point is not None:
            point = choose(replace(source, learner=learner), anew=True)
        figures |= _figures("validation_before", candidates[0].probabilities, touches, task)
        figures |= _figures("validation", after, touches, task)
        if others is None:
            store.client.set_tag(made.info.run_id, TAG, "null" if point is None else point.text())
            store.log_metrics(made, figures)
        else:
            report = evaluate(learner, others, check_evaluation(target.evaluation), point)
            log_report(store, made, report, task, figures)
            figures |= {key: value for key, value in report.metrics.items() if key.startswith("same/")}
        store.client.set_tag(made.info.run_id, "chosen", best.name)
    _announce(figures, f"{name}, run {made.info.run_id}", others is not None, best.name, parent.identity)


def _announce(figures: dict[str, float], title: str, reported: bool, chosen: str, parent: str) -> None:
    """Print a table of metrics, what its columns mean, and which model was kept."""
    Console().print(metrics_table(figures, title))
    meaning = "validation: the gestures to adapt on, each predicted by a model that was not trained on it"
    print(meaning, "; before, same: other gestures of the skin" if reported else "", sep="")
    unchanged = f"nothing is better on held-out gestures: the new run keeps the weights of run {parent}"
    print(f"chosen: {chosen}" if chosen else unchanged)


def _figures(
    column: str, predicted: np.ndarray, touches: Touches, task: Task, point: OperatingPoint | None = None
) -> dict[str, float]:
    """Return the metrics of predictions (B, L) of gestures, as ``column/name``."""
    figures = compute_metrics(torch.from_numpy(predicted), touches.known_labels, task, point)
    return {f"{column}/{name}": value for name, value in figures.items()}
