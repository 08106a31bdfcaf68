"""Training of a network with Lightning, and the callbacks that measure and continue it.

Only what trains imports this module, because Lightning takes seconds to import.
"""

import json
import math
import os
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.loggers import Logger
from pytorch_lightning.strategies.launchers import _MultiProcessingLauncher, _SubprocessScriptLauncher
from pytorch_lightning.utilities.exceptions import MisconfigurationException
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR

from skin.core.messages import PARENT, one_line
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import Batch, TouchData
from skin.learning.network import LAST, MakeOptimizer, TouchClassifier


class Training(LightningModule):
    """Trains a network.

    Logs ``{train,val}_loss``, ``{train,val}_accuracy`` and, of binary tasks, ``{train,val}_accuracy_<label>``
    per epoch.

    Args:
        network: what is trained, in place.
        data: gives the batches, and their frames where the network is.
        optimizer: partial; takes the parameters.
        warmup: fraction of the steps in which the learning rate rises to the optimizer's; it then falls to
            nothing along a cosine (Smith and Topin, 2018). None keeps it constant.
    """

    def __init__(
        self,
        network: TouchClassifier,
        data: TouchData,
        optimizer: MakeOptimizer,
        warmup: float | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        self._data, self._make_optimizer, self._warmup = data, optimizer, warmup
        self._batches: dict[str, list[tuple[int, dict[str, Tensor]]]] = {"train": [], "val": []}

    def on_after_batch_transfer(self, batch: Touches | Batch, dataloader_idx: int) -> Batch:
        """Return the frames and labels of a batch that has arrived where the network is."""
        return self._data.frames(batch) if isinstance(batch, Touches) else batch

    def _step(self, batch: Batch, stage: str) -> Tensor:
        """Return the loss of one batch, and keep it with the accuracy.

        Raises:
            InputError: it is not a number.
        """
        frames, labels = batch
        logits = self.network(frames)
        loss = self.network.loss(logits, labels)
        if not loss.isfinite():
            raise InputError(f"the loss is {loss:g}: lower optimizer.lr, or correct the model")
        values = {"loss": loss.detach()} | self.network.accuracy(logits.detach(), labels)
        self._batches[stage].append((len(labels), values))
        return loss

    def _log(self, stage: str) -> None:
        """Log the means over an epoch: Lightning's own means take longer than the step of a small network."""
        batches, self._batches[stage] = self._batches[stage], []
        count = sum(size for size, _ in batches)
        for name in batches[0][1]:
            mean = sum(size * values[name] for size, values in batches) / count
            self.log(f"{stage}_{name}", mean, sync_dist=True)  # the mean over processes that train together

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
        optimizer = self._make_optimizer(self.network.parameters())
        if self._warmup is None:
            return optimizer
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = OneCycleLR(
            optimizer, optimizer.defaults["lr"], steps, pct_start=self._warmup, cycle_momentum=False
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def train_network(
    training: Training,
    data: TouchData,
    settings: dict[str, Any],
    logger: Logger | None,
    folder: Path,
    resumable: bool,
) -> float:
    """Train a network and give it the weights of the lowest validation loss.

    Args:
        training: of the network.
        data: of the training.
        settings: of Lightning's trainer.
        logger: of the metrics; None: they are not logged.
        folder: for checkpoints; a training that was interrupted in it is continued.
        resumable: write the checkpoints that continue this training.

    Returns:
        The median duration of an epoch, s; NaN in a process that joins the training of the first one, and
        has no trained weights.

    Raises:
        InputError: the trainer refuses its settings, or the loss is not a number.
    """
    best = ModelCheckpoint(folder, monitor="val_loss", save_weights_only=True)
    progress, last = Progress(folder / "seconds.json"), folder / LAST
    trainer = make_trainer(settings, logger, [best, progress], folder)
    alone = trainer.world_size == 1
    if resumable and alone:
        # Behind `best`, whose state it saves; several processes would have to save together.
        every = ModelCheckpoint(folder, last.stem, enable_version_counter=False)
        trainer.callbacks.append(every)  # type: ignore[attr-defined]
    begun = last if alone and last.is_file() else None
    data.trainer = trainer  # for its epoch and its processes
    with warnings.catch_warnings():
        # Lightning 2.6 asks torch 2.13 for a deprecated class
        warnings.filterwarnings("ignore", ".*treespec, LeafSpec", FutureWarning)
        loaders = data.train_dataloader(), data.val_dataloader()
        trainer.fit(training, *loaders, ckpt_path=begun, weights_only=True)
    data.trainer = None
    if not trainer.is_global_zero:
        return math.nan
    checkpoint = torch.load(best.best_model_path, weights_only=True, map_location="cpu")
    training.load_state_dict(checkpoint["state_dict"])
    return progress.median()


def make_trainer(
    chosen: dict[str, Any],
    logger: Logger | None = None,
    callbacks: Sequence[Callback] = (),
    folder: Path | None = None,
) -> Trainer:
    """Return Lightning's trainer; callbacks and loggers of its settings join ours.

    Raises:
        InputError: settings that it does not take.
    """
    settings = {"enable_progress_bar": False, "num_sanity_val_steps": 0} | chosen
    epochs, theirs = settings.get("max_epochs"), settings.pop("logger", None)
    if type(epochs) is not int or epochs < 1:
        raise InputError(f"trainer.max_epochs={epochs} must be a whole number from 1 up")
    loggers = [
        candidate for candidate in (logger, *(theirs if isinstance(theirs, list) else [theirs])) if candidate
    ]
    try:
        trainer = Trainer(
            **settings | {"callbacks": [*callbacks, *(settings.get("callbacks") or [])]},
            logger=loggers or False,
            enable_model_summary=False,
            default_root_dir=folder,
        )
    except (TypeError, ValueError, MisconfigurationException) as error:
        raise InputError(f"pytorch_lightning.Trainer refuses trainer: {one_line(error)}") from error
    _check(trainer)
    return trainer


def _check(trainer: Trainer) -> None:
    """Check for settings that Lightning accepts and this program does not support.

    Raises:
        InputError: an unsupported setting.
    """
    launcher = trainer.strategy.launcher
    if isinstance(launcher, _SubprocessScriptLauncher) and PARENT in os.environ:
        raise InputError(
            f"trainer.devices={trainer.num_devices} would start a whole sweep again for each process: add "
            "trainer.strategy=ddp_spawn"
        )
    if isinstance(launcher, _MultiProcessingLauncher) and launcher.is_interactive_compatible:
        raise InputError(
            "trainer.strategy starts processes as forks, which must not use the database of runs: give "
            "trainer.strategy=ddp or ddp_spawn"
        )
    if trainer.precision not in ("32-true", "16-mixed", "bf16-mixed"):
        raise InputError(
            f"trainer.precision={trainer.precision} would change the touches too: give 32-true, 16-mixed or "
            "bf16-mixed"
        )


class Progress(Callback):
    """Measures the training part of every epoch, from its start to the end of its last batch.

    Checkpoints also keep torch's random state: a continued training drops out the same units.

    Args:
        path: of a file that keeps the durations; the process that trains may be another one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seconds: list[float] = []
        self._state: Tensor | None = None

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

    def state_dict(self) -> dict[str, Any]:
        """Return the durations and the random state, for a checkpoint."""
        return {"seconds": self._seconds, "state": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the durations and the random state of a checkpoint."""
        self._seconds, self._state = state_dict["seconds"], state_dict["state"]

    def on_train_start(self, *_: Any) -> None:
        """Set the state, after the last use of random numbers by the start itself."""
        if self._state is not None:
            torch.set_rng_state(self._state)
