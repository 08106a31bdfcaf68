"""The figures of the report from finished runs and the simulated skin."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from experiments.studies.comparison import paired
from experiments.studies.results_table import Cell
from experiments.studies.runs import load_outcomes
from experiments.studies.tables import csv_text
from skin.build import build_device
from skin.device.base import AbstractSimulated
from skin.evaluation.metrics import decode
from skin.files import write
from skin.labels import TOUCH
from skin.plot import figures
from skin.plot.surface import deflection, surface
from skin.representation.fourier import Fourier
from skin.representation.image import Image
from skin.representation.interp import Interpolation
from skin.simulator.naive import Naive
from skin.touch.sampler import Movie
from skin.tracking import Store

_SHOWN = ("best_fresh", "features", "temporal_graph", "sequence_graph", "sequence_image")
_SPEEDS = np.linspace(0.03, 0.20, 7)  # m/s


def draw_runs(
    cells: Sequence[Cell], store: Store, folder: Path, skins: Mapping[str, DictConfig]
) -> list[Path]:
    """Draw figures 7 and 8 of each simulator from the outcomes of all runs of each row.

    Figure 7 shows the rows of ``_SHOWN``. CSV files beside the figures have the numbers of all rows.

    Args:
        cells: the runs.
        store: that holds them.
        folder: of the figures.
        skins: simulator -> a configuration with its test gestures.
    """
    paths = []
    for simulator, config in skins.items():
        found = {cell.row: _codes(cell, store) for cell in cells if cell.simulator == simulator}
        codes = {row: each for row, each in found.items() if len(each)}
        if not codes:
            continue
        device = build_device(config).simulated("the figures of the report are of a simulated skin")
        speeds = device.recording("test", complete=False).parameters["speed"].numpy() * device.model_rate
        matrices = {row: _confusion(each) for row, each in codes.items()}
        drawn = figures.confusions(matrices, ("safe", "dangerous"))
        path = folder / f"figure08_confusion_{simulator}"
        paths.append(figures.save_figure(drawn, path.with_suffix(".png")))
        paths.append(write(csv_text(confusion_rows(codes)), path.with_suffix(".csv")))
        wrong = {row: 1 - decode(each, "big/accuracy", TOUCH).mean(axis=0) for row, each in codes.items()}
        courses = {row: figures.misclassified_shares(speeds, each, _SPEEDS) for row, each in wrong.items()}
        shown = {row: courses[row] for row in _SHOWN if row in courses} or courses
        drawn = figures.misclassified(shown, "big", _SPEEDS)
        path = folder / f"figure07_speed_{simulator}"
        paths.append(figures.save_figure(drawn, path.with_suffix(".png")))
        paths.append(write(csv_text(_courses(courses)), path.with_suffix(".csv")))
    return paths


def _codes(cell: Cell, store: Store) -> np.ndarray:
    """Return the outcomes of the runs of a row that have some, (N, B)."""
    each = [load_outcomes(store, run) for run in cell.runs]
    return np.array([one for one in each if one is not None])


def _confusion(codes: np.ndarray) -> np.ndarray:
    """Return the confusion matrix of ``dangerous``, (2, 2), over runs and gestures."""
    right = decode(codes, "dangerous/accuracy", TOUCH) > 0.5
    true = ~np.isnan(decode(codes, "dangerous/alarm_recall", TOUCH))
    said = np.where(right, true, ~true)
    return np.array([[np.sum((true == row) & (said == column)) for column in (0, 1)] for row in (0, 1)])


def confusion_rows(codes: Mapping[str, np.ndarray]) -> list[list[str]]:
    """Return both kinds of errors of ``dangerous`` of each row, their difference, its error and margin.

    Args:
        codes: row -> outcomes of its runs, (N, B).
    """
    lines = [["row", "safe_called_dangerous", "dangerous_called_safe", "difference", "error", "margin"]]
    for row, each in codes.items():
        wrong = decode(each, "dangerous/accuracy", TOUCH) < 0.5
        dangerous = ~np.isnan(decode(each[0], "dangerous/alarm_recall", TOUCH))
        kinds = wrong[:, ~dangerous], wrong[:, dangerous]
        one, other = ({str(run): float(share.mean()) for run, share in enumerate(kind)} for kind in kinds)
        over = kinds[0].mean(axis=0), kinds[1].mean(axis=0)
        found = paired(one, other, gestures=over)
        assert found is not None
        numbers = (over[0].mean(), over[1].mean(), found.mean, found.error, found.margin)
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
    """Draw figures 2, 3, 4, 10 and 11 from the gestures of a skin whose simulator has a name."""
    recording = device.recording("test", complete=False)
    touches, drawn = recording.touches, recording.parameters
    assert touches.labels is not None
    assert recording.force is not None
    labels = dict(zip(device.task.names, touches.labels.T.bool(), strict=True))
    sliding = int((labels["big"] & labels["dynamic"] & labels["press"] & labels["dangerous"]).nonzero()[0])
    pictures = _pictures(touches[sliding : sliding + 1].readings, touches.positions, device.size)
    image = figures.images(pictures, device.sensors.positions, device.size)

    movie = device.sampler.sample(64, np.random.default_rng(0))
    chosen = int((movie.labels[:, 1:].all(1) & (movie.labels[:, 0] == 0)).nonzero()[0])
    simulators = {"naive": Naive(device.body, device.sensors), name: device.model}
    readings = {name: model.respond(movie).readings[chosen] for name, model in simulators.items()}

    blurred = drawn["shape"] == device.sampler.shapes.names.index("blurred_disc")
    presses = (blurred & ~labels["dynamic"] & labels["press"]).nonzero()[:, 0]
    presses = presses[drawn["force"][presses].argsort()]
    four = presses[torch.linspace(0, len(presses) - 1, 4).round().long()]
    return [
        _overview(device, folder),
        *_hand(device, folder),
        figures.save_figure(image, folder / "figure04_interpolations.png"),
        figures.save_figure(
            figures.traces(readings, device.model_rate), folder / f"figure10_naive_{name}.png"
        ),
        figures.save_figure(
            figures.force_and_reading(recording.force[four], touches.readings[four], device.model_rate),
            folder / "figure11_force_reading.png",
        ),
    ]


def _hand(device: AbstractSimulated, folder: Path) -> list[Path]:
    """Draw both faces of the top layer under a big press of the hand, or of whatever presses without one."""
    movie, chosen = _press(device, [True, False, True, False])
    frame = movie.index[chosen, int(movie.scale[chosen].argmax())]
    moved = deflection(device.body, movie.frames[frame : frame + 1])[0]
    name, size = device.sampler.shapes.names[int(movie.parameters["shape"][chosen])], device.size
    faces = {"figure02_hand_top": -1, "figure03_hand_bottom": max(-2, -len(moved))}
    paths = []
    for file, level in faces.items():
        depth = device.body.interfaces[level]
        where = f"{1e3 * depth:g} mm below the surface" if depth else "the surface"
        drawn = surface(moved[level], depth, size, f"finite elements, {name}: {where}")
        paths.append(figures.save_figure(drawn, folder / f"{file}.png"))
    return paths


def _press(device: AbstractSimulated, labels: Sequence[bool]) -> tuple[Movie, int]:
    """Return 64 gestures with given labels, and which of them is a hand's, or the first without a hand."""
    movie = device.sampler.sample(64, np.random.default_rng(0), np.tile(labels, (64, 1)))
    names = device.sampler.shapes.names
    shape = names.index("hand") if "hand" in names else 0
    return movie, int((movie.parameters["shape"] == shape).int().argmax())


