"""Learners: fitted to touches, they predict the probability of each label."""

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor, nn

from skin.core.safe_loading import TEXT, parse_json, read_file
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.features import engineered_features
from skin.touch.labels import ALARM, Task

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.learning.network import TouchClassifier


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
    _learned: Any = None

    @property
    def learned(self) -> Any:
        """What was fitted or loaded.

        Raises:
            RuntimeError: before ``fit`` or ``load``.
        """
        if self._learned is None:
            raise RuntimeError("fit or load the learner first")
        return self._learned

    def check(self, data: TouchData) -> None:  # noqa: B027 - most have nothing that could be missing
        """Raise InputError if the learner cannot be fitted, before anything is logged."""

    @abstractmethod
    def fit(self, data: TouchData, logger: "Logger | None" = None) -> None:
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
            InputError: this learner is not a network.
        """
        raise InputError(
            f"learner {type(self).__name__} cannot be exported: give a run of learner=network, or of an "
            "ensemble of networks"
        )

    @property
    def network(self) -> "TouchClassifier":
        """The trained network; what changes its weights changes the learner.

        Raises:
            InputError: this learner is not a network.
        """
        raise InputError(
            f"{type(self).__name__} has no network to fine-tune: give a run of a network, such as best_fresh"
        )

    @abstractmethod
    def save(self, folder: Path) -> Path:
        """Write what was learned to a file in ``folder`` and return its path."""

    @abstractmethod
    def load(self, data: TouchData, path: Path) -> None:
        """Load the file that :meth:`save` wrote; ``data`` gives the shapes as in :meth:`fit`."""


# One threshold per label on an engineered feature.


LOOK_AT = {
    "big": ("sensors above", "most sensors above"),
    "dynamic": ("path of", "reach of", "extent of", "way of"),
    "press": ("longest run",),
    ALARM: ("raw sensor maximum 1", "sensor maximum 1"),
    "touch": ("sensor maximum 1",),
}
"""Label -> beginnings of the names of the features that its rule may use."""

_Split = tuple[dict[str, Tensor], np.ndarray]


@dataclass(frozen=True)
class Rule:
    """A label holds where a feature exceeds a threshold.

    Attributes:
        measurement: name of the feature; stored under this key in ``rules.json``.
        threshold: in the unit of the feature.
        slope: of the log odds above the threshold, per unit of the feature.
    """

    measurement: str
    threshold: float
    slope: float

    def probability(self, values: dict[str, Tensor]) -> Tensor:
        """Return the probability of the label, (B,)."""
        return (self.slope * (values[self.measurement].double() - self.threshold)).sigmoid().float()


class Rules(AbstractLearner):
    """Tunes one threshold per label: peak force, duration of contact, travel of the centre, active sensors.

    Each label uses the feature and the threshold with the highest training accuracy. The slope is fitted to
    the validation split. Any layout is accepted.
    """

    def __init__(self, seed: int = 0) -> None:
        """Accept a seed as every learner does: nothing is drawn."""

    def fit(self, data: TouchData, logger: "Logger | None" = None) -> None:
        """Tune the thresholds.

        Raises:
            InputError: the labels are not those of the report, or the touches have no labels.
        """
        if not set(data.task.names) <= set(LOOK_AT):
            raise InputError(
                f"learner=rules knows the labels {', '.join(LOOK_AT)}, got {', '.join(data.task.names)}: "
                "use learner=boosted_trees"
            )
        began = time.perf_counter()
        splits = [data.touches(split).to("cpu") for split in ("train", "validation")]
        features = [engineered_features(touches) for touches in splits]
        rules = {}
        for label, name in enumerate(data.task.names):
            known = [
                _select_defined(values, touches.known_labels, data.task, label)
                for values, touches in zip(features, splits, strict=True)
            ]
            rules[name] = _tune(name, *known)
        self._set(rules)
        self.seconds_per_epoch = time.perf_counter() - began

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout."""
        rules, values = self.learned.values(), engineered_features(touches.to("cpu"))
        return torch.stack([rule.probability(values) for rule in rules], dim=1)

    def save(self, folder: Path) -> Path:
        """Write the rules to ``rules.json`` in ``folder`` and return its path."""
        path = Path(folder) / "rules.json"
        path.write_text(json.dumps({name: asdict(rule) for name, rule in self.learned.items()}, indent=2))
        return path

    def load(self, data: TouchData, path: Path) -> None:
        """Load the rules that :meth:`save` wrote.

        Raises:
            ValueError, LookupError, TypeError: they are damaged, or of other labels or features.
        """
        stored = parse_json(read_file(Path(path), TEXT))
        self._set({name: Rule(**stored[name]) for name in data.task.names})
        self.probabilities(data.example)  # refuses unknown measurements and values that are not numbers

    def _set(self, rules: dict[str, Rule]) -> None:
        self._learned = rules
        self.parameters = 2 * len(rules)


