"""The figures of the report from finished runs and the simulated skin."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from mlflow.entities import Run
from torch import Tensor

from experiments.studies.results_table import Cell
from skin.device.base import AbstractSimulated
from skin.evaluation.metrics import confusion
from skin.plot import figures
from skin.plot.surface import deflection, surface
from skin.representation.fourier import Fourier
from skin.representation.image import Image
from skin.representation.interp import Interpolation
from skin.simulator.naive import Naive
from skin.touch.sampler import Movie
from skin.tracking import RECORDED, Store

_SPEEDS = np.linspace(0.03, 0.20, 7)  # m/s


def draw_runs(cells: Sequence[Cell], store: Store, folder: Path, rate: float) -> list[Path]:
    """Draw figures 7 and 8 of each simulator from the test predictions of every row's first run.

    Args:
        cells: the runs.
        store: that holds them.
        folder: of the figures.
        rate: of the model, Hz; predictions are stored with speeds in m per frame.

    Imported runs have no predictions; with one of them among the rows, the figures are not drawn.
    """
    paths = []
    for simulator in dict.fromkeys(cell.simulator for cell in cells):
        first = {cell.row: cell.runs[0] for cell in cells if cell.simulator == simulator and cell.runs}
        imported = [row for row, run in first.items() if RECORDED in run.data.tags]
        if imported:
            print(
                f"figures 7 and 8 of {simulator} are not drawn: {', '.join(imported)} were imported "
                "without predictions: tracking.recorded=false trains them again"
            )
        if imported or not first:
            continue
        tables = {row: _predictions(store, run) for row, run in first.items()}
        matrices, wrong = {}, {}
        for row, table in tables.items():
            matrices[row] = confusion(_column(table, "p_dangerous"), _column(table, "dangerous"))[0].numpy()
            wrong[row] = ((_column(table, "p_big") > 0.5) != (_column(table, "big") > 0.5))[:, 0].numpy()
        speeds = _column(next(iter(tables.values())), "speed")[:, 0].numpy() * rate
        drawn = figures.confusions(matrices, ("safe", "dangerous"))
        paths.append(figures.save_figure(drawn, folder / f"figure08_confusion_{simulator}.png"))
        drawn = figures.misclassified(speeds, wrong, "big", _SPEEDS)
        paths.append(figures.save_figure(drawn, folder / f"figure07_speed_{simulator}.png"))
    return paths


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


def _predictions(store: Store, run: Run) -> pa.Table:
    with TemporaryDirectory() as folder:
        path = store.client.download_artifacts(run.info.run_id, "predictions.parquet", folder)
        return pq.read_table(path, memory_map=False)


def _column(table: pa.Table, name: str) -> Tensor:
    """Return a column as (B, 1)."""
    return torch.from_numpy(table[name].to_numpy().copy())[:, None]