def _overview(device: AbstractSimulated, folder: Path) -> Path:
    """Draw a big, sliding, dangerous press of the hand, or of whatever presses where there is no hand."""
    movie, chosen = _press(device, [True] * 4)
    readings = device.model.respond(movie).readings[chosen]
    frame = int(readings.sum(1).argmax())
    positions = torch.from_numpy(device.sensors.positions).float()
    picture = _pictures(readings[None], positions, device.size)["cubic"]
    drawn = figures.overview(
        movie.pressure()[chosen, frame],
        picture,
        readings,
        frame,
        device.sensors.positions,
        (device.size, device.model_rate),
    )
    return figures.save_figure(drawn, folder / "overview.png")


def _pictures(readings: Tensor, positions: Tensor, size: tuple[float, float]) -> dict[str, Tensor]:
    """Return the strongest frame of readings (1, T, S) in every image representation, (H, W) each."""
    strongest = int(readings[0].sum(1).argmax())
    frame = readings[:, strongest : strongest + 1]
    makers = {
        "image": Image(positions, size),
        **{
            method: Interpolation(positions, size, method=method) for method in ("nearest", "linear", "cubic")
        },
        "fourier": Fourier(positions, size),
    }
    valid = torch.ones_like(frame, dtype=torch.bool)
    return {name: make(frame, valid).x[0, 0, 0] for name, make in makers.items()}
