"""Fine-tune a network on few gestures of another skin."""

import sys
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, product
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le, MinLen
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from skin.classifier import TouchClassifier, probabilities
from skin.datamodule import TouchData
from skin.evaluation.metrics import compute_metrics
from skin.recording import Touches
from skin.settings import checked

LEAST = 8
"""Smallest number of gestures to fine-tune on."""

_CLIP = 1.0  # largest norm of the gradient
_CHUNK = 64  # gestures at a time when predicting
_CLEAR = 2.0  # standard errors

Layers = Literal["head", "all"]


@checked("adapt")
@dataclass(frozen=True, kw_only=True)
class FineTuning:
    """Settings of a fine-tuning.

    Attributes:
        gestures: number of gestures to fine-tune on; None: all of a recording, 48 of a simulated device.
        folds: number of parts of the gestures. Each part is held out once.
        layers: to try: ``head`` (the dense layers behind the embedding) or ``all``.
        lr: learning rates to try.
        epochs: largest number.
        patience: number of epochs without a lower held-out loss after which a trial ends.
        batch_size: gestures per step.
        seed: of gestures, their order, folds and dropout.

    Raises:
        InputError: invalid settings.
    """

    gestures: Annotated[int, Ge(LEAST)] | None = None
    folds: Annotated[int, Ge(2), Le(LEAST)] = 4
    layers: Annotated[Sequence[Layers], MinLen(1)] = ("head", "all")
    lr: Annotated[Sequence[PositiveFloat], MinLen(1)] = (1e-4, 5e-4)
    epochs: PositiveInt = 60
    patience: PositiveInt = 10
    batch_size: PositiveInt = 32
    seed: NonNegativeInt = 0


@dataclass(frozen=True)
class Trial:
    """The result of one choice of layers and learning rate.

    Attributes:
        layers, lr: the choice.
        losses: held-out loss before the training and after each epoch.
        logits: (E, B, L), held-out, before the training and after each epoch.
    """

    layers: Layers
    lr: float
    losses: list[float]
    logits: Tensor

    @property
    def epochs(self) -> int:
        """Number of epochs with the lowest loss; 0: the original network."""
        return _lowest(self.losses)


@dataclass(frozen=True)
class Adaptation:
    """The result of a fine-tuning.

    Attributes:
        trials: all choices.
        chosen: the one with the lowest held-out loss.
        before: probabilities (B, L) of the gestures from the original network.
        after: probabilities (B, L) of each gesture from a network that was not trained on it, with settings
            that were not chosen on it.
        better: whether ``after`` is better than ``before``. If not, the network is not changed.
    """

    trials: list[Trial]
    chosen: Trial
    before: Tensor
    after: Tensor
    better: bool

    @property
    def choice(self) -> str:
        """The settings with which the network was trained; empty if it was not changed."""
        trial = self.chosen
        return f"layers={trial.layers} lr={trial.lr:g} epochs={trial.epochs}" if self.better else ""


def fine_tune(
    network: TouchClassifier, data: TouchData, touches: Touches, settings: FineTuning
) -> Adaptation:
    """Fine-tune a network, in place, if that is better on held-out gestures.

    The gestures are split into folds with equal shares of each combination of labels. For each choice of
    layers and learning rate, and each fold, a copy of the network is trained on the other folds. Its loss on
    the fold is measured after each epoch. The choice and the number of epochs with the lowest mean loss are
    then used to train on all gestures.

    The lowest of many losses is too low by chance. So the result is judged on each fold with the choice that
    has the lowest loss on the other folds. The network is changed only if this loss is lower than that of
    the original network by more than two standard errors of the difference, and the accuracy is not lower.

    Args:
        network: trained.
        data: representation and augmentation of the touches.
        touches: B labelled gestures, at least one per fold.
        settings: of the fine-tuning.

    Raises:
        InputError: gestures without labels.
    """
    labels = touches.known_labels
    problem = _Problem(network, data, touches, settings)
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        first = problem.logits(network.eval(), touches)
        trials = [problem.attempt(first, *choice) for choice in product(settings.layers, settings.lr)]
        chosen = min(trials, key=lambda trial: min(trial.losses))
        last = problem.judged(trials)
        before, after = (probabilities(logits, network.task) for logits in (first, last))
        better = chosen.epochs > 0 and _is_better(network, first, last, labels)
        if better:
            steps = problem.epochs(touches, chosen.layers, chosen.lr, settings.folds)
            trained = next(islice(steps, chosen.epochs - 1, None))
            network.load_state_dict(trained.state_dict())
    return Adaptation(trials, chosen, before, after, better)


