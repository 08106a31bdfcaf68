"""The LightningModule of every network: loss, metrics, optimizer."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.lr_scheduler import OneCycleLR

from skin.device.touches import Touches
from skin.learning.fusion import AbstractFusion
from skin.learning.model import make_activation
from skin.learning.representation import AbstractRepresentation, Frames
from skin.touch.labels import Task

Batch = tuple[Frames, Tensor]
MakeOptimizer = Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer]


def probabilities(logits: Tensor, task: Task) -> Tensor:
    """Return the probability of each label, (B, L), from logits (B, L); of a direction the mean cosines."""
    if task.kind == "exclusive":
        return logits.softmax(dim=-1)
    chances = logits.sigmoid()
    return torch.cat([chances[:, :-2], 2 * chances[:, -2:] - 1], dim=1) if task.direction else chances


class TouchClassifier(pl.LightningModule):
    """Classifies windows by dense layers on their embedding.

    Logs ``{train,val}_loss``, ``{train,val}_accuracy`` and, of binary tasks, ``{train,val}_accuracy_<label>``
    per epoch. Labels that are undefined, because the task's gate is 0 or a touch has no direction, are left
    out of both.

    Numbers about the whole window, if the representation has them (``Frames.summary``), are encoded by two
    dense layers and concatenated to the embedding.

    Args:
        fusion: computes the embedding (B, E) of frames.
        task: its length is the number of logits, its kind determines the loss.
        hidden: widths of the dense layers before the last one.
        activation: relu, elu or silu, after each of them.
        optimizer: partial; takes the parameters.
        warmup: share of the steps in which the learning rate rises to the optimizer's; it then falls to
            nothing along a cosine (Smith and Topin, 2018). None keeps it constant.
        dropout: share of the embedding and of the first dense layer that is dropped in training.
        summary: number of numbers about the whole window.
    """

    def __init__(
        self,
        fusion: AbstractFusion,
        task: Task,
        hidden: Sequence[int],
        activation: str,
        optimizer: MakeOptimizer,
        warmup: float | None = None,
        dropout: float = 0.0,
        summary: int = 0,
    ) -> None:
        super().__init__()
        self.fusion = fusion
        self.summary = _Summary(summary, fusion.width, activation) if summary else None
        widths = [fusion.width * (2 if summary else 1), *hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            # Without dropout there is no layer, so that older weights keep their names.
            dropped = [nn.Dropout(dropout)] if dropout else []
            layers += [*dropped, nn.Linear(before, after), make_activation(activation)]
        self.head = nn.Sequential(*layers, nn.Linear(widths[-1], len(task)))
        self.task = task
        self._make_optimizer, self._warmup = optimizer, warmup
        self._batches: dict[str, list[tuple[int, dict[str, Tensor]]]] = {"train": [], "val": []}

    def forward(self, frames: Frames) -> Tensor:
        """Return the logits (B, L) of frames."""
        return self.head(self.embed(frames))

    def embed(self, frames: Frames) -> Tensor:
        """Return the input of the dense layers: the embedding (B, E), with that of the summary if any."""
        embedding = self.fusion(frames)
        if self.summary is None:
            return embedding
        return torch.cat([embedding, self.summary(frames.summary)], dim=1)

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        """Return the mean loss of logits (B, L) given labels (B, L), 0 or 1, or the cosines of a direction.

        The mean is over the labels that are known and, where the task has a gate (report, 4.2) or a
        direction, defined: without touch, only the gate itself has a loss and a gradient.
        """
        counts = self.task.counts(labels)
        if not counts.any():
            return 0.0 * logits.sum()
        if self.task.kind == "exclusive":
            return F.cross_entropy(logits[counts[:, 0]], labels[counts[:, 0]])
        if counts.all():
            return F.binary_cross_entropy_with_logits(logits, self.task.shares(labels))
        return F.binary_cross_entropy_with_logits(logits[counts], self.task.shares(labels)[counts])

    def _step(self, batch: Batch, stage: str) -> Tensor:
        frames, labels = batch
        logits = self(frames)
        loss = self.loss(logits, labels)
        values = {"loss": loss.detach()} | self._accuracy(logits.detach(), labels)
        self._batches[stage].append((len(labels), values))
        return loss

    def _log(self, stage: str) -> None:
        """Log the means over an epoch: Lightning's own means take longer than the step of a small network."""
        batches, self._batches[stage] = self._batches[stage], []
        count = sum(size for size, _ in batches)
        for name in batches[0][1]:
            mean = sum(size * values[name] for size, values in batches) / count
            self.log(f"{stage}_{name}", mean, sync_dist=True)  # the mean over processes that train together

    def _accuracy(self, logits: Tensor, labels: Tensor) -> dict[str, Tensor]:
        counts = self.task.counts(labels)
        if self.task.kind == "exclusive":
            right = (logits.argmax(dim=-1) == labels.argmax(dim=-1)) & counts[:, 0]
            return {"accuracy": right.sum() / counts[:, 0].sum().clamp(min=1)}
        right = ((logits > 0) == (labels > 0.5)) & counts
        shares = right.sum(dim=0) / counts.sum(dim=0).clamp(min=1)
        label_shares = dict(zip(self.task.binary, shares, strict=False))
        overall = torch.stack([label_shares[name] for name in self.task.gated]).mean()
        return {"accuracy": overall} | {f"accuracy_{name}": share for name, share in label_shares.items()}

    def training_step(self, batch: Batch, index: int) -> Tensor:
        """Return the loss of one batch."""
        return self._step(batch, "train")

    def validation_step(self, batch: Batch, index: int) -> None:
        """Keep the loss and the accuracy of one batch."""
        self._step(batch, "val")

    def on_train_epoch_end(self) -> None:
        """Log the loss and the accuracy of the epoch."""
        self._log("train")

    def on_validation_epoch_end(self) -> None:
        """Log the loss and the accuracy on the validation split."""
        self._log("val")

    def configure_optimizers(self) -> Any:
        """Return the optimizer over all parameters, and how its learning rate changes from step to step."""
        optimizer = self._make_optimizer(self.parameters())
        if self._warmup is None:
            return optimizer
        steps = int(self.trainer.estimated_stepping_batches)
        rate = optimizer.defaults["lr"]
        schedule = OneCycleLR(optimizer, rate, steps, pct_start=self._warmup, cycle_momentum=False)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class _Standardised(nn.BatchNorm1d):
    """Batch norm that accepts a batch of one touch, for which it uses its running statistics.

    Its statistics are plain means over all batches: a moving average would begin at a variance of 1, which of
    numbers in metres is wrong for a thousand batches.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return x (B, D) with mean 0 and deviation 1 in each column."""
        if self.training and len(x) == 1:
            return F.batch_norm(x, self.running_mean, self.running_var, eps=self.eps)
        return super().forward(x)


