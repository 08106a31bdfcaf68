"""Evaluation of a learner on its own device, unseen devices and unseen layouts."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import isnan
from typing import Literal, Protocol

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from skin.config import Evaluation
from skin.device.base import AbstractDevice, AbstractSimulated
from skin.errors import InputError
from skin.evaluation.alarm import Reached
from skin.evaluation.metrics import confusion, metrics
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.outcomes import encode
from skin.labels import Task
from skin.layout.scattered import Scattered
from skin.recording import Touches

# Neither the default device (0) nor any layout of data/layouts is among them.
_FIRST_DEVICE, _FIRST_LAYOUT = 1, 101
SHARES = ("/accuracy", "/alarm_recall", "/false_alarm_rate")
"""Suffixes of the metrics that are shown in per cent."""

_SHOWN = (*SHARES, "/degrees")
_UNDEFINED = "not defined, because the test has only gestures with this label or only gestures without it"


class Predictor(Protocol):
    """The interface that an evaluation needs: a trained learner, an ensemble of runs, or a peer."""

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L); raise InputError for touches that do not fit."""


@dataclass(frozen=True)
class Report:
    """Result of an evaluation.

    Attributes:
        metrics: ``<column>/<label>/<metric>``, NaN where the touches do not define it. Columns: ``same``
            (test gestures on the device of the training), ``holdout`` (the last tenth of the training
            budget), ``device_shift`` and ``unseen_layout`` (the test gestures, shared out among unseen
            devices and layouts).
        cannot: column, or metric that is not defined -> why there is no value.
        confusion: (L, 2, 2), of ``same``; None where the labels are exclusive.
        predictions: a row per test gesture: labels, probabilities (``p_<label>``) and drawn parameters.
        point: where the alarm is raised; None where the task has no label ``dangerous``.
        reached: the alarms on the gestures of ``same``; None without ``point``.
        outcomes: of the gestures of ``same`` (:func:`skin.evaluation.outcomes.encode`); None where the labels
            have none.
    """

    metrics: dict[str, float]
    cannot: dict[str, str]
    confusion: Tensor | None
    predictions: pa.Table
    point: OperatingPoint | None = None
    reached: Reached | None = None
    outcomes: np.ndarray | None = None


def columns(device: AbstractDevice, settings: Evaluation) -> dict[str, Iterator[Touches]]:
    """Return the sets of touches of each column of a report, drawn lazily.

    Those of ``unseen_layout`` raise InputError where the sensors cannot form a grid.
    """
    sets = {"same": _once(device, "same"), "holdout": _once(device, "holdout")}
    if (simulation := device.simulation) is not None:
        sets["device_shift"] = _devices(simulation, settings)
        sets["unseen_layout"] = _layouts(simulation, settings)
    return sets


def evaluate(
    learner: Predictor, device: AbstractDevice, settings: Evaluation, point: OperatingPoint | None
) -> Report:
    """Evaluate a trained learner on a device and, if it is simulated, on other devices and layouts.

    Args:
        learner: trained learner.
        device: its device, or another.
        settings: number of other devices and layouts.
        point: operating point of the alarm; None where the task has no label ``dangerous``.
    """
    task, found, cannot = device.task, dict[str, float](), dict[str, str]()
    same, drawn = _test(device)
    chances = learner.probabilities(same)
    found |= _named("same", metrics(chances, _labels(same), task, point))
    others = columns(device, settings)
    del others["same"]
    for column, sets in others.items():
        try:
            each = [(learner.probabilities(touches), _labels(touches)) for touches in sets]
        except InputError as reason:
            cannot[column] = str(reason)
            continue
        if each:
            said, true = (torch.cat(parts) for parts in zip(*each, strict=True))
            found |= _named(column, metrics(said, true, task, point))
    cannot |= {name: _UNDEFINED for name, value in found.items() if isnan(value) and name.endswith(_SHOWN)}
    table = confusion(chances, _labels(same), task) if task.kind == "binary" else None
    reached = None if point is None else point.reached(chances, _labels(same), task)
    outcomes = encode(chances, _labels(same), task, point)
    return Report(found, cannot, table, _predictions(chances, same, task, drawn), point, reached, outcomes)


def _test(device: AbstractDevice) -> tuple[Touches, dict[str, Tensor]]:
    """Return the test touches and, where they were simulated, how each was drawn."""
    if device.simulation is None:
        return device.touches("test"), {}
    recording = device.recording("test", complete=False)
    return recording.touches, recording.parameters


def _once(device: AbstractDevice, column: Literal["same", "holdout"]) -> Iterator[Touches]:
    """Yield the one set of a column."""
    yield _test(device)[0] if column == "same" else device.touches("holdout")


def _devices(device: AbstractSimulated, settings: Evaluation) -> Iterator[Touches]:
    """Yield the share of the test touches that each of some other devices of the same kind measures."""
    for number in range(settings.devices):
        other = device.replace(seed=_FIRST_DEVICE + number)
        yield _share(other.touches("test"), number, settings.devices)


def _layouts(device: AbstractSimulated, settings: Evaluation) -> Iterator[Touches]:
    """Yield the share of the test touches for other layouts with as many sensors, equally deep and tilted.

    A gesture whose dangerous pressure no sensor of a layout would feel takes another path there.
    """
    count = len(device.sensors)
    rows = max(number for number in range(1, int(count**0.5) + 1) if count % number == 0)
    if count // rows > 3 * rows:
        raise InputError(f"{count} sensors cannot form a grid, so there are no other layouts of them")
    for number in range(settings.layouts):
        layout = Scattered(
            rows,
            count // rows,
            seed=_FIRST_LAYOUT + number,
            footprint=device.sensors.footprint,
            depth=device.sensors.positions[:, 2],
            normals=device.sensors.normals,
        )
        yield _share(device.replace(layout=layout).touches("test"), number, settings.layouts)


def _share(touches: Touches, number: int, count: int) -> Touches:
    """Return one of ``count`` shares of touches, which together are all of them."""
    return touches[torch.arange(number, len(touches), count)]


def _labels(touches: Touches) -> Tensor:
    if touches.labels is None:
        raise InputError("touches without labels cannot be scored: record them with labels")
    return touches.labels


def _named(column: str, values: dict[str, float]) -> dict[str, float]:
    return {f"{column}/{name}": value for name, value in values.items()}


def _predictions(chances: Tensor, touches: Touches, task: Task, drawn: dict[str, Tensor]) -> pa.Table:
    columns: dict[str, np.ndarray] = {}
    for name, label, chance in zip(task.names, _labels(touches).T, chances.T, strict=True):
        known = label.to(torch.int8) if name in task.binary else label
        columns |= {name: known.numpy(), f"p_{name}": chance.numpy()}
    columns |= {name: np.asarray(values) for name, values in drawn.items() if np.ndim(values) == 1}
    return pa.table(columns)
