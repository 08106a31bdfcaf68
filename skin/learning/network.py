"""Neural networks, trained by gradient descent."""

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import torch
from annotated_types import Ge, Le, Lt
from torch import Tensor, nn

from skin.core.messages import PARENT, one_line
from skin.core.safe_loading import check_archive
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.fusion import AbstractFusion
from skin.learning.learner import AbstractLearner
from skin.learning.representation import Frames

if TYPE_CHECKING:
    from pytorch_lightning import Callback, Trainer
    from pytorch_lightning.loggers import Logger

    from skin.learning.classifier import TouchClassifier
    from skin.learning.data import TouchData

LAST = "last.ckpt"
"""Name of the checkpoint that continues an unfinished training."""
CHUNK = 64  # touches at a time when predicting: fastest, and bounds memory to a few hundred MB


class Network(AbstractLearner):
    """Trains ``fusion(model)`` on frames and keeps the weights with the lowest validation loss.

    Args:
        model: without kind and shape.
        fusion: without model, kind, shape and window.
        optimizer: without the parameters.
        trainer: settings of pytorch_lightning.Trainer: max_epochs, accelerator, ...
        hidden: widths of the dense layers between embedding and labels.
        activation: relu, elu or silu, after each of them.
        warmup: share of the training in which the learning rate rises to that of the optimizer; it then
            decays to 0 along a cosine. None: constant.
        dropout: probability of dropout for the embedding and the dense layers.
        seed: of weights and dropout only; the global random state does not change.
    """

    def __init__(
        self,
        model: Callable[..., Any],
        fusion: Callable[..., AbstractFusion],
        optimizer: Callable[..., Any],
        trainer: dict[str, Any],
        hidden: Sequence[Annotated[int, Ge(1)]] = (32,),
        activation: str = "relu",
        warmup: Annotated[float, Ge(0), Le(1)] | None = None,
        dropout: Annotated[float, Ge(0), Lt(1)] = 0.0,
        seed: int = 0,
    ) -> None:
        self._fusion = partial(fusion, model)
        self._optimizer, self._trainer = optimizer, dict(trainer)
        self._hidden, self._activation, self._seed = hidden, activation, seed
        self._warmup, self._dropout = None if warmup is None else float(warmup), dropout
        self._data: TouchData | None = None
        self._classifier: TouchClassifier | None = None

    def check(self, data: "TouchData") -> None:
        """Build network, optimizer and trainer once, so that errors in the settings are reported early."""
        with torch.random.fork_rng():
            network = self.build(data)
        self._trainer_of(None, [])
        settings = self._optimizer.keywords if isinstance(self._optimizer, partial) else {}
        if text := [name for name, value in settings.items() if isinstance(value, str)]:
            raise InputError(f"optimizer.{text[0]}={settings[text[0]]} is text, and must be a number")
        try:
            self._optimizer(network.parameters())
        except (TypeError, ValueError) as error:
            raise InputError(f"the optimizer refuses its settings: {error}") from error

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Train on the training split; the validation loss chooses the epoch.

        With several processes, only the first has the trained weights; they continue no earlier training.

        Raises:
            InputError: the choices do not fit each other or the data.
        """
        from pytorch_lightning.callbacks import ModelCheckpoint

        from skin.learning.classifier import Clock, RandomState

        with torch.random.fork_rng(), self._folder() as folder:
            torch.manual_seed(self._seed)
            classifier = self.build(data)
            best = ModelCheckpoint(folder, monitor="val_loss", save_weights_only=True)
            clock, last = Clock(folder / "seconds.json"), folder / LAST
            trainer = self._trainer_of(logger, [best, clock], folder)
            alone = trainer.world_size == 1
            if self.unfinished and alone:
                # Behind `best`, whose state it saves; several processes would have to save together.
                every = ModelCheckpoint(folder, last.stem, enable_version_counter=False)
                trainer.callbacks += [RandomState(), every]  # type: ignore[attr-defined]
            again = last if alone and last.is_file() else None
            with warnings.catch_warnings():
                # Lightning 2.6 asks torch 2.13 for a deprecated class
                warnings.filterwarnings("ignore", ".*treespec, LeafSpec", FutureWarning)
                trainer.fit(classifier, datamodule=data, ckpt_path=again, weights_only=True)
            if not trainer.is_global_zero:
                return
            weights = torch.load(best.best_model_path, weights_only=True, map_location="cpu")
            classifier.load_state_dict(weights["state_dict"])
            self.seconds_per_epoch = clock.median()

    @contextmanager
    def _folder(self) -> Iterator[Path]:
        """Yield the folder for checkpoints: the one that outlives this process, or a temporary one."""
        if self.unfinished:
            yield self.unfinished
            return
        with TemporaryDirectory() as folder:
            yield Path(folder)

    def _trainer_of(
        self, logger: "Logger | None", callbacks: "list[Callback]", folder: Path | None = None
    ) -> "Trainer":
        """Return Lightning's trainer; callbacks and loggers of its settings join ours.

        Raises:
            InputError: settings that it does not take.
        """
        from pytorch_lightning import Trainer
        from pytorch_lightning.utilities.exceptions import MisconfigurationException

        settings = {"enable_progress_bar": False, "num_sanity_val_steps": 0} | self._trainer
        epochs, theirs = settings.get("max_epochs"), settings.pop("logger", None)
        if type(epochs) is not int or epochs < 1:
            raise InputError(f"trainer.max_epochs={epochs} must be a whole number from 1 up")
        loggers = [
            candidate
            for candidate in (logger, *(theirs if isinstance(theirs, list) else [theirs]))
            if candidate
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

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout that the model accepts."""
        from skin.learning.classifier import probabilities

        return self._map(
            touches, lambda classifier, frames: probabilities(classifier(frames), classifier.task)
        )

    def embeddings(self, touches: Touches) -> Tensor:
        """Return the embeddings of touches, (B, E), which are the input of the dense layers."""
        return self._map(touches, lambda classifier, frames: classifier.fusion(frames))

    @property
    def network(self) -> "TouchClassifier":
        """The trained network.

        Raises:
            RuntimeError: before ``fit`` or ``load``.
        """
        if self._classifier is None:
            raise RuntimeError("fit or load the learner first")
        return self._classifier

    def pipeline(self, positions: Tensor) -> nn.Module:
        """Return representation and network as one module, in evaluation mode."""
        from skin.learning.classifier import Pipeline

        if self._classifier is None or self._data is None:
            raise RuntimeError("fit or load the learner first")
        data = self._data
        pipeline = Pipeline(data.representation_for(positions), self._classifier, positions, data.geometry)
        return pipeline.cpu().eval()

    def _map(self, touches: Touches, function: "Callable[[TouchClassifier, Frames], Tensor]") -> Tensor:
        """Return a function of the classifier and frames, (B, ...), computed in chunks."""
        classifier = self.network.eval()
        assert self._data is not None
        parts = []
        with torch.inference_mode():
            for start in range(0, len(touches), CHUNK):
                part = touches[start : start + CHUNK].to(classifier.device)
                parts.append(function(classifier, self._data.show(part)).cpu())
        return torch.cat(parts)

    def save(self, folder: Path) -> Path:
        """Write the weights to ``weights.pt`` in ``folder`` and return its path."""
        path = Path(folder) / "weights.pt"
        torch.save(self.network.state_dict(), path)
        return path

    def load(self, data: "TouchData", path: Path) -> None:
        """Load the weights that :meth:`save` wrote; ``data`` gives the shapes as in :meth:`fit`."""
        check_archive(path)
        self.build(data).load_state_dict(torch.load(path, weights_only=True, map_location="cpu"))

    def build(self, data: "TouchData") -> "TouchClassifier":
        """Return the untrained network for the frames of ``data``, drawn from torch's random state.

        Raises:
            InputError: the choices do not fit each other or the data.
        """
        from skin.learning.classifier import TouchClassifier

        frames, _ = data.frames(data.example)
        kind = data.representation_for(data.example.positions).kind
        fusion = self._fusion(kind, tuple(frames.x.shape[2:]), frames.x.shape[1])
        classifier = TouchClassifier(
            fusion,
            data.task,
            self._hidden,
            self._activation,
            self._optimizer,
            self._warmup,
            self._dropout,
            0 if frames.summary is None else frames.summary.shape[1],
        )
        self._data, self._classifier = data, classifier
        self.parameters = sum(p.numel() for p in classifier.parameters() if p.requires_grad)
        return classifier


def _check(trainer: "Trainer") -> None:
    """Check for settings that Lightning accepts and this program does not support.

    Raises:
        InputError: an unsupported setting.
    """
    from pytorch_lightning.strategies.launchers import _MultiProcessingLauncher, _SubprocessScriptLauncher

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
