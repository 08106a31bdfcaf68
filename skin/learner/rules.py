"""Learning thresholds on what one would look at first."""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from skin.errors import InputError
from skin.labels import Task
from skin.learner.base import AbstractLearner
from skin.recording import Touches
from skin.signal.features import measurements

if TYPE_CHECKING:
    from pytorch_lightning.loggers import Logger

    from skin.datamodule import TouchData

LOOK_AT = {
    "big": ("sensors above", "most sensors above"),
    "dynamic": ("path of", "reach of", "extent of", "way of"),
    "press": ("longest run",),
    "dangerous": ("raw sensor maximum 1", "sensor maximum 1"),
    "touch": ("sensor maximum 1",),
}
"""How the names of the measurements begin that a rule for a label may use."""

_LARGEST_LOGIT = 12.0

_Split = tuple[dict[str, Tensor], np.ndarray]


@dataclass(frozen=True)
class Rule:
    """A label holds where a measurement exceeds a threshold.

    Attributes:
        measurement: its name.
        threshold: in the unit of the measurement.
        slope: of the log odds above the threshold, per unit; it makes a probability of a distance.
    """

    measurement: str
    threshold: float
    slope: float

    def probability(self, values: dict[str, Tensor]) -> Tensor:
        """Return the probability of the label, (B,)."""
        return (self.slope * (values[self.measurement].double() - self.threshold)).sigmoid().float()


class Rules(AbstractLearner):
    """Tunes one threshold per label: peak force, duration of contact, travel of the centre, active sensors.

    For every label the measurement and the threshold of the highest training accuracy are taken; the slope is
    fitted to the validation split. Takes any layout.
    """

    def __init__(self, seed: int = 0) -> None:
        self._rules: dict[str, Rule] = {}

    def fit(self, data: "TouchData", logger: "Logger | None" = None) -> None:
        """Tune the thresholds.

        Raises:
            InputError: labels that are not the report's, or the touches have none.
        """
        if not set(data.task.names) <= set(LOOK_AT):
            raise InputError(
                f"learner=rules knows the labels {', '.join(LOOK_AT)}, got {', '.join(data.task.names)}: "
                "use learner=features"
            )
        began = time.perf_counter()
        train, validation = data.touches("train"), data.touches("validation")
        known, other = measurements(train.to("cpu")), measurements(validation.to("cpu"))
        self._set(
            {
                name: _tune(
                    name,
                    _told(known, train.known_labels, data.task, i),
                    _told(other, validation.known_labels, data.task, i),
                )
                for i, name in enumerate(data.task.names)
            }
        )
        self.seconds_per_epoch = time.perf_counter() - began

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of any layout."""
        if not self._rules:
            raise RuntimeError("fit or load the learner first")
        values = measurements(touches.to("cpu"))
        return torch.stack([rule.probability(values) for rule in self._rules.values()], dim=1)

    def save(self, folder: Path) -> Path:
        """Write the rules to ``rules.json`` in ``folder`` and return its path."""
        if not self._rules:
            raise RuntimeError("fit or load the learner first")
        path = Path(folder) / "rules.json"
        path.write_text(json.dumps({name: asdict(rule) for name, rule in self._rules.items()}, indent=2))
        return path

    def load(self, data: "TouchData", path: Path) -> None:
        """Take the rules that ``save`` wrote."""
        stored = json.loads(Path(path).read_text())
        rules = {name: Rule(**stored[name]) for name in data.task.names}
        known = measurements(data.touches("train")[:1].to("cpu"))
        for name, rule in rules.items():
            numbers = all(isinstance(value, int | float) for value in (rule.threshold, rule.slope))
            if rule.measurement not in known or not numbers:
                raise ValueError(f"the rule of {name} is {asdict(rule)}")
        self._set(rules)

    def _set(self, rules: dict[str, Rule]) -> None:
        self._rules = rules
        self.parameters = 2 * len(rules)


def _told(values: dict[str, Tensor], labels: Tensor, task: Task, label: int) -> _Split:
    """Return the measurements and one label of the touches in which that label means something."""
    rows = task.counts(labels)[:, label].cpu()
    return {name: column[rows] for name, column in values.items()}, labels[:, label].cpu()[rows].numpy()


def _tune(label: str, known: _Split, other: _Split) -> Rule:
    """Return the best rule for one label: measurement and threshold from ``known``, slope from ``other``."""
    values, truth = known
    # A blank ends both, so that maximum 1 does not mean maximum 10 too.
    looked_at = tuple(f"{name} " for name in LOOK_AT[label])
    allowed = [name for name in values if f"{name} ".startswith(looked_at)]
    _, threshold, name = max((*_threshold(values[name].double().numpy(), truth), name) for name in allowed)
    values, truth = other
    distance = values[name].double().numpy() - threshold
    unit = np.std(distance) or 1.0

    def loss(log_slope: float) -> float:
        return float(np.logaddexp(0, np.exp(log_slope) * distance / unit * (1 - 2 * truth)).mean())

    # No steeper than float32 can tell apart at the furthest touch: ties would blur the ranking.
    steepest = np.log(_LARGEST_LOGIT * unit / max(float(np.abs(distance).max()), 1e-12))
    log_slope = minimize_scalar(loss, bounds=(steepest - 9, steepest), method="bounded").x
    return Rule(name, threshold, float(np.exp(log_slope) / unit))


def _threshold(scores: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the highest accuracy of ``scores > threshold`` and that threshold, between two scores."""
    order = np.argsort(scores)
    scores, truth = scores[order], truth[order]
    # right when cutting after i: the zeros up to i and the ones beyond it
    right = np.cumsum(1 - truth) + truth.sum() - np.cumsum(truth)
    cut = np.diff(scores) > 0
    if not cut.any():
        return float(max(truth.mean(), 1 - truth.mean())), float(scores[0])
    i = int(np.argmax(np.where(cut, right[:-1], -1)))
    return float(right[i] / len(truth)), float((scores[i] + scores[i + 1]) / 2)
