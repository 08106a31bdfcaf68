"""Networks: the module with its loss, and the learner that trains it (:mod:`skin.learning.training`)."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import torch
from annotated_types import Ge, Le, Lt
from torch import Tensor, nn
from torch.nn import functional as F

from skin.core.messages import one_line
from skin.core.safe_loading import check_archive
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.fusion import AbstractFusion
from skin.learning.learner import AbstractLearner
from skin.learning.model import Activation, dense_layers
from skin.learning.representation import AbstractRepresentation, Frames
from skin.touch.labels import Task

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

MakeOptimizer = Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer]


def probabilities(logits: Tensor, task: Task) -> Tensor:
    """Return the probability of each label, (B, L), from logits (B, L); of a direction the mean cosines.

    Of a regression the outputs are the targets.
    """
    if task.kind == "regression":
        return logits
    if task.kind == "exclusive":
        return logits.softmax(dim=-1)
    values = logits.sigmoid()
    return torch.cat([values[:, :-2], 2 * values[:, -2:] - 1], dim=1) if task.direction else values


class TouchClassifier(nn.Module):
    """Classifies windows by dense layers on their embedding.

    Labels that are undefined, because the task's gate is 0 or a touch has no direction, are left out of loss
    and accuracy. A regression has no accuracy, and its loss is the mean square error of targets that are
    scaled to a deviation of 1 over the training.

    Numbers about the whole window, if the representation has them (``Frames.summary``), are encoded by two
    dense layers and concatenated to the embedding.

    Args:
        fusion: computes the embedding (B, E) of frames.
        task: its length is the number of logits, its kind determines the loss.
        hidden: widths of the dense layers before the last one.
        activation: relu, elu or silu, after each of them.
        dropout: fraction of the embedding and of the first dense layer that is dropped in training.
        summary: number of numbers about the whole window.
    """

    def __init__(
        self,
        fusion: AbstractFusion,
        task: Task,
        hidden: Sequence[int],
        activation: Activation,
        dropout: float = 0.0,
        summary: int = 0,
    ) -> None:
        super().__init__()
        self.fusion = fusion
        self.summary = _Summary(summary, fusion.width, activation) if summary else None
        widths = [fusion.width * (2 if summary else 1), *hidden]
        layers = [*dense_layers(widths, activation, dropout), nn.Linear(widths[-1], len(task))]
        if task.kind == "regression":
            layers.append(_Targets(len(task)))
        self.head = nn.Sequential(*layers)
        self.task = task

    @property
    def targets(self) -> "_Targets":
        """The last layer of a regression."""
        return self.head[-1]  # type: ignore[return-value]

    def forward(self, frames: Frames) -> Tensor:
        """Return the logits (B, L) of frames; the targets of a regression."""
        embedding = self.fusion(frames)
        if self.summary is not None:
            embedding = torch.cat([embedding, self.summary(frames.summary)], dim=1)
        return self.head(embedding)

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        """Return the mean loss of logits (B, L) given labels (B, L), 0 or 1, or the cosines of a direction.

        The mean is over the labels that are known and, where the task has a gate (report, 4.2) or a
        direction, defined: without touch, only the gate itself has a loss and a gradient.
        """
        counts = self.task.counts(labels)
        if not counts.any():
            return 0.0 * logits.sum()
        if self.task.kind == "regression":
            return ((logits - labels) / self.targets.deviation)[counts].square().mean()
        if self.task.kind == "exclusive":
            return F.cross_entropy(logits[counts[:, 0]], labels[counts[:, 0]])
        if counts.all():
            return F.binary_cross_entropy_with_logits(logits, self.task.fractions(labels))
        return F.binary_cross_entropy_with_logits(logits[counts], self.task.fractions(labels)[counts])

    def accuracy(self, logits: Tensor, labels: Tensor) -> dict[str, Tensor]:
        """Return ``accuracy`` and, of binary tasks, ``accuracy_<label>`` of logits and labels (B, L)."""
        counts = self.task.counts(labels)
        if self.task.kind == "regression":
            return {}
        if self.task.kind == "exclusive":
            right = (logits.argmax(dim=-1) == labels.argmax(dim=-1)) & counts[:, 0]
            return {"accuracy": right.sum() / counts[:, 0].sum().clamp(min=1)}
        right = ((logits > 0) == (labels > 0.5)) & counts
        fractions = right.sum(dim=0) / counts.sum(dim=0).clamp(min=1)
        accuracies = dict(zip(self.task.binary, fractions, strict=False))
        overall = torch.stack([accuracies[name] for name in self.task.gated]).mean()
        return {"accuracy": overall} | {f"accuracy_{name}": value for name, value in accuracies.items()}


class _Targets(nn.Module):
    """Maps outputs of the size of 1 to targets in their units."""

    def __init__(self, targets: int) -> None:
        super().__init__()
        self.mean = nn.Buffer(torch.zeros(targets))
        self.deviation = nn.Buffer(torch.ones(targets))

    def forward(self, x: Tensor) -> Tensor:
        """Return targets (B, L) of outputs (B, L)."""
        return self.mean + self.deviation * x

    def scale(self, labels: Tensor) -> None:
        """Take mean and deviation of the known targets (B, L)."""
        for number, column in enumerate(labels.T):
            present = column[~column.isnan()]
            self.mean[number], self.deviation[number] = present.mean(), present.std(correction=0)


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

    def __init__(self, numbers: int, width: int, activation: Activation) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            _Standardised(numbers, affine=False, momentum=None),
            *dense_layers([numbers, width, width], activation),
        )

    def forward(self, summary: Tensor | None) -> Tensor:
        """Return (B, width) of numbers (B, D)."""
        if summary is None:
            raise ValueError("the classifier was built for frames with a summary, got frames without")
        return self.layers(summary)


# Trained networks as one torch module from readings to probabilities.


class Pipeline(nn.Module):
    """The representation of one layout and a classifier.

    Args:
        representation: of the layout.
        classifier: trained.
        positions: (S, 3), m.
        geometry: (S, G) of the sensors (:data:`skin.device.touches.GEOMETRY`); None if not needed.
    """

    def __init__(
        self,
        representation: AbstractRepresentation,
        classifier: TouchClassifier,
        positions: Tensor,
        geometry: Tensor | None,
    ) -> None:
        super().__init__()
        self.representation = representation
        self.positions = nn.Buffer(positions)
        self.geometry = None if geometry is None else nn.Buffer(geometry)
        self.classifier = classifier

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""

        touches = Touches(readings, valid, self.positions, None, 1.0, geometry=self.geometry)
        logits = self.classifier(self.representation.show(touches))
        return probabilities(logits, self.classifier.task)


LAST = "last.ckpt"
"""Name of the checkpoint that continues an unfinished training."""


def _load_weights(classifier: TouchClassifier, path: Path) -> None:
    check_archive(path)
    classifier.load_state_dict(torch.load(path, weights_only=True, map_location="cpu"))


class Network(AbstractLearner):
    """Trains ``fusion(model)`` on frames and keeps the weights with the lowest validation loss.

    Args:
        model: without kind and shape.
        fusion: without model, kind, shape and window.
        optimizer: without the parameters.
        trainer: settings of pytorch_lightning.Trainer: max_epochs, accelerator, ...
        hidden: widths of the dense layers between embedding and labels.
        activation: relu, elu or silu, after each of them.
        warmup: fraction of the training in which the learning rate rises to that of the optimizer; it then
            decays to 0 along a cosine. None: constant.
        dropout: probability of dropout for the embedding and the dense layers.
        start: file ``weights.pt`` of the same network, from which the training goes on; None: drawn weights.
            Statistics of batch norm begin anew.
        seed: of weights and dropout only; the global random state does not change.
    """

    def __init__(
        self,
        model: Callable[..., Any],
        fusion: Callable[..., AbstractFusion],
        optimizer: Callable[..., Any],
        trainer: dict[str, Any],
        hidden: Sequence[Annotated[int, Ge(1)]] = (32,),
        activation: Activation = "relu",
        warmup: Annotated[float, Ge(0), Le(1)] | None = None,
        dropout: Annotated[float, Ge(0), Lt(1)] = 0.0,
        start: str | None = None,
        seed: int = 0,
    ) -> None:
        self._start = None if start is None else Path(start).expanduser()
        self._fusion = partial(fusion, model)
        self._optimizer, self._trainer = optimizer, dict(trainer)
        self._hidden, self._activation, self._seed = hidden, activation, seed
        self._warmup, self._dropout = None if warmup is None else float(warmup), dropout

    def check(self, data: TouchData) -> None:
        """Build and use network, optimizer and trainer once, so that errors are reported early.

        Raises:
            InputError: the settings do not fit each other or the data, or a part gives wrong shapes.
        """
        from skin.learning.training import make_trainer

        with torch.random.fork_rng():
            network = self.build(data)
        self._begin(network)
        try:
            with torch.no_grad():
                shape = network.eval()(data.show(data.example)).shape
            if len(shape) != 2 or shape[0] != 1:
                raise RuntimeError(f"one touch gives an output of {tuple(shape)}")
        except InputError:
            raise
        except (RuntimeError, ValueError) as error:
            raise InputError(
                "model and fusion must return embeddings (N, E), as wide as their attribute width says: "
                f"{one_line(error)}"
            ) from error
        make_trainer(self._trainer)
        settings = getattr(self._optimizer, "keywords", {}).items()
        if text := [f"{name}={value}" for name, value in settings if isinstance(value, str)]:
            raise InputError(f"optimizer.{text[0]} is text, and must be a number")
        try:
            self._optimizer(network.parameters())
        except (TypeError, ValueError) as error:
            raise InputError(f"the optimizer refuses its settings: {error}") from error

    def fit(self, data: TouchData, logger: "Logger | None" = None) -> None:
        """Train on the training split; the validation loss chooses the epoch.

        With several processes, only the first has the trained weights; they continue no earlier training.

        Raises:
            InputError: the choices do not fit each other or the data.
        """
        # Imported here because Lightning takes seconds and a prediction does not need it.
        from skin.learning.training import Training, train_network

        with torch.random.fork_rng(), TemporaryDirectory() as temporary:
            torch.manual_seed(self._seed)
            classifier = self.build(data)
            if data.task.kind == "regression":
                classifier.targets.scale(torch.cat([part.known_labels for part in data.parts("train")]))
            self._begin(classifier)
            training = Training(classifier, data, self._optimizer, self._warmup)
            folder = self.unfinished or Path(temporary)
            self.seconds_per_epoch = train_network(
                training, data, self._trainer, logger, folder, self.unfinished is not None
            )

    def _begin(self, classifier: TouchClassifier) -> None:
        """Give a network the weights of ``start``.

        Raises:
            InputError: the file does not exist, or is of another network.
        """
        if self._start is None:
            return
        if not self._start.is_file():
            raise InputError(f"learner.start={self._start}: no such file")
        try:
            _load_weights(classifier, self._start)
        except RuntimeError as error:
            raise InputError(
                f"learner.start={self._start} is of another network: {one_line(error)}"
            ) from error
        for module in classifier.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.reset_running_stats()

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout that the model accepts."""
        return self._map(
            touches, lambda classifier, frames: probabilities(classifier(frames), classifier.task)
        )

    def embeddings(self, touches: Touches) -> Tensor:
        """Return the embeddings of touches, (B, E), which are the input of the dense layers."""
        return self._map(touches, lambda classifier, frames: classifier.fusion(frames))

    @property
    def network(self) -> TouchClassifier:
        """The trained network.

        Raises:
            RuntimeError: before ``fit`` or ``load``.
        """
        return self.learned[0]

    def pipeline(self, positions: Tensor) -> nn.Module:
        """Return representation and network as one module, in evaluation mode."""
        classifier, data = self.learned
        pipeline = Pipeline(data.representation_for(positions), classifier, positions, data.geometry)
        return pipeline.cpu().eval()

    def _map(
        self,
        touches: Touches,
        function: Callable[[TouchClassifier, Frames], Tensor],
        chunk: int = 64,  # touches at a time: fastest, and bounds memory to a few hundred MB
    ) -> Tensor:
        """Return a function of the classifier and frames, (B, ...), computed in chunks."""
        classifier, data = self.learned
        device = next(classifier.eval().parameters()).device
        with torch.inference_mode():
            parts = [
                function(classifier, data.show(touches[start : start + chunk].to(device))).cpu()
                for start in range(0, len(touches), chunk)
            ]
        return torch.cat(parts)

    def save(self, folder: Path) -> Path:
        """Write the weights to ``weights.pt`` in ``folder`` and return its path."""
        path = Path(folder) / "weights.pt"
        torch.save(self.network.state_dict(), path)
        return path

    def load(self, data: TouchData, path: Path) -> None:
        """Load the weights that :meth:`save` wrote; ``data`` gives the shapes as in :meth:`fit`."""
        _load_weights(self.build(data), path)

    def build(self, data: TouchData) -> TouchClassifier:
        """Return the untrained network for the frames of ``data``, drawn from torch's random state.

        Raises:
            InputError: the choices do not fit each other or the data.
        """
        frames, _ = data.frames(data.example)
        kind = data.representation_for(data.example.positions).kind
        fusion = self._fusion(kind, tuple(frames.x.shape[2:]), frames.x.shape[1])
        classifier = TouchClassifier(
            fusion,
            data.task,
            self._hidden,
            self._activation,
            self._dropout,
            0 if frames.summary is None else frames.summary.shape[1],
        )
        self._learned = classifier, data
        self.parameters = sum(p.numel() for p in classifier.parameters() if p.requires_grad)
        return classifier