def _select_defined(values: dict[str, Tensor], labels: Tensor, task: Task, label: int) -> _Split:
    """Return the features and one label of the touches for which that label is defined."""
    rows = task.counts(labels)[:, label]
    return {name: column[rows] for name, column in values.items()}, labels[rows, label].numpy()


def _tune(label: str, train: _Split, validation: _Split) -> Rule:
    """Return the best rule for one label: feature and threshold from ``known``, slope from ``other``."""
    values, truth = train
    # The trailing blank keeps "maximum 1" from matching "maximum 10".
    looked_at = tuple(f"{name} " for name in LOOK_AT[label])
    allowed = [name for name in values if f"{name} ".startswith(looked_at)]
    _, threshold, name = max((*_threshold(values[name].double().numpy(), truth), name) for name in allowed)
    values, truth = validation
    distance = values[name].double().numpy() - threshold
    unit = np.std(distance) or 1.0

    def loss(log_slope: float) -> float:
        return float(np.logaddexp(0, np.exp(log_slope) * distance / unit * (1 - 2 * truth)).mean())

    # The slope is limited so that float32 probabilities have no ties, which would change the ranking.
    steepest = np.log(12 * unit / max(float(np.abs(distance).max()), 1e-12))
    log_slope = minimize_scalar(loss, bounds=(steepest - 9, steepest), method="bounded").x
    return Rule(name, threshold, float(np.exp(log_slope) / unit))


def _threshold(scores: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the highest accuracy of ``scores > threshold`` and that threshold, between two scores."""
    order = np.argsort(scores)
    scores, truth = scores[order], truth[order]
    # Correct when cutting after i: the zeros up to i and the ones after it.
    right = np.cumsum(1 - truth) + truth.sum() - np.cumsum(truth)
    cut = np.diff(scores) > 0
    if not cut.any():
        return float(max(truth.mean(), 1 - truth.mean())), float(scores[0])
    i = int(np.argmax(np.where(cut, right[:-1], -1)))
    return float(right[i] / len(truth)), float((scores[i] + scores[i + 1]) / 2)


# Learning by several learners whose probabilities are averaged.


class Mean(nn.Module):
    """The mean of several pipelines."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""
        return torch.stack([member(readings, valid) for member in self.members]).mean(dim=0)


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

    def check(self, data: TouchData) -> None:
        """Check every member."""
        for member in self._members:
            member.check(data)

    def fit(self, data: TouchData, logger: "Logger | None" = None) -> None:
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
        return Mean([member.pipeline(positions) for member in self._members])

    def save(self, folder: Path) -> Path:
        """Write what each member learned to a numbered folder in ``folder/members``; return that."""
        members = Path(folder) / "members"
        for number, member in enumerate(self._members):
            (members / str(number)).mkdir(parents=True)
            member.save(members / str(number))
        return members

    def load(self, data: TouchData, path: Path) -> None:
        """Load the folder that :meth:`save` wrote."""
        for number, member in enumerate(self._members):
            (file,) = (Path(path) / str(number)).iterdir()
            member.load(data, file)
        self._count()

    def _count(self) -> None:
        self.parameters = sum(member.parameters for member in self._members)