def split_folds(labels: Tensor, count: int, seed: int) -> Tensor:
    """Return the fold of each gesture, (B,), from 0 up.

    Folds differ by at most one in size, and in the number of gestures with each combination of labels.

    Args:
        labels: (B, L).
        count: number of folds.
        seed: of the order in which the gestures are dealt out.
    """
    order = torch.randperm(len(labels), generator=torch.Generator().manual_seed(seed))
    combination = torch.unique(labels > 0.5, dim=0, return_inverse=True)[1]
    order = order[combination[order].argsort(stable=True)]
    folds = torch.empty_like(order)
    folds[order] = torch.arange(len(order)) % count
    return folds


@dataclass(frozen=True)
class _Problem:
    """The arguments of :func:`fine_tune`."""

    network: TouchClassifier
    data: TouchData
    touches: Touches
    settings: FineTuning

    @cached_property
    def folds(self) -> Tensor:
        """The fold of each gesture, (B,)."""
        return split_folds(self.touches.known_labels, self.settings.folds, self.settings.seed)

    def attempt(self, first: Tensor, layers: Layers, lr: float) -> Trial:
        """Train on all folds but one, for each, epoch by epoch, until the held-out loss rises.

        Args:
            first: logits (B, L) of the original network.
            layers: to train.
            lr: learning rate.
        """
        settings, touches, labels = self.settings, self.touches, self.touches.known_labels
        rest = [(self.folds != fold).nonzero().flatten() for fold in range(settings.folds)]
        runs = [self.epochs(touches[rows], layers, lr, fold) for fold, rows in enumerate(rest)]
        losses, logits = [float(self.network.loss(first, labels))], [first]
        while len(losses) <= settings.epochs and len(losses) - _lowest(losses) <= settings.patience:
            found = torch.empty_like(first)
            for fold, run in enumerate(runs):
                rows = (self.folds == fold).nonzero().flatten()
                found[rows] = self.logits(next(run), touches[rows])
            losses.append(float(self.network.loss(found, labels)))
            logits.append(found)
        said = f"layers={layers} lr={lr:g}: held-out loss {losses[0]:.4f} before, {min(losses):.4f} after"
        print(f"{said} {_lowest(losses)} epochs", file=sys.stderr, flush=True)
        return Trial(layers, lr, losses, torch.stack(logits))

    def judged(self, trials: Sequence[Trial]) -> Tensor:
        """Return the logits (B, L) of each fold, of the choice with the lowest loss on the other folds."""
        labels, found = self.touches.known_labels, torch.empty_like(trials[0].logits[0])
        candidates = torch.cat([trial.logits for trial in trials])
        for fold in range(self.settings.folds):
            held = self.folds == fold
            losses = [float(self.network.loss(logits[~held], labels[~held])) for logits in candidates]
            found[held] = candidates[_lowest(losses)][held]
        return found

    def epochs(self, touches: Touches, layers: Layers, lr: float, number: int) -> Iterator[TouchClassifier]:
        """Yield a copy of the network after each epoch; ``number`` selects the order of the gestures."""
        network = deepcopy(self.network).requires_grad_(False)
        trained = network.head if layers == "head" else network
        parameters = list(trained.requires_grad_(True).parameters())
        optimizer = torch.optim.Adam(parameters, lr)
        generator = torch.Generator().manual_seed(1000 * self.settings.seed + number)
        augmentation = self.data.augmentation
        while True:
            _train_mode(network)
            for rows in torch.randperm(len(touches), generator=generator).split(self.settings.batch_size):
                batch = touches[rows]
                frames, labels = self.data.frames(augmentation(batch, generator) if augmentation else batch)
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


def _train_mode(network: nn.Module) -> None:
    """Turn dropout on; batch norms keep their statistics, which few gestures of one skin would spoil."""
    network.train()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.eval()


def _lowest(losses: Sequence[float]) -> int:
    """Return the place of the lowest loss, the first of equal ones."""
    return min(range(len(losses)), key=losses.__getitem__)


def _is_better(network: TouchClassifier, first: Tensor, last: Tensor, labels: Tensor) -> bool:
    """Return whether the loss is lower by more than two standard errors, and the accuracy is not lower."""
    one, other = (
        torch.stack(
            [network.loss(logits[row : row + 1], labels[row : row + 1]) for row in range(len(labels))]
        )
        for logits in (first, last)
    )
    gain = one - other
    error = gain.std() / len(gain) ** 0.5
    before, after = (
        compute_metrics(probabilities(logits, network.task), labels, network.task)["overall/accuracy"]
        for logits in (first, last)
    )
    return bool(gain.mean() > _CLEAR * error) and after >= before
