"""Figures 7, 8, 10 and 11 of the report, from the outcomes and the skin of the study ``table``."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from experiments.studies.comparison import compare_samples
from experiments.studies.pages import write_csv
from skin.device.base import AbstractSimulated
from skin.evaluation.metrics import decode
from skin.mechanics.simulator.naive import Naive
from skin.plot.figures import (
    confusions,
    force_and_reading,
    misclassified,
    misclassified_shares,
    save_figure,
    traces,
)
from skin.runs.build import build_device
from skin.runs.configuration import Config
from skin.touch.labels import TOUCH

_SHOWN = ("best_fresh", "features", "temporal_graph", "sequence_graph", "sequence_image")
_SIMULATED = "the figures of the report are of a simulated skin"
_SPEEDS = np.linspace(0.03, 0.20, 7)  # m/s


def draw_report(trials: pd.DataFrame, skins: Mapping[str, Config], folder: Path) -> list[Path]:
    """Draw figures 7 and 8 of each simulator from the outcomes of all runs of each row, and 10 and 11.

    Figure 7 shows the rows of ``_SHOWN``. CSV files beside the figures have the numbers of all rows.

    Args:
        trials: of the study ``table``.
        skins: simulator -> a configuration.
        folder: of the figures.
    """
    paths = list[Path]()
    devices = {name: build_device(config).simulated(_SIMULATED) for name, config in skins.items()}
    for name, group in trials[trials.outcomes.notna()].groupby("simulator", sort=False):
        recording = devices[name].recording("test", complete=False)
        speeds = recording.parameters["speed"].numpy() * devices[name].model_rate
        codes = {
            row or "vote": np.stack([np.frombuffer(outcomes, np.uint8) for outcomes in runs.outcomes])
            for row, runs in group.groupby("row", sort=False)
        }
        paths += _draw_runs(codes, speeds, name, folder)
    name = "fem" if "fem" in devices else next(iter(devices))
    return [*paths, *draw_skin(devices[name], folder, name)]


def _draw_runs(
    codes: Mapping[str, np.ndarray], speeds: np.ndarray, simulator: str, folder: Path
) -> list[Path]:
    """Draw figures 7 and 8 from the outcomes (N, B) of the runs of each row."""
    wrong = {row: 1 - decode(outcomes, "big/accuracy", TOUCH).mean(axis=0) for row, outcomes in codes.items()}
    courses = {row: misclassified_shares(speeds, shares, _SPEEDS) for row, shares in wrong.items()}
    some = {row: courses[row] for row in _SHOWN if row in courses} or courses
    matrices = {row: _confusion(outcomes) for row, outcomes in codes.items()}
    eight, seven = folder / f"figure08_confusion_{simulator}", folder / f"figure07_speed_{simulator}"
    return [
        save_figure(confusions(matrices, ("safe", "dangerous")), eight.with_suffix(".png")),
        write_csv(confusion_rows(codes), eight.with_suffix(".csv")),
        save_figure(misclassified(some, "big", _SPEEDS), seven.with_suffix(".png")),
        write_csv(_courses(courses), seven.with_suffix(".csv")),
    ]


def _confusion(codes: np.ndarray) -> np.ndarray:
    """Return the confusion matrix of ``dangerous``, (2, 2), over runs and gestures."""
    right = decode(codes, "dangerous/accuracy", TOUCH) > 0.5
    true = ~np.isnan(decode(codes, "dangerous/alarm_recall", TOUCH))
    called = np.where(right, true, ~true)
    return np.array([[np.sum((true == row) & (called == column)) for column in (0, 1)] for row in (0, 1)])


def confusion_rows(codes: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Return both kinds of errors of ``dangerous`` of each row, their difference, its error and margin.

    Args:
        codes: row -> outcomes of its runs, (N, B).
    """
    lines = []
    for row, outcomes in codes.items():
        wrong = decode(outcomes, "dangerous/accuracy", TOUCH) < 0.5
        dangerous = ~np.isnan(decode(outcomes[0], "dangerous/alarm_recall", TOUCH))
        kinds = wrong[:, ~dangerous], wrong[:, dangerous]
        over = [kind.mean(axis=0) for kind in kinds]
        first, second = (pd.Series(kind.mean(axis=1)) for kind in kinds)
        difference = compare_samples(first, second, gestures=(over[0], over[1]))
        assert difference is not None
        numbers = (over[0].mean(), over[1].mean(), *difference[:3])
        lines.append([row, *(f"{number:.4f}" for number in numbers)])
    kinds_of = ["safe_called_dangerous", "dangerous_called_safe", "difference", "error", "margin"]
    return pd.DataFrame(lines, columns=["row", *kinds_of])


def _courses(courses: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> pd.DataFrame:
    """Return a line per row and speed."""
    slowest, fastest = [0.0, *_SPEEDS[:-1]], [0.0, *_SPEEDS[1:]]
    lines = [
        [row, f"{low:.4g}", f"{high:.4g}", f"{fraction:.4f}", f"{error:.4f}"]
        for row, course in courses.items()
        for low, high, fraction, error in zip(slowest, fastest, *course, strict=True)
    ]
    return pd.DataFrame(lines, columns=["row", "slowest_m_per_s", "fastest_m_per_s", "wrong", "error"])


def draw_skin(device: AbstractSimulated, folder: Path, name: str = "fem") -> list[Path]:
    """Draw figures 10 and 11 from the gestures of a skin whose simulator has a name."""
    recording = device.recording("test", complete=False)
    touches, drawn = recording.touches, recording.parameters
    assert recording.force is not None
    labels = dict(zip(device.task.names, touches.known_labels.T.bool(), strict=True))
    movie = device.sampler.sample(64, np.random.default_rng(0))
    chosen = int((movie.labels[:, 1:].all(1) & (movie.labels[:, 0] == 0)).nonzero()[0])
    simulators = {"naive": Naive(device.body, device.sensors), name: device.model}
    readings = {key: model.respond(movie).readings[chosen] for key, model in simulators.items()}
    blurred = drawn["shape"] == device.sampler.shapes.names.index("blurred_disc")
    presses = (blurred & ~labels["dynamic"] & labels["press"]).nonzero()[:, 0]
    presses = presses[drawn["force"][presses].argsort()]
    four = presses[torch.linspace(0, len(presses) - 1, 4).round().long()]
    courses = traces(readings, device.model_rate)
    forces = force_and_reading(recording.force[four], touches.readings[four], device.model_rate)
    return [
        save_figure(courses, folder / f"figure10_naive_{name}.png"),
        save_figure(forces, folder / "figure11_force_reading.png"),
    ]
