"""The figures of the report from finished runs and the simulated skin."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from experiments.studies.comparison import paired
from experiments.studies.runs import row_and_simulator
from experiments.studies.tables import csv_text
from experiments.studies.trials import Trial
from skin.core.files import write
from skin.device.base import AbstractSimulated
from skin.evaluation.metrics import decode
from skin.mechanics.simulator.naive import Naive
from skin.plot import figures
from skin.runs.build import build_device
from skin.touch.labels import TOUCH

_SHOWN = ("best_fresh", "features", "temporal_graph", "sequence_graph", "sequence_image")
_SIMULATED = "the figures of the report are of a simulated skin"
_SPEEDS = np.linspace(0.03, 0.20, 7)  # m/s


def draw_report(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Draw figures 7 and 8 of each simulator from the outcomes of all runs of each row, and 10 and 11.

    Figure 7 shows the rows of ``_SHOWN``. CSV files beside the figures have the numbers of all rows.

    Args:
        trials: of the study ``table``.
        folder: of the figures.
    """
    paths, skins = list[Path](), dict[str, AbstractSimulated]()
    codes: dict[str, dict[str, list[np.ndarray]]] = {}
    for trial in trials:
        row, simulator = row_and_simulator(trial.variant)
        if trial.outcomes is not None:
            rows = codes.setdefault(simulator, {})
            rows.setdefault(row or "vote", []).append(trial.outcomes)
        for config in trial.variant.configs.values():
            if simulator not in skins:
                skins[simulator] = build_device(config).simulated(_SIMULATED)
    for simulator, outcomes in codes.items():
        skin = skins[simulator]
        speeds = skin.recording("test", complete=False).parameters["speed"].numpy() * skin.model_rate
        paths += _draw_runs(
            {row: np.array(each) for row, each in outcomes.items()}, speeds, simulator, folder
        )
    name = "fem" if "fem" in skins else next(iter(skins))
    return [*paths, *draw_skin(skins[name], folder, name)]


def _draw_runs(
    codes: Mapping[str, np.ndarray], speeds: np.ndarray, simulator: str, folder: Path
) -> list[Path]:
    """Draw figures 7 and 8 from the outcomes (N, B) of the runs of each row."""
    wrong = {row: 1 - decode(each, "big/accuracy", TOUCH).mean(axis=0) for row, each in codes.items()}
    courses = {row: figures.misclassified_shares(speeds, each, _SPEEDS) for row, each in wrong.items()}
    some = {row: courses[row] for row in _SHOWN if row in courses} or courses
    matrices = {row: _confusion(each) for row, each in codes.items()}
    eight, seven = folder / f"figure08_confusion_{simulator}", folder / f"figure07_speed_{simulator}"
    return [
        figures.save_figure(figures.confusions(matrices, ("safe", "dangerous")), eight.with_suffix(".png")),
        write(csv_text(confusion_rows(codes)), eight.with_suffix(".csv")),
        figures.save_figure(figures.misclassified(some, "big", _SPEEDS), seven.with_suffix(".png")),
        write(csv_text(_courses(courses)), seven.with_suffix(".csv")),
    ]


def _confusion(codes: np.ndarray) -> np.ndarray:
    """Return the confusion matrix of ``dangerous``, (2, 2), over runs and gestures."""
    right = decode(codes, "dangerous/accuracy", TOUCH) > 0.5
    true = ~np.isnan(decode(codes, "dangerous/alarm_recall", TOUCH))
    called = np.where(right, true, ~true)
    return np.array([[np.sum((true == row) & (called == column)) for column in (0, 1)] for row in (0, 1)])


def confusion_rows(codes: Mapping[str, np.ndarray]) -> list[list[str]]:
    """Return both kinds of errors of ``dangerous`` of each row, their difference, its error and margin.

    Args:
        codes: row -> outcomes of its runs, (N, B).
    """
    lines = [["row", "safe_called_dangerous", "dangerous_called_safe", "difference", "error", "margin"]]
    for row, outcomes in codes.items():
        wrong = decode(outcomes, "dangerous/accuracy", TOUCH) < 0.5
        dangerous = ~np.isnan(decode(outcomes[0], "dangerous/alarm_recall", TOUCH))
        kinds = wrong[:, ~dangerous], wrong[:, dangerous]
        safe, missed = ({str(run): float(share.mean()) for run, share in enumerate(kind)} for kind in kinds)
        over = kinds[0].mean(axis=0), kinds[1].mean(axis=0)
        difference = paired(safe, missed, gestures=over)
        assert difference is not None
        numbers = (over[0].mean(), over[1].mean(), difference.mean, difference.error, difference.margin)
        lines.append([row, *(f"{number:.4f}" for number in numbers)])
    return lines


def _courses(courses: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[list[str]]:
    """Return a line per row and speed."""
    ends = [(0.0, 0.0), *pairwise(_SPEEDS)]
    return [["row", "slowest_m_per_s", "fastest_m_per_s", "wrong", "error"]] + [
        [row, f"{low:.4g}", f"{high:.4g}", f"{share:.4f}", f"{error:.4f}"]
        for row, course in courses.items()
        for (low, high), share, error in zip(ends, *course, strict=True)
    ]


def draw_skin(device: AbstractSimulated, folder: Path, name: str = "fem") -> list[Path]:
    """Draw figures 10 and 11 from the gestures of a skin whose simulator has a name."""
    recording = device.recording("test", complete=False)
    touches, drawn = recording.touches, recording.parameters
    assert touches.labels is not None
    assert recording.force is not None
    labels = dict(zip(device.task.names, touches.labels.T.bool(), strict=True))
    movie = device.sampler.sample(64, np.random.default_rng(0))
    chosen = int((movie.labels[:, 1:].all(1) & (movie.labels[:, 0] == 0)).nonzero()[0])
    simulators = {"naive": Naive(device.body, device.sensors), name: device.model}
    readings = {key: model.respond(movie).readings[chosen] for key, model in simulators.items()}
    blurred = drawn["shape"] == device.sampler.shapes.names.index("blurred_disc")
    presses = (blurred & ~labels["dynamic"] & labels["press"]).nonzero()[:, 0]
    presses = presses[drawn["force"][presses].argsort()]
    four = presses[torch.linspace(0, len(presses) - 1, 4).round().long()]
    traces = figures.traces(readings, device.model_rate)
    forces = figures.force_and_reading(recording.force[four], touches.readings[four], device.model_rate)
    return [
        figures.save_figure(traces, folder / f"figure10_naive_{name}.png"),
        figures.save_figure(forces, folder / "figure11_force_reading.png"),
    ]
