"""Evaluation of a learner on its own device, unseen devices and unseen layouts, as a table and as a page."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from skin.body.layout import Scattered
from skin.core.files import whole, write
from skin.core.progress import CONSOLE
from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics, count_confusions, encode
from skin.evaluation.operating_point import LABEL, OperatingPoint, Predictor, Reached
from skin.evaluation.settings import Evaluation
from skin.learning.features import above_idle
from skin.plot.figures import confusions, save_figure
from skin.touch.labels import TOUCH, Task

PERCENTAGES = ("/accuracy", "/alarm_recall", "/false_alarm_rate")
"""Suffixes of the metrics that are shown in per cent."""
_SHOWN = (*PERCENTAGES, "/degrees", "/r2", "/rms", "/rms_mm", "/rms_N")
_UNDEFINED = "not defined, because the test has only gestures with this label or only gestures without it"


@dataclass(frozen=True)
class Report:
    """Result of an evaluation.

    Attributes:
        metrics: ``<column>/<label>/<metric>``, NaN where the touches do not define it. Columns: ``same``
            (test gestures on the device of the training), ``holdout`` (the last tenth of the training
            budget), ``device_shift`` and ``unseen_layout`` (the test gestures, shared out among unseen
            devices and layouts).
        unavailable: column, or metric that is not defined -> why there is no value.
        confusion: (L, 2, 2), of ``same``; None where the labels are exclusive.
        predictions: a row per test gesture: labels, probabilities (``p_<label>``) and drawn parameters.
        point: where the alarm is raised; None where the task has no label ``dangerous``.
        reached: the alarms on the gestures of ``same``; None without ``point``.
        outcomes: of the gestures of ``same`` (:func:`skin.evaluation.metrics.encode`); None where the labels
            have none.
        split: in words, what training and test keep apart.
    """

    metrics: dict[str, float]
    unavailable: dict[str, str]
    confusion: Tensor | None
    predictions: pa.Table
    point: OperatingPoint | None = None
    reached: Reached | None = None
    outcomes: np.ndarray | None = None
    split: str = ""

    @property
    def notes(self) -> list[str]:
        """How the alarm was raised, and why values are missing."""
        point, reached = self.point, self.reached
        alarm = [f"{point.sentence()}; {reached.sentence()}"] if point and reached else []
        return [*alarm, *(f"{column}: {reason}" for column, reason in self.unavailable.items())]


def touch_sets(device: AbstractDevice, settings: Evaluation) -> dict[str, Iterator[Touches]]:
    """Return the sets of touches of each further column of a report, drawn lazily.

    Those of ``unseen_layout`` raise InputError where the sensors cannot form a grid.
    """
    sets: dict[str, Iterator[Touches]] = {"holdout": (device.touches("holdout") for _ in range(1))}
    if (simulation := device.simulation) is not None:
        # Devices of the same kind, none of them that of the training.
        siblings = (
            simulation.replace(seed=simulation.seed + 1 + number) for number in range(settings.devices)
        )
        sets["device_shift"] = _share_out(siblings, settings.devices)
        # A gesture whose dangerous pressure no sensor of a layout would feel takes another path there.
        sets["unseen_layout"] = _share_out(scattered_devices(simulation, settings.layouts), settings.layouts)
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
    task, cannot = device.task, dict[str, str]()
    recording = None if device.simulation is None else device.recording("test", complete=False)
    same = device.touches("test") if recording is None else recording.touches
    probabilities = learner.probabilities(same)
    scored = {"same": (probabilities, same.known_labels)}
    for column, sets in touch_sets(device, settings).items():
        try:
            pairs = [
                (learner.probabilities(touches), touches.known_labels)
                for touches in track(
                    sets, column, console=CONSOLE, transient=True, disable=not CONSOLE.is_terminal
                )
            ]
        except InputError as reason:
            cannot[column] = str(reason)
            continue
        if pairs:
            predicted, true = (torch.cat(parts) for parts in zip(*pairs, strict=True))
            scored[column] = predicted, true
    metrics = {
        f"{column}/{name}": value
        for column, of_set in scored.items()
        for name, value in compute_metrics(*of_set, task, point).items()
    }
    never = same.known_labels.isnan().all(dim=0)
    if unknown := [name for name, missing in zip(task.names, never, strict=True) if missing]:
        cannot["labels"] = f"the touches of the test tell nothing of {', '.join(unknown)}"
        hidden = [*unknown, *(["direction"] if task.direction and never[-1] else [])]
        metrics = {name: value for name, value in metrics.items() if name.split("/")[1] not in hidden}
    cannot |= {name: _UNDEFINED for name, value in metrics.items() if isnan(value) and name.endswith(_SHOWN)}
    table = count_confusions(probabilities, same.known_labels, task) if task.kind == "binary" else None
    reached = (
        None if point is None or LABEL in unknown else point.reached(probabilities, same.known_labels, task)
    )
    outcomes = encode(probabilities, same.known_labels, task, point)
    predictions = _predictions(probabilities, same, task, {} if recording is None else recording.parameters)
    return Report(metrics, cannot, table, predictions, point, reached, outcomes, device.split)


def _share_out(devices: Iterable[Simulated], count: int) -> Iterator[Touches]:
    """Return the fraction of the test touches that each of ``count`` devices measures, drawn lazily."""
    return (device.touches("test")[number::count] for number, device in enumerate(devices))


def scattered_devices(device: Simulated, count: int) -> Iterator[Simulated]:
    """Yield a device on each of some scattered layouts with as many sensors, equally deep and tilted.

    Raises:
        InputError: the sensors cannot form a grid.
    """
    axes = device.sensors.axes
    sensors = len(device.sensors) // axes
    rows = max(number for number in range(1, int(sensors**0.5) + 1) if sensors % number == 0)
    if sensors // rows > 3 * rows:
        raise InputError(f"{sensors} sensors cannot form a grid, so there are no other layouts of them")
    for number in range(count):
        layout = Scattered(
            rows,
            sensors // rows,
            seed=101 + number,  # none of data/layouts
            footprint=device.sensors.footprint,
            depth=device.sensors.positions[::axes, 2].tolist(),
            normals=device.sensors.normals[::axes],
            axes="three" if axes > 1 else "normal",
        )
        yield device.replace(layout=layout)


def _predictions(probabilities: Tensor, touches: Touches, task: Task, drawn: dict[str, Tensor]) -> pa.Table:
    columns: dict[str, Any] = {}
    for name, label, probability in zip(task.names, touches.known_labels.T, probabilities.T, strict=True):
        kind = pa.int8() if name in task.binary else pa.float32()
        truth = pa.array(label.numpy(), kind, mask=label.isnan().numpy(), safe=False)  # null where unknown
        columns |= {name: truth, f"p_{name}": probability.numpy()}
    columns |= {name: np.asarray(values) for name, values in drawn.items() if np.ndim(values) == 1}
    return pa.table(columns)


def print_report(report: Report, title: str, console: Console | None = None) -> None:
    """Print one line per label and one column per set of touches, accuracies in per cent, errors in degrees.

    Args:
        report: result of the evaluation.
        title: of the table.
        console: where to print; None: standard output.
    """
    console = console or Console()
    console.print(metrics_table(report.metrics, title))
    for note in [f"split: {report.split}"] * bool(report.split) + report.notes:
        console.print(note, markup=False, highlight=False, soft_wrap=True)


def metrics_table(metrics: Mapping[str, float], title: str) -> Table:
    """Return a table of the metrics with a suffix such as ``/accuracy``; others are omitted."""
    (_, *sets), *lines = metric_rows(metrics)
    table = Table("", *sets, title=title)
    for line in lines:
        table.add_row(*line)
    return table


def metric_rows(metrics: Mapping[str, float], degree: str = "") -> list[list[str]]:
    """Return the sets of touches, and a row per metric that is shown; ``degree`` is the sign of angles."""
    names = [name for name in metrics if name.endswith(_SHOWN)]
    sets = list(dict.fromkeys(name.split("/")[0] for name in names))
    rows = [["", *sets]]
    for line in dict.fromkeys(name.split("/", 1)[1] for name in names):
        unit, sign = (100, "") if line.endswith(PERCENTAGES) else (1, degree * line.endswith("/degrees"))
        digits = 1 if unit == 100 or line.endswith("/degrees") else 3
        values = (metrics.get(f"{column}/{line}") for column in sets)
        rows.append(
            [line, *(format_number(value, unit, digits) + sign * (value is not None) for value in values)]
        )
    return rows


def format_number(value: float | None, unit: float = 100, digits: int = 1) -> str:
    """Return a value with some decimals; "-" for NaN, and an empty string for None."""
    return "" if value is None else "-" if isnan(value) else f"{unit * value:.{digits}f}"


def evaluation_markdown(report: Report, task: Task, title: str, description: str) -> str:
    """Return a page in Markdown: accuracies in per cent, and how often each label was taken for what.

    Args:
        report: what an evaluation found.
        task: the labels.
        title: of the page.
        description: a sentence on where the touches came from.
    """
    (_, *columns), *rows = metric_rows(report.metrics, "°")
    lines = [f"# {title}", "", description, "", *([f"Split {report.split}.", ""] if report.split else [])]
    lines += ["" if task.kind == "regression" else "Per cent:", "", f"| | {' | '.join(columns)} |"]
    lines.append("|---" * (len(columns) + 1) + "|")
    lines += [f"| {' | '.join(row)} |" for row in rows]
    lines += [f"\n{note}" for note in report.notes]
    if report.confusion is not None:
        lines += [
            "",
            "| label | no, said no | no, said yes | yes, said no | yes, said yes |",
            "|---" * 5 + "|",
        ]
        for name, counts in zip(task.binary, report.confusion.numpy().astype(int), strict=True):
            lines.append(f"| {name} | {' | '.join(map(str, counts.ravel().tolist()))} |")
    return "\n".join(lines) + "\n"


def publish_evaluation(path: Path, report: Report, task: Task, title: str, description: str) -> list[Path]:
    """Write ``path`` (.md), and the confusion matrices beside it (.png), each whole."""
    written = [write(evaluation_markdown(report, task, title, description), path)]
    if report.confusion is not None:
        named = dict(zip(task.binary, report.confusion.numpy(), strict=True))
        written.append(save_figure(confusions(named, ("no", "yes")), path.with_suffix(".png")))
    return written


def write_probabilities(probabilities: Tensor, task: Task, point: OperatingPoint | None, path: Path) -> str:
    """Write the probability of each label, gesture by gesture, where nobody knows the truth.

    Args:
        probabilities: (B, L); of a direction the mean cosines.
        task: the labels.
        point: where the alarm is raised; a gesture is said to be dangerous there, as ``live`` says it.
        path: x.csv.

    Returns:
        lines for a person.
    """
    columns = {f"p_{name}": values.numpy() for name, values in zip(task.names, probabilities.T, strict=True)}
    with whole(path) as partial:
        pa.csv.write_csv(pa.table({"gesture": np.arange(len(probabilities)), **columns}), partial)
    levels = dict.fromkeys(task.binary, 0.5) | ({} if point is None else {LABEL: point.threshold})
    lines = [
        f"gesture {number}: "
        + ", ".join(
            f"{'' if probability > levels[name] else 'not '}{name} ({probability:.2f})"
            for name, probability in zip(task.binary, row, strict=False)
        )
        + (_slide(row, task) if task.direction else "")
        for number, row in enumerate(probabilities.tolist())
    ]
    return "\n".join(lines)


def _slide(row: Sequence[float], task: Task) -> str:
    """Return where a touch slides that is said to be dynamic: 0° along x, 90° along y."""
    if row[task.names.index("dynamic")] <= 0.5:
        return ""
    return f", sliding towards {math.degrees(math.atan2(row[-1], row[-2])):.0f}°"


# Errors by distance from the class boundary and by strength of the touch.


ALARM_NAME = "alarm"
"""Name of the prediction "dangerous" at the operating point; the label itself uses a threshold of 0.5."""

_SHARES = (0, 0.5, 0.8, 0.9, 0.95, 1, 1.05, 1.1, 1.25, 2, torch.inf)  # of the threshold
_STRENGTHS = (0, 0.3, 0.5, 1, 2, 5, torch.inf)  # N; a touch of 0.3 N is six times the noise


def measure_margins(
    learner: Predictor, device: AbstractDevice, gestures: int, point: OperatingPoint
) -> tuple[pd.DataFrame, Reached]:
    """Return a learner's errors on test touches by the measures that define the labels, and by strength.

    Args:
        learner: trained on the labels of ``TOUCH``, and possibly others.
        device: its device, or another.
        gestures: number of test touches.
        point: operating point of the alarm.

    Returns:
        Rows of :func:`span_rows` for each label and ``ALARM_NAME``, and for each label rows by the largest
        reading above the idle level, N, with ``wrong`` alone; ``attrs["metrics"]`` of all touches
        (:func:`skin.evaluation.metrics.compute_metrics`). And the alarms.

    Raises:
        InputError: the device is not simulated, so that the measures are not known.
    """
    simulation = device.simulated(
        f"only simulated touches are known well enough, {type(device).__name__} has none"
    )
    recording = simulation.replace(test_gestures=gestures, stream=False, direction=False).recording(
        "test", complete=False
    )
    touches, labels = recording.touches, recording.touches.known_labels
    columns = [device.task.names.index(name) for name in TOUCH.names]
    probabilities = learner.probabilities(touches)[:, columns]
    predicted, parameters = probabilities > 0.5, recording.parameters
    settings, thresholds = simulation.sampler.settings, simulation.sampler.settings.thresholds
    limits = {  # in the order of TOUCH
        "area": thresholds.area,
        "travel": thresholds.travel,
        "frames": settings.frames.duration,
        "pressure": thresholds.pressure,
    }
    fractions = [parameters[name] / limit for name, limit in limits.items()]
    danger = TOUCH.names.index(LABEL)
    fractions[danger] = parameters.get("excess", fractions[danger])
    said = [*predicted.T, point.alarm(probabilities[:, danger])]
    names, fractions = [*TOUCH.names, ALARM_NAME], [*fractions, fractions[danger]]
    rows = [row for each in zip(names, said, fractions, strict=True) for row in span_rows(*each)]
    strengths = [*_split_ranges(_STRENGTHS, above_idle(touches).amax(dim=(1, 2)))]
    rows += [
        {"label": name, "by": "reading", "low": str(low), "high": str(high), "touches": int(inside.sum()),
         "said": "", "wrong": int(wrong[inside].sum())}
        for name, wrong in zip(TOUCH.names, (predicted != (labels > 0.5)).T, strict=True)
        for low, high, inside in strengths
    ]  # fmt: skip
    frame = pd.DataFrame(rows)
    frame.attrs["metrics"] = compute_metrics(probabilities, labels, TOUCH, point)
    return frame, point.reached(probabilities, labels, TOUCH)


def span_rows(name: str, said: Tensor, fractions: Tensor) -> Iterator[dict[str, Any]]:
    """Yield a row for each range of the measure that holds some touches; the label holds above 1.

    Its values: ``low`` and ``high`` end, as texts; number of ``touches``, of those ``said`` to have the
    label, as a text, and of the ``wrong``; ``mean`` of the measure; ``lower`` and ``upper`` end of the 95 %
    confidence interval of said over touches, exact (Clopper and Pearson, 1934).

    Args:
        name: of the label.
        said: (B,), bool, whether the learner predicts it.
        fractions: (B,), measure divided by its threshold.
    """
    from scipy.stats import binomtest  # takes half a second to import

    for low, high, inside in _split_ranges(_SHARES, fractions):
        touches, yes = int(inside.sum()), int(said[inside].sum())
        lower, upper = binomtest(yes, touches).proportion_ci(0.95)
        yield {
            "label": name, "by": "threshold", "low": str(low), "high": str(high), "touches": touches,
            "said": str(yes), "wrong": yes if high <= 1 else touches - yes,
            "mean": float(fractions[inside].mean()), "lower": float(lower), "upper": float(upper),
        }  # fmt: skip


def _split_ranges(edges: Sequence[float], values: Tensor) -> Iterator[tuple[float, float, Tensor]]:
    """Yield each range (low, high] that holds some of the values (B,), and which, bool; 0 is in the first."""
    for low, high in pairwise(edges):
        inside = (values <= high) & ((values > low) | (low == 0))
        if inside.any():
            yield low, high, inside