class _Summary(nn.Module):
    """Two dense layers on numbers of any unit, each standardised first."""

    def __init__(self, numbers: int, width: int, activation: str) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            _Standardised(numbers, affine=False, momentum=None),
            nn.Linear(numbers, width),
            make_activation(activation),
            nn.Linear(width, width),
            make_activation(activation),
        )

    def forward(self, summary: Tensor | None) -> Tensor:
        """Return (B, width) of numbers (B, D)."""
        if summary is None:
            raise ValueError("the classifier was built for frames with a summary, got frames without")
        return self.layers(summary)


# Callbacks of a training: its duration, and what continues an interrupted one.


class Clock(Callback):
    """Measures the training part of every epoch, from its start to the end of its last batch.

    Args:
        path: of a file that keeps the durations; the process that trains may be another one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seconds: list[float] = []
        self._began = 0.0

    def median(self) -> float:
        """Return the median duration of an epoch after the training, s; validation is left out."""
        # A continued training that was complete runs no epoch: then the checkpoint alone knows.
        return median(self._seconds or json.loads(self._path.read_text()))

    def on_train_epoch_start(self, *_: Any) -> None:
        """Start an epoch."""
        self._began = time.perf_counter()
        self._seconds.append(0.0)

    def on_train_batch_end(self, *_: Any) -> None:
        """Note the time so far."""
        self._seconds[-1] = time.perf_counter() - self._began

    def on_train_end(self, trainer: Trainer, *_: Any) -> None:
        """Keep the durations."""
        if trainer.is_global_zero:
            self._path.write_text(json.dumps(self._seconds))

    def state_dict(self) -> dict[str, list[float]]:
        """Return the durations, for a checkpoint."""
        return {"seconds": self._seconds}

    def load_state_dict(self, state_dict: dict[str, list[float]]) -> None:
        """Take the durations of a checkpoint."""
        self._seconds = state_dict["seconds"]


class RandomState(Callback):
    """Keeps torch's random state in checkpoints: a continued training drops out the same units."""

    def __init__(self) -> None:
        self._state: Tensor | None = None

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state, for a checkpoint."""
        return {"state": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Take the state of a checkpoint."""
        self._state = state_dict["state"]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the state, after the last use of random numbers by the start itself."""
        if self._state is not None:
            torch.set_rng_state(self._state)


# Trained networks as one torch module from readings to probabilities.


class Pipeline(nn.Module):
    """The representation of one layout and a classifier.

    Args:
        representation: of the layout.
        classifier: trained.
        positions: (S, 3), m.
        geometry: (S, G) of the sensors (:data:`skin.device.touches.GEOMETRY`); None if not needed.
    """

    positions: Tensor
    geometry: Tensor | None

    def __init__(
        self,
        representation: AbstractRepresentation,
        classifier: "TouchClassifier",
        positions: Tensor,
        geometry: Tensor | None,
    ) -> None:
        super().__init__()
        self.representation, self.task = representation, classifier.task
        self.register_buffer("positions", positions)
        self.register_buffer("geometry", geometry)
        # Not the LightningModule itself, whose properties need a trainer.
        self.fusion, self.summary, self.head = classifier.fusion, classifier.summary, classifier.head

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""

        touches = Touches(readings, valid, self.positions, None, 1.0, geometry=self.geometry)
        frames = self.representation.show(touches)
        embedding = self.fusion(frames)
        if self.summary is not None:
            embedding = torch.cat([embedding, self.summary(frames.summary)], dim=1)
        return probabilities(self.head(embedding), self.task)


class Mean(nn.Module):
    """The mean of several pipelines."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""
        return torch.stack([member(readings, valid) for member in self.members]).mean(dim=0)
