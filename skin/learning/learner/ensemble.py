"""Learning by several learners whose probabilities are averaged."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.learner.base import AbstractLearner

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.data import TouchData


class Ensemble(AbstractLearner):
    """Trains its members on the same touches, each with its own seed, and averages their probabilities.

    Members with different errors (trees and networks) improve most. It accepts the touches that all members
    accept.

    Args:
        members: name -> a learner without its seed.
        copies: name -> number of copies, each with another seed; 1 by default.
        seed: member number i has the seed 1000 ``seed`` + i.

    Raises:
        InputError: no member, or copies of an unknown member.
    """

    def __init__(
        self,
        members: Mapping[str, Callable[..., AbstractLearner]],
        copies: Mapping[str, int] | None = None,
        seed: int = 0,
    ) -> None:
        copies = dict(copies or {})
        if unknown := sorted(copies.keys() - members.keys()):
            raise InputError(f"learner.copies names {', '.join(unknown)}, members are {', '.join(members)}")
        makers = [make for name, make in members.items() for _ in range(copies.get(name, 1))]
        if not makers:
            raise InputError("learner=ensemble has no member: set learner.copies.network=1 or more")
        self._members = [make(seed=1000 * seed + number) for number, make in enumerate(makers)]

    def check(self, data: "TouchData") -> None:
        """Check every member."""
        for member in self._members:
            member.check(data)

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Train one member after the other; the last one's training is logged."""
        for member in self._members[:-1]:
            member.fit(data)
        self._members[-1].fit(data, logger)
        self.seconds_per_epoch = sum(member.seconds_per_epoch for member in self._members)
        self._count()

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the mean of the members' probabilities, (B, L)."""
        return torch.stack([member.probabilities(touches) for member in self._members]).mean(dim=0)

    def pipeline(self, positions: Tensor) -> nn.Module:
        """Return the mean of the members' pipelines."""
        from skin.learning.classifier import Mean

        return Mean([member.pipeline(positions) for member in self._members])

    def save(self, folder: Path) -> Path:
        """Write what each member learned to a numbered folder in ``folder/members``; return that."""
        whole = Path(folder) / "members"
        for number, member in enumerate(self._members):
            place = whole / str(number)
            place.mkdir(parents=True)
            member.save(place)
        return whole

    def load(self, data: "TouchData", path: Path) -> None:
        """Load the folder that :meth:`save` wrote."""
        for number, member in enumerate(self._members):
            (file,) = (Path(path) / str(number)).iterdir()
            member.load(data, file)
        self._count()

    def _count(self) -> None:
        self.parameters = sum(member.parameters for member in self._members)
