"""The local precision against the thickness of the skin and the number of sensors."""

import csv
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MinLen
from pydantic import PositiveFloat, PositiveInt
from rich.console import Console
from rich.progress import track

from skin.body.base import Layer
from skin.body.layout import Footprint, Grid
from skin.body.material import Material
from skin.core.files import whole
from skin.core.settings import checked
from skin.design.precision import Findings, LocalPrecision
from skin.errors import InputError
from skin.runs.build import SkinModel, build_skin
from skin.runs.configuration import Config

Pair = tuple[PositiveInt, PositiveInt]


@dataclass(frozen=True)
class Step:
    """One combination of thickness and sensors.

    Attributes:
        thickness: of the layer, m.
        grid: rows and columns of sensors.
        pitch: distance of neighbouring sensors, the mean of both directions, m.
        findings: for each force.
    """

    thickness: float
    grid: tuple[int, int]
    pitch: float
    findings: list[Findings]

    def lines(self) -> Iterator[dict[str, float]]:
        """Yield one line of a table per force."""
        rows, columns = self.grid
        for finding in self.findings:
            about = {"thickness_m": self.thickness, "rows": rows, "columns": columns, "pitch_m": self.pitch}
            yield about | asdict(finding)


@checked("design")
@dataclass(frozen=True, kw_only=True)
class Sweep(LocalPrecision):
    """Computes the local precision of one layer for several thicknesses and regular grids of sensors.

    Args:
        material: of the layer, as in ``body.layers``.
        thicknesses: of the layer, m.
        grids: rows and columns of sensors.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        height: of the sensors above the base, m.
    """

    material: str | Mapping[str, Any] = "EcoFlex 00-30"
    thicknesses: Annotated[Sequence[PositiveFloat], MinLen(1)] = (0.01, 0.015, 0.02, 0.025, 0.03, 0.04)
    grids: Annotated[Sequence[Pair], MinLen(1)] = tuple((count, count) for count in range(3, 9))
    footprint: Footprint = (0.01, 0.01)
    height: PositiveFloat = 0.0005

    def run(self, config: Config, folder: Path) -> None:
        """Write design_sweep.csv and design_sweep.png.

        Raises:
            InputError: a skin that cannot be built, a simulator without mechanics, or sensors outside the
                layer.
        """
        from skin.design.drawing import draw_sweep, print_sweep

        skin = build_skin(config)
        cases = [
            (thickness, (rows, columns)) for thickness in self.thicknesses for rows, columns in self.grids
        ]
        console, interactive = Console(stderr=True), sys.stderr.isatty()
        steps = [
            self.step(skin, *case)
            for case in track(cases, "solving", console=console, disable=not interactive)
        ]
        print_sweep(steps)
        path = folder / "design_sweep.csv"
        with whole(path) as partial, partial.open("w", newline="") as file:
            lines = [line for step in steps for line in step.lines()]
            writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
        print(path, draw_sweep(steps, folder / "design_sweep.png"), sep="\n")

    def step(self, skin: SkinModel, thickness: float, grid: tuple[int, int]) -> Step:
        """Return the findings of one layer with a grid of sensors.

        Args:
            skin: its body gives extent and cells, and its simulator the mechanics.
            thickness: m.
            grid: rows and columns.

        Raises:
            InputError: as of :meth:`run`.
        """
        if thickness <= self.height:
            raise InputError(
                f"design.height={self.height:g} m is not inside a layer of {thickness:g} m: give less"
            )
        body = replace(skin.body, layers=(Layer(Material.of(self.material), thickness),))
        sensors = Grid(*grid, footprint=self.footprint, depth=thickness - self.height).sensors(body)
        simulator = skin.simulator(body, sensors)
        if not simulator.mechanical:
            raise InputError("a sweep over thickness needs a simulator with mechanics: set simulator=solid")
        pitch = sum(side / count for side, count in zip(body.size, grid[::-1], strict=True)) / 2
        return Step(thickness, grid, pitch, self.find(simulator, body))
