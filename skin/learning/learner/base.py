"""The interface of learners, which are fitted to touches and predict the probability of each label."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor, nn

from skin.device.touches import Touches
from skin.errors import InputError

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.classifier import TouchClassifier
    from skin.learning.data import TouchData


class AbstractLearner(ABC):
    """Learns the labels of touches, for example by gradient descent, boosting or rules.

    Attributes:
        parameters: number of trained parameters, known after ``fit`` or ``load``.
        seconds_per_epoch: median duration of one training epoch, s, known after ``fit``.
        unfinished: existing folder in which ``fit`` may keep its progress, and from which a later ``fit``
            with the same settings and data continues; None: nothing is kept.
    """

    parameters: int
    seconds_per_epoch: float
    unfinished: Path | None = None

    def check(self, data: "TouchData") -> None:  # noqa: B027 - most have nothing that could be missing
        """Raise InputError if the learner cannot be fitted, before anything is logged."""

    @abstractmethod
    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Fit to the training split of ``data``; model selection uses its validation split only."""

    @abstractmethod
    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any supported layout."""

    def embeddings(self, touches: Touches) -> Tensor:
        """Return the embeddings of touches, (B, E).

        Raises:
            InputError: this learner has no encoder.
        """
        raise InputError(f"{type(self).__name__} has no encoder: give a run of a network")

    def pipeline(self, positions: Tensor) -> nn.Module:
        """Return a torch module of readings (B, T, S), N, and valid (B, T, S), bool; it gives probabilities.

        Args:
            positions: (S, 3), m.

        Raises:
            InputError: this learner is no network.
        """
        raise InputError(
            f"learner {type(self).__name__} cannot be exported: give a run of learner=network, or of an "
            "ensemble of networks"
        )

    @property
    def network(self) -> "TouchClassifier":
        """The trained network; what changes its weights changes the learner.

        Raises:
            InputError: this learner is no network.
        """
        raise InputError(
            f"{type(self).__name__} has no network to fine-tune: give a run of a network, such as best_fresh"
        )

    @abstractmethod
    def save(self, folder: Path) -> Path:
        """Write what was learned to a file in ``folder`` and return its path."""

    @abstractmethod
    def load(self, data: "TouchData", path: Path) -> None:
        """Load the file that :meth:`save` wrote; ``data`` gives the shapes as in :meth:`fit`."""
