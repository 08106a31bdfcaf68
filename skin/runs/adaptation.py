"""Adapt a finished run to another skin: fine-tune its network on few gestures, or learn anew, if better.

The gestures are split into folds with equal shares of each combination of labels. For each choice of layers
and learning rate, and each fold, a copy of the network is trained on the other folds, and its loss on the
fold is measured after each epoch. The choice and number of epochs with the lowest mean loss train on all
gestures.

The lowest of many losses is too low by chance. So the result is judged on each fold with the choice that has
the lowest loss on the other folds. The network is changed only if this loss is lower than that of the
original network by more than two standard errors of the difference, and the accuracy is not lower.

Learners from scratch (:mod:`skin.learning.small_data`) are compared on the same folds. The one with the
lowest loss on held-out gestures takes the place of the network under the same two conditions, and if its loss
is lower than that of the fine-tuned network, too.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import islice, product
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Le, MinLen
from hydra.utils import instantiate
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from rich.console import Console
from torch import Tensor, nn

from skin.core.progress import Steps
from skin.core.rng import Stream, generator
from skin.core.settings import checked, configured, import_target
from skin.device.base import AbstractDevice, Blank
from skin.device.touches import Touches, touches_hash
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold, threshold_device
from skin.evaluation.metrics import compute_metrics
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.report import evaluate, metrics_table
from skin.evaluation.settings import check_evaluation
from skin.learning.data import TouchData
from skin.learning.network import TouchClassifier, probabilities
from skin.learning.small_data import (
    SmallDataLearner,
    predict_held_out,
    small_data_features,
    split_folds,
    touch_losses,
)
from skin.runs.build import build_data, build_device, build_learner, default_option
from skin.runs.configuration import Config
from skin.runs.run import TAG, FinishedRun
from skin.runs.store import Store, note_reuse
from skin.runs.torch_model import alarm_source, device_on_skin
from skin.runs.train import log_configuration, log_learner, log_report, tags
from skin.touch.labels import Task

ADAPTED = "adapted"
"""Tag of an adapted run: the id of the run that it was made from."""
LEAST = 8
"""Smallest number of gestures to fine-tune on."""
_DEFAULT = 48  # gestures of a simulated device
_CLIP = 1.0  # largest norm of the gradient
_CHUNK = 64  # gestures at a time when predicting
_CLEAR = 2.0  # standard errors
_COMMAND = ("adapt", "data", "evaluation")  # groups that are taken from the command, not from the run
# Expected seconds of each step, for the share in the progress.
_STEPS = {"loading the run": 10.0, "reading or simulating the gestures": 15.0}
_STEPS |= {"choosing the threshold of the alarm": 15.0, "fine-tuning": 60.0, "evaluating the result": 40.0}

Layers = Literal["head", "all"]


@checked("adapt")
@dataclass(frozen=True, kw_only=True)
class FineTuning:
    """Settings of a fine-tuning, explained in ``conf/adapt.yaml``; InputError where they are invalid."""

    gestures: Annotated[int, Ge(LEAST)] | None = None
    folds: Annotated[int, Ge(2), Le(LEAST)] = 4
    layers: Annotated[Sequence[Layers], MinLen(1)] = ("head", "all")
    lr: Annotated[Sequence[PositiveFloat], MinLen(1)] = (1e-4, 5e-4)
    epochs: PositiveInt = 60
    patience: PositiveInt = 10
    batch_size: PositiveInt = 32
    seed: NonNegativeInt = 0
    scratch: Sequence[str] = ("kernel_ridge", "extra_trees")


@dataclass(frozen=True)
class Trial:
    """A choice of layers and learning rate, with its held-out losses (E) and logits (E, B, L).

    The first ones are those before the training, the others those after each epoch.
    """

    layers: Layers
    lr: float
    losses: list[float]
    logits: Tensor


@dataclass(frozen=True)
class Adaptation:
    """The result of a fine-tuning.

    Attributes:
        trials: all choices.
        choice: the settings with which the network was trained; empty if it was not changed.
        before: probabilities (B, L) of the gestures from the original network.
        after: the same, of each from a network that was not trained on it, nor its settings chosen on it.
    """

    trials: list[Trial]
    choice: str
    before: Tensor
    after: Tensor

    @property
    def better(self) -> bool:
        """Whether ``after`` is better than ``before``. If not, the network is not changed."""
        return bool(self.choice)


def fine_tune(
    network: TouchClassifier, data: TouchData, touches: Touches, settings: FineTuning
) -> Adaptation:
    """Fine-tune a network, in place, if that is better on held-out gestures.

    Args:
        network: trained.
        data: representation and augmentation of the touches.
        touches: B labelled gestures, at least one per fold.
        settings: of the fine-tuning.

    Raises:
        InputError: gestures without labels.
    """
    folds = Folds(network, data, touches, settings)
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        first = folds.logits(network.eval(), touches)
        trials = [folds.attempt(first, layers, lr) for layers, lr in product(settings.layers, settings.lr)]
        chosen, choice = min(trials, key=lambda trial: min(trial.losses)), ""
        epochs, judged = _lowest(chosen.losses), folds.judged(trials)
        if epochs > 0 and _is_better(network, first, judged, touches.known_labels):
            choice = f"layers={chosen.layers} lr={chosen.lr:g} epochs={epochs}"
            steps = folds.train(touches, chosen.layers, chosen.lr, settings.folds)
            network.load_state_dict(next(islice(steps, epochs - 1, None)).state_dict())
    return Adaptation(trials, choice, *(probabilities(logits, network.task) for logits in (first, judged)))


@dataclass(frozen=True)
class Folds:
    """The arguments of :func:`fine_tune`, and the fold of each gesture, (B,), as ``fold``."""

    network: TouchClassifier
    data: TouchData
    touches: Touches
    settings: FineTuning

    @cached_property
    def fold(self) -> Tensor:
        return split_folds(self.touches.known_labels, self.settings.folds, self.settings.seed)

    def attempt(self, first: Tensor, layers: Layers, lr: float) -> Trial:
        """Train on all folds but one, for each, epoch by epoch, until the held-out loss rises.

        Args:
            first: logits (B, L) of the original network.
            layers: to train.
            lr: learning rate.
        """
        settings, touches, labels = self.settings, self.touches, self.touches.known_labels
        held = [self.fold == number for number in range(settings.folds)]
        runs = [self.train(touches[~rows], layers, lr, number) for number, rows in enumerate(held)]
        losses, logits = [float(self.network.loss(first, labels))], [first]
        while len(losses) <= settings.epochs and len(losses) - _lowest(losses) <= settings.patience:
            epoch = torch.empty_like(first)
            for rows, run in zip(held, runs, strict=True):
                epoch[rows] = self.logits(next(run), touches[rows])
            losses.append(float(self.network.loss(epoch, labels)))
            logits.append(epoch)
        text = f"layers={layers} lr={lr:g}: held-out loss {losses[0]:.4f} before, {min(losses):.4f} after"
        print(f"{text} {_lowest(losses)} epochs", file=sys.stderr, flush=True)
        return Trial(layers, lr, losses, torch.stack(logits))

    def judged(self, trials: Sequence[Trial]) -> Tensor:
        """Return the logits (B, L) of each fold, of the choice with the lowest loss on the other folds."""
        labels, judged = self.touches.known_labels, torch.empty_like(trials[0].logits[0])
        candidates = torch.cat([trial.logits for trial in trials])
        for number in range(self.settings.folds):
            held = self.fold == number
            losses = [float(self.network.loss(logits[~held], labels[~held])) for logits in candidates]
            judged[held] = candidates[_lowest(losses)][held]
        return judged

    def train(self, touches: Touches, layers: Layers, lr: float, number: int) -> Iterator[TouchClassifier]:
        """Yield a copy of the network after each epoch; ``number`` selects the order of the gestures."""
        network = deepcopy(self.network).requires_grad_(False)
        trained = network.head if layers == "head" else network
        parameters = list(trained.requires_grad_(True).parameters())
        optimizer = torch.optim.Adam(parameters, lr)
        draw = torch.Generator().manual_seed(1000 * self.settings.seed + number)
        augmentation = self.data.augmentation
        while True:
            network.train()
            for module in network.modules():
                # Few gestures of one skin would spoil their statistics.
                if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
                    module.eval()
            for rows in torch.randperm(len(touches), generator=draw).split(self.settings.batch_size):
                batch = touches[rows]
                frames, labels = self.data.frames(augmentation(batch, draw) if augmentation else batch)
                optimizer.zero_grad()
                network.loss(network(frames), labels).backward()
                nn.utils.clip_grad_norm_(parameters, _CLIP)
                optimizer.step()
            yield network.eval()

    @torch.no_grad()
    def logits(self, network: TouchClassifier, touches: Touches) -> Tensor:
        """Return the logits (B, L) of a network in evaluation mode."""
        starts = range(0, len(touches), _CHUNK)
        return torch.cat([network(self.data.frames(touches[at : at + _CHUNK])[0]) for at in starts])


def _lowest(losses: Sequence[float]) -> int:
    """Return the place of the lowest loss, the first of equal ones."""
    return min(range(len(losses)), key=losses.__getitem__)


def _is_better(network: TouchClassifier, first: Tensor, last: Tensor, labels: Tensor) -> bool:
    """Return whether the loss is lower by more than two standard errors, and the accuracy is not lower."""
    pairs = zip(first.split(1), last.split(1), labels.split(1), strict=True)
    gain = torch.stack([network.loss(old, truth) - network.loss(new, truth) for old, new, truth in pairs])
    before, after = (probabilities(logits, network.task) for logits in (first, last))
    return _is_clear(gain, before, after, labels, network.task)


def _is_clear(gain: Tensor, before: Tensor, after: Tensor, labels: Tensor, task: Task) -> bool:
    """Return whether losses fall by more than two standard errors, and the accuracy does not.

    Args:
        gain: (B,), by how much the loss of each gesture falls.
        before, after: probabilities (B, L), or targets.
        labels: (B, L).
        task: of a regression r2 takes the place of the accuracy.
    """
    name = "overall/r2" if task.kind == "regression" else "overall/accuracy"
    old, new = (compute_metrics(chances, labels, task)[name] for chances in (before, after))
    return bool(gain.mean() > _CLEAR * gain.std() / len(gain) ** 0.5) and new >= old


@dataclass(frozen=True)
class Scratch:
    """The best learner from scratch.

    Attributes:
        name: of the option of ``learner``.
        learner: fitted to all gestures.
        settings: of the learner.
        chances: probabilities (B, L) of the gestures, each from a learner that did not see it.
    """

    name: str
    learner: SmallDataLearner
    settings: dict[str, Any]
    chances: Tensor


def learn_from_scratch(
    touches: Touches,
    task: Task,
    adaptation: Adaptation,
    settings: FineTuning,
    options: Mapping[str, dict[str, Any]],
) -> Scratch | None:
    """Return the learner from scratch that is better than the network, fine-tuned or not; None: none is.

    Args:
        touches: B labelled gestures.
        task: the labels.
        adaptation: of the network to them.
        settings: whose folds are held out.
        options: name -> settings of a learner.
    """
    labels = touches.known_labels
    fold = split_folds(labels, settings.folds, settings.seed)
    if lacking := _lacking(labels, fold, task):
        if options:
            print(f"from scratch: not compared, too few gestures tell {lacking}", file=sys.stderr)
        return None
    matrix, truth = small_data_features(touches, task), labels.numpy()
    kept = adaptation.after if adaptation.better else adaptation.before
    losses, held = {"": touch_losses(kept.numpy(), truth, task)}, dict[str, Tensor]()
    for name, option in options.items():
        make = partial(instantiate, option, seed=settings.seed)
        predicted = predict_held_out(make, matrix, truth, task, fold.numpy())
        held[name], losses[name] = torch.from_numpy(predicted).float(), touch_losses(predicted, truth, task)
        print(f"{name}: held-out loss {losses[name].mean():.4f}", file=sys.stderr, flush=True)
    best = min(losses, key=lambda name: float(losses[name].mean()))
    gain = torch.from_numpy(touch_losses(adaptation.before.numpy(), truth, task) - losses[best])
    if not best or not _is_clear(gain, adaptation.before, held[best], labels, task):
        return None
    learner: SmallDataLearner = instantiate(options[best], seed=settings.seed)
    return Scratch(best, learner.learn(matrix, truth, task), options[best], held[best])


def _scratch_options(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the settings of learners for small data by name.

    Raises:
        InputError: a name is of no such learner.
    """
    options = {name: default_option("learner", name) for name in names}
    for name, option in options.items():
        kind = import_target(option["_target_"], "adapt.scratch")
        if not (isinstance(kind, type) and issubclass(kind, SmallDataLearner)):
            raise InputError(f"adapt.scratch={name} is no learner for small data: kernel_ridge, extra_trees")
    return options


