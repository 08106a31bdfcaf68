"""Compare placements with those of PySensors, a regular grid and random choices.

skin design --config-dir experiments/peers/conf design=comparison
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, TypeVar

import numpy as np
from annotated_types import Ge, Gt, MinLen
from omegaconf import DictConfig, OmegaConf
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from experiments.peers import python
from experiments.peers.base import WORKER
from experiments.studies.tables import csv_text, print_table
from skin.build import build_device
from skin.design.placement import exchange, greedy, mutual_information, too_near
from skin.design.placement_problem import PlacementProblem, best_of_random
from skin.design.readings import sampled_readings
from skin.design.relaxation import upper_bound
from skin.errors import InputError
from skin.files import write
from skin.paths import ROOT
from skin.settings import checked

_Found = TypeVar("_Found")

_HEAD = (
    "sheet",
    "sensors",
    "method",
    "information_nats",
    "bound_nats",
    "share_of_bound",
    "nearest_m",
    "cpu_seconds",
)


@checked("design")
@dataclass(frozen=True)
class Comparison:
    """Places sensors by several methods from the same readings and compares the information.

    ``run`` writes ``placement.csv``. Methods are ``placed`` (:class:`skin.design.place.Place`),
    ``pysensors_qr`` and ``pysensors_gqr``, ``grid`` and ``best_of_random``. Without the environment of the
    peers, the methods of PySensors are left out. ``nearest_m`` is the least distance of two sensors:
    ``pysensors_qr`` and ``grid`` do not take ``distance`` into account. ``cpu_seconds`` is the
    processor time of the choice from the readings, with that of their covariance or of PySensors' basis and
    without that of the bound.

    Args:
        cases: extent (x, y) of the body, m, and number of sensors. Cells keep their size.
        touches: number of sampled touches.
        seed: of the touches and of the random choices.
        noise: standard deviation of a reading, N.
        clip: largest force that a sensor measures, N.
        distance: least distance of two sensors, m.

    Raises:
        InputError: invalid settings.
    """

    cases: Annotated[Sequence[tuple[PositiveFloat, PositiveFloat, PositiveInt]], MinLen(1)]
    touches: Annotated[int, Ge(100)]
    seed: NonNegativeInt
    noise: Annotated[float, Gt(0)]
    clip: PositiveFloat
    distance: Annotated[float, Ge(0)]

    def run(self, config: DictConfig, folder: Path) -> None:
        """Compare the methods, print the table and write it.

        Args:
            config: the whole configuration.
            folder: of the file.

        Raises:
            InputError: no site, too few sites, a device without simulation, or an environment of the peers
                without PySensors.
        """
        if not python().is_file():
            print(
                f"left out PySensors, because there is no {python()}: make peers builds it", file=sys.stderr
            )
        table = [_HEAD, *(line for case in self.cases for line in self._lines(config, case))]
        print_table(table, f"placements, {self.touches} touches, noise {self.noise:g} N")
        print(write(csv_text(table), folder / "placement.csv"))

    def _lines(self, config: DictConfig, case: tuple[float, float, int]) -> Iterator[list[str]]:
        """Yield one line of the table per method."""
        *size, count = case
        problem, readings = self._sample(config, size, count)
        signal, spent = _timed(lambda: np.cov(readings.T, bias=True) / self.noise**2)
        bound = upper_bound(signal[: problem.sites, : problem.sites], count)
        places = problem.sensors.positions[:, :2]
        for method, sites, seconds in self._choices(problem, readings, signal, spent):
            information = mutual_information(signal, sites)
            apart = np.linalg.norm(places[sites, None] - places[sites], axis=-1)
            nearest = apart[np.triu_indices(count, 1)].min(initial=np.inf)
            sheet = " x ".join(f"{1000 * extent:g}" for extent in size) + " mm"
            numbers = f"{information:.2f}", f"{bound:.2f}", f"{information / bound:.4f}", f"{nearest:.4f}"
            yield [sheet, str(count), method, *numbers, f"{seconds:.2f}"]

    def _sample(
        self, config: DictConfig, size: Sequence[float], count: int
    ) -> tuple[PlacementProblem, np.ndarray]:
        """Return the sites of a body of another size, and the readings of all its sensors, (F, C), N."""
        pitch = np.divide(config.body.size, config.body.cells)
        cells = [max(1, round(float(one))) for one in np.divide(size, pitch)]
        changes = {"body": {"size": list(size), "cells": cells}, "touch": {"over_sensors": False}}
        merged = OmegaConf.merge(config, changes)
        assert isinstance(merged, DictConfig)
        device = build_device(merged).simulated("sensors are placed by simulated touches")
        problem = PlacementProblem.of(device, None, count, (), self.distance, None)
        parts = sampled_readings(device, problem.sensors, self.touches, self.seed, self.clip)
        return problem, np.concatenate(list(parts))

    def _choices(
        self, problem: PlacementProblem, readings: np.ndarray, signal: np.ndarray, spent: float
    ) -> Iterator[tuple[str, Sequence[int], float]]:
        """Yield name, sites and processor time, s, of each method; ``spent`` is that of the covariance."""
        number, count = problem.sites, problem.count
        places, inner = problem.sensors.positions[:number, :2], signal[:number, :number]
        near = too_near(places, self.distance)
        placed, seconds = _timed(lambda: exchange(inner, greedy(inner, count, near), near))
        yield "placed", placed, spent + seconds
        if python().is_file():
            arrays = {"readings": readings[:, :number], "places": places}
            for method, found in ask(arrays, count=count, distance=self.distance).items():
                yield method, found["sites"], found["cpu_seconds"]
        grid = range(int(problem.layout[-1]) + 1, len(signal))
        if grid:
            yield "grid", grid, 0.0
        drawn, seconds = _timed(lambda: best_of_random(inner, count, near, seed=self.seed))
        if drawn:
            yield "best_of_random", drawn, spent + seconds


def _timed(compute: Callable[[], _Found]) -> tuple[_Found, float]:
    began = time.process_time()
    return compute(), time.process_time() - began


def ask(arrays: dict[str, np.ndarray], **request: Any) -> dict[str, Any]:
    """Return the answer of the worker to a request to place sensors.

    Args:
        arrays: ``readings`` and ``places`` (:func:`experiments.peers.worker.sensor_sites.sensor_sites`).
        request: ``count`` and ``distance``.

    Raises:
        InputError: PySensors is not installed there.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "readings.npz"
        np.savez(path, **arrays)  # type: ignore[arg-type]
        line = json.dumps({"do": "place", "path": str(path), **request})
        done = subprocess.run(
            [python(), "-m", WORKER], cwd=ROOT, input=line, stdout=subprocess.PIPE, text=True, check=True
        )
    answer = json.loads(done.stdout)
    if answer.get("error", "").startswith("ModuleNotFoundError"):
        raise InputError(f"{python()} has no PySensors ({answer['error']}): make peers installs it")
    if "error" in answer:
        raise RuntimeError(answer["error"])
    return answer
