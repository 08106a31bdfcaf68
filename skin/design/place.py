"""Place sensors where their readings tell most about touches."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Ge, Gt
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from skin.body.base import Sensors
from skin.core.files import json_text, write
from skin.core.rng import Stream, generator
from skin.core.settings import checked
from skin.design.drawing import placement
from skin.design.placement import PlacementProblem, Zones, keep_out
from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated, build_model
from skin.errors import InputError
from skin.plot.figures import save_figure
from skin.runs.build import SkinModel
from skin.touch.movie import Movie

# The readings that sampled touches give at any sites of a skin, and their covariance.


_BATCH = 256


@torch.no_grad()
def reading_covariance(
    device: Simulated, sensors: Sensors, touches: int, seed: int, clip: float
) -> tuple[np.ndarray, int]:
    """Return the covariance of the readings of sampled touches, and from how many frames it is.

    Only frames with contact count. Labels are balanced. The touches belong to no split of the device.

    Args:
        device: samples and simulates the touches.
        sensors: C sites.
        touches: their number.
        seed: of the touches.
        clip: largest reading, N.

    Returns:
        covariance (C, C), N^2, and the number of frames.
    """
    read = _reader(device, sensors)
    wanted = device.sampler.balanced(touches, generator(Stream.PLACEMENT, seed, 0))
    parts = [wanted[first : first + _BATCH] for first in range(0, touches, _BATCH)]
    shown = track(parts, "sampling touches", console=Console(stderr=True), disable=not sys.stderr.isatty())
    total, squares, frames = np.zeros(len(sensors)), np.zeros((len(sensors), len(sensors))), 0
    for number, labels in enumerate(shown):
        movie = device.sampler.sample(len(labels), generator(Stream.PLACEMENT, seed, 1 + number), labels)
        readings = read(movie).clamp(-clip, clip).double().numpy()
        total, squares = total + readings.sum(axis=0), squares + readings.T @ readings
        frames += len(readings)
    mean = total / frames
    return squares / frames - np.outer(mean, mean), frames


def _reader(device: Simulated, sensors: Sensors) -> Callable[[Movie], Tensor]:
    """Return a function that gives the readings (F, C), N, of all frames with contact of a movie."""
    rows = None if device.sampler.settings.shear else device.model.pressure_rows(sensors)
    if rows is None:
        model = build_model(device.simulator, device.body, sensors, device.model_rate)
        return lambda movie: model.respond(movie).readings[movie.scale > 0]
    operator = torch.from_numpy(rows.T.copy()).float()

    def read(movie: Movie) -> Tensor:
        touched = movie.scale > 0
        return (movie.frames.flatten(1) @ operator)[movie.index[touched]] * movie.scale[touched, None]

    return read


@checked("design")
@dataclass(frozen=True)
class Place:
    """Chooses sites for sensors by the mutual information of noisy and true readings of sampled touches.

    ``run`` writes ``placement.csv``, a layout for ``layout=file layout.path=...``; ``placement.json``, with
    the information of the placement and of other layouts; and ``placement.png``. Sensors that stay come first
    in the layout, in their order. The others follow in rows from the upper left. New sensors lie at the depth
    of most sensors of the layout and face the surface.

    Args:
        count: number of sensors, with those that stay; None: as many as the layout.
        touches: number of sampled touches.
        seed: of the touches.
        noise: standard deviation of a reading, N; None: the median of the device's sensors.
        distance: least distance of a new sensor from all others, m.
        raster: pitch of the sites, or pitches along x and y, m; None: the cells of the body.
        keep_out: polygons (x, y), m, or the path of a picture (:func:`skin.design.placement.keep_out`).
        keep: sensors of the layout that stay, numbered from 1, or ``all``.

    Raises:
        InputError: invalid settings.
    """

    count: PositiveInt | None = None
    touches: Annotated[int, Ge(100)] = 3000
    seed: NonNegativeInt = 0
    noise: Annotated[float, Gt(0)] | None = None
    distance: Annotated[float, Ge(0)] = 0.012
    raster: PositiveFloat | tuple[PositiveFloat, PositiveFloat] | None = None
    keep_out: str | Zones | None = None
    keep: Literal["all"] | Sequence[PositiveInt] = ()

    def run(self, skin: SkinModel, make_device: Callable[[], AbstractDevice], folder: Path) -> None:
        """Place the sensors of a skin, print a table and write the files.

        Args:
            skin: not needed.
            make_device: returns the simulated device of the skin.
            folder: of the files.

        Raises:
            InputError: no site, too few sites, a device without simulation or without noise.
        """
        started = time.perf_counter()
        device = make_device().simulated("sensors are placed by simulated touches")
        # Gestures must not depend on the layout that is to be replaced.
        device = device.replace(touch=replace(device.sampler.settings, over_sensors=False))
        forbidden = keep_out(self.keep_out, device.size)
        problem = PlacementProblem.of(device, forbidden, self.count, self.keep, self.distance, self.raster)
        noise = _median(device.constants.noise) if self.noise is None else self.noise
        if noise == 0:
            raise InputError(
                "placement needs sensors with noise, got device.noise=0: set design.noise=0.05, or another "
                "standard deviation in N"
            )
        clip = _median(device.constants.clip)
        covariance, frames = reading_covariance(device, problem.sensors, self.touches, self.seed, clip)
        with Console(stderr=True).status("placing sensors"):
            chosen, outcome = problem.solve(covariance / noise**2)
        settings: dict[str, Any] = {"sites": problem.sites, "touches": self.touches, "frames": frames}
        settings |= {"noise_N": noise, "clip_N": clip, "distance_m": self.distance}
        content = settings | outcome | {"seconds": round(time.perf_counter() - started, 1)}
        table = Table(
            "layout",
            "sensors",
            "information, nats",
            title=f"{content['sites']} sites, {content['touches']} touches, {content['seconds']:g} s",
        )
        for name, layout in {"placed": content, **content["layouts"]}.items():
            table.add_row(name.replace("_", " "), str(layout["sensors"]), f"{layout['information_nats']:.1f}")
        Console().print(table)
        self._write(problem, chosen, content, forbidden, folder)

    def _write(
        self,
        problem: PlacementProblem,
        chosen: np.ndarray,
        content: Mapping[str, Any],
        forbidden: np.ndarray | None,
        folder: Path,
    ) -> None:
        positions = problem.sensors.positions[:, :2]
        figure = placement(
            positions[chosen],
            positions[problem.layout],
            positions[: problem.sites],
            problem.body.size,
            forbidden,
            f"{content['information_nats']:.1f} nats",
        )
        print(
            write(_csv(problem.sensors, chosen), folder / "placement.csv"),
            write(json_text(content), folder / "placement.json"),
            save_figure(figure, folder / "placement.png"),
            sep="\n",
        )


def _median(constants: Tensor) -> float:
    """Return the median of constants of sensors without the digits that float32 adds."""
    return float(f"{float(constants.median()):.6g}")


def _csv(sensors: Sensors, rows: np.ndarray) -> str:
    """Return some sensors as the text of a layout file, to the micrometre."""
    names, columns = ["x_m", "y_m", "depth_m"], [sensors.positions[rows]]
    if sensors.tilted[rows].any():
        names, columns = [*names, "normal_x", "normal_y", "normal_z"], [*columns, sensors.normals[rows]]
    lines = (",".join(f"{value:.6f}" for value in row) for row in np.hstack(columns))
    return "\n".join([",".join(names), *lines]) + "\n"