def _lacking(labels: Tensor, fold: Tensor, task: Task) -> str:
    """Return the names of the labels (B, L) that have fewer than two values outside of some fold."""
    names = []
    for name, column, known in zip(task.names, labels.T, task.counts(labels).T, strict=True):
        values = (column[known & (fold != number)].unique() for number in fold.unique())
        names += [name] if min(len(part) for part in values) < 2 else []
    return ", ".join(names)


@dataclass(frozen=True)
class Target:
    """A skin to adapt a run to.

    Attributes:
        device: the skin, or its recording.
        twin: a simulated device with the body and layout of the skin. Its imperfections are those of the run,
            or of ``evaluation.profile``.
        config: of the adapted run.
    """

    device: AbstractDevice
    twin: AbstractDevice
    config: Config


def find_target(
    parent: FinishedRun, config: Config, settings: FineTuning, overrides: Sequence[str]
) -> Target:
    """Return the skin that a command describes.

    Args:
        parent: the run to adapt.
        config: of the command.
        settings: of the fine-tuning.
        overrides: of the command line.

    Raises:
        InputError: no skin is given, or its gestures have other labels than the run.
    """
    words = [word for word in overrides if _group(word) not in _COMMAND]
    measured = parent.configured(words)
    if "test" in measured.device:  # a recording, which is used as a whole
        measured = replace(measured, device=measured.device | {"test": "all"})
    # The device of the run, on this skin: its fresh gestures determine the threshold of the alarm.
    words = [word for word in words if _group(word) not in ("device", "profile")]
    words += [] if "simulator" in parent.stored.device else ["device=simulated"]
    simulated = replace(parent.configured(words), evaluation=config.evaluation)
    source = AlarmSource("", config.evaluation, None, simulated.device, simulated.device)
    device = build_device(measured)
    twin = threshold_device(replace(source, build=device_on_skin(simulated, simulated)))
    _check(parent, device, twin)
    device = device.with_labels(twin.task)
    drawn = device.simulation is not None
    budget = simulated_budget(settings.gestures or _DEFAULT)
    gestures: dict[str, Any] = {"gestures": budget, "fresh": False} if drawn else {}
    identity = {"run": parent.run.data.tags["fingerprint"], "device": measured.device}
    adapted = measured if drawn else simulated
    assert adapted.data is not None
    assert config.data is not None
    adapted = replace(
        adapted,
        row=f"{str(adapted.row).removesuffix('_adapted')}_adapted",
        adapt=asdict(settings) | identity,
        data=replace(adapted.data, augment=config.data.augment, **gestures),
        device=adapted.device | gestures | ({"data_seed": settings.seed} if drawn else {}),
        evaluation=config.evaluation,
    )
    return Target(device, twin, adapted)


def _group(override: str) -> str:
    """Return the group of an override."""
    return override.lstrip("+~").split("=")[0].split(".")[0]


def _check(parent: FinishedRun, device: AbstractDevice, twin: AbstractDevice) -> None:
    """Raise InputError if a device is not one skin, or has other labels than the run."""
    if device.simulation is None and device.reference is not None:
        raise InputError(
            f"run {parent.identity} was trained on many skins: name the one to adapt to, as in "
            "device=recording device.path=session.parquet or device=simulated layout.path=sensors.csv"
        )
    plain = twin.task.kind == "binary" and twin.task.gate is None and not twin.task.direction
    some = plain and device.task == replace(twin.task, names=device.task.names)
    if device.task != twin.task and not (some and set(device.task.names) <= set(twin.task.names)):
        raise InputError(
            f"run {parent.identity} predicts {', '.join(twin.task.names)}, the gestures have the labels "
            f"{', '.join(device.task.names)}: give gestures with the labels of the run"
        )


def choose_gestures(device: AbstractDevice, settings: FineTuning) -> tuple[Touches, AbstractDevice | None]:
    """Return the gestures to fine-tune on, and a device with others for the report.

    A simulated device draws as many as are wanted: the training split that ``skin train`` has with
    ``data.gestures`` = n / 0.8 and the same seed. The others are its test gestures. For all other devices, a
    part of the touches of :meth:`AbstractDevice.all_touches` is drawn, and the others are what is left.

    Raises:
        InputError: there are fewer gestures than wanted, or than can be used.
    """
    if device.simulation is not None:
        count = settings.gestures or _DEFAULT
        budget = {"gestures": simulated_budget(count), "fresh": False, "data_seed": settings.seed}
        drawn = device.simulation.replace(**budget)
        return drawn.touches("train")[:count], drawn
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


def simulated_budget(count: int) -> int:
    """Return the budget of gestures whose training split, 80 %, has ``count`` of them or one more."""
    return -(-count * 10 // 8)


def adapt(config: Config, run: str, overrides: Sequence[str]) -> None:
    """Adapt a finished run to the skin of a configuration: log a new run and print the figures.

    Nothing is done if a run with the same fingerprint has finished, unless ``tracking.resume=false``.

    Args:
        config: of ``skin adapt``.
        run: name of the run.
        overrides: of the command line.

    Raises:
        InputError: the run is no network or does not fit the skin, the gestures have no labels, or there are
            fewer than wanted.
    """
    with Steps(_STEPS) as steps:
        _adapt(config, run, overrides, steps)


def _adapt(config: Config, name: str, overrides: Sequence[str], steps: Steps) -> None:
    settings = configured(FineTuning, config.adapt, "adapt")
    options = _scratch_options(settings.scratch)
    if config.tracking.threads:
        torch.set_num_threads(config.tracking.threads)
    parent = FinishedRun.named(name, config)
    target = find_target(parent, config, settings, overrides)
    identity = tags(target.config) | {ADAPTED: parent.identity, "target": " ".join(overrides)}
    if config.tracking.resume and (
        earlier := Store.existing(config.tracking).find("FINISHED", fingerprint=identity["fingerprint"])
    ):
        note_reuse(earlier[0])
        print(f"run {earlier[0].info.run_id} did this before: tracking.resume=false repeats it")
        return
    task, evaluation = target.twin.task, check_evaluation(target.config.evaluation)
    learner, data = build_learner(target.config), build_data(target.config, target.device.blank())
    parent.load_weights(learner, data)
    network = learner.network  # refuses another learner before gestures are read from a port
    steps.begin("reading or simulating the gestures")
    if target.device.real:
        steps.stop()  # a person may be prompted
    touches, others = choose_gestures(target.device, settings)
    steps.start()
    steps.begin("choosing the threshold of the alarm")
    source = replace(alarm_source(parent, learner, target.config), device=target.twin)
    point = choose_alarm_threshold(source, one_skin=True)
    figures: dict[str, float] = {}
    if others is not None:
        tests = others.touches("test")
        figures = _figures("before", learner.probabilities(tests), tests, task, point)
    name = f"{target.config.row} {identity['simulator']} {len(touches)} gestures seed {settings.seed}"
    store = Store.open(config.tracking)
    with store.run(name, identity, parent.identity) as run:
        steps.begin("fine-tuning")
        adaptation = fine_tune(network, data, touches, settings)
        scratch = learn_from_scratch(touches, task, adaptation, settings, options)
        after = adaptation.after if adaptation.better else adaptation.before
        chosen, choice = target.config, adaptation.choice
        if scratch is not None:
            learner, after, choice = scratch.learner, scratch.chances, f"{scratch.name}, from scratch"
            chosen = replace(chosen, learner=scratch.settings)
        log_configuration(store, run.info.run_id, chosen, touches_hash(touches))
        log_learner(store, run, learner)
        steps.begin("evaluating the result")
        if choice and point is not None:
            point = choose_alarm_threshold(replace(source, learner=learner), anew=True)
        figures |= _figures("validation_before", adaptation.before, touches, task)
        figures |= _figures("validation", after, touches, task)
        if others is None:
            store.client.set_tag(run.info.run_id, TAG, "null" if point is None else point.text())
            store.log_metrics(run, figures)
        else:
            report = evaluate(learner, others, evaluation, point)
            log_report(store, run, report, task, figures)
            figures |= {key: value for key, value in report.metrics.items() if key.startswith("same/")}
        store.client.log_text(run.info.run_id, _table(adaptation.trials), "adapt.csv")
        store.client.set_tag(run.info.run_id, "chosen", choice)
    Console().print(metrics_table(figures, f"{name}, run {run.info.run_id}"))
    _say(choice, parent, others is not None)


def _say(choice: str, parent: FinishedRun, reported: bool) -> None:
    """Print what the figures mean, and which model was kept."""
    meaning = "validation: the gestures to adapt on, each predicted by a model that was not trained on it"
    print(meaning, "; before, same: other gestures of the skin" if reported else "", sep="")
    unchanged = "nothing is better on held-out gestures: the new run keeps the weights of run "
    print(f"chosen: {choice}" if choice else f"{unchanged}{parent.identity}")


def _figures(
    column: str, chances: Tensor, touches: Touches, task: Task, point: OperatingPoint | None = None
) -> dict[str, float]:
    """Return the metrics of predictions (B, L) of gestures, as ``column/name``."""
    figures = compute_metrics(chances, touches.known_labels, task, point)
    return {f"{column}/{name}": value for name, value in figures.items()}


def _table(trials: Sequence[Trial]) -> str:
    """Return the held-out loss of each trial and epoch as CSV."""
    rows = [
        f"{trial.layers},{trial.lr:g},{epoch},{loss:.6f}"
        for trial in trials
        for epoch, loss in enumerate(trial.losses)
    ]
    return "\n".join(["layers,lr,epoch,loss", *rows, ""])
