"""The local precision of a skin for fingertips, blind touches and the receptive radius; a sweep over designs.

The local precision describes touches near the true one. It is no limit for estimators
(:mod:`skin.design.precision`).
"""

import csv
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Ge, Gt, MinLen
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from rich.console import Console
from rich.progress import track
from scipy.stats.qmc import Halton
from torch import Tensor

from skin.body.base import AbstractBody, Layer
from skin.body.layout import Footprint, Grid
from skin.body.material import Material
from skin.core.files import json_text, whole, write
from skin.core.settings import RISING, checked
from skin.errors import InputError
from skin.inference.noise import Noise
from skin.mechanics.geometry import PARAMETERS, Fingertip
from skin.mechanics.simulator.base import AbstractSimulator
from skin.runs.build import SkinModel, build_skin
from skin.runs.configuration import Config

# Covariance of the parameters given the readings, to first order: (J' R^-1 J + P)^-1, with the slopes J, the
# variances R of the noise and the inverse variances P of the priors (Van Trees, Detection, Estimation, and
# Modulation Theory, 2.4). It is no limit for estimators: a silent sensor has no slope, yet tells that the
# touch is not near it. Above a single sensor the exact posterior is several times narrower.

_AT_ONCE = 64  # touches; their samples then take about 50 MB with all derivatives


@dataclass(frozen=True)
class Sensitivity:
    """Readings of touches, and their derivatives.

    Attributes:
        readings: (B, S), N.
        slopes: (B, S, 4), with respect to the parameters of :data:`skin.mechanics.geometry.PARAMETERS`.
    """

    readings: Tensor
    slopes: Tensor

    def of_force(self, force: float) -> "Sensitivity":
        """Return the sensitivity to ``force`` times the force.

        A simulator is positively homogeneous: only the derivative with respect to the force stays.
        """
        factors = torch.tensor([force, force, force, 1.0]).to(self.slopes)
        return Sensitivity(self.readings * force, self.slopes * factors)


def sensitivity(simulator: AbstractSimulator, fingertip: Fingertip, touches: Tensor) -> Sensitivity:
    """Return readings and their derivatives, by forward-mode automatic differentiation.

    Args:
        simulator: maps pressure to readings; its buffers become float64.
        fingertip: the loads of a touch.
        touches: (B, 4).
    """
    simulator.double()
    parts = list(_parts(simulator, fingertip, touches.double()))
    return Sensitivity(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _parts(
    simulator: AbstractSimulator, fingertip: Fingertip, touches: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    for part in touches.split(_AT_ONCE):
        slopes = []
        for axis in range(len(PARAMETERS)):
            along = torch.zeros_like(part)
            along[:, axis] = 1
            # Touches do not influence each other, so one direction serves all of them.
            pair = torch.func.jvp(lambda touch: simulator.press(fingertip(touch)).readings, (part,), (along,))
            slopes.append(pair[1])
        yield pair[0], torch.stack(slopes, dim=-1)


def local_covariance(sensitivity: Sensitivity, noise: Noise, priors: Tensor) -> Tensor:
    """Return the covariance of the parameters given the readings, to first order, (B, 4, 4), m and N.

    Args:
        sensitivity: of the touches.
        noise: of the readings.
        priors: standard deviation of each parameter before the touch, (4,) or (B, 4), m and N.
    """
    weights = 1 / noise.variance(sensitivity.readings)
    # Parameters in units of their priors: the matrix is then well conditioned.
    slopes = sensitivity.slopes * priors[..., None, :].to(sensitivity.slopes)
    information = torch.einsum("bsi,bs,bsj->bij", slopes, weights, slopes) + torch.eye(len(PARAMETERS))
    scales = priors.to(slopes)
    return torch.linalg.inv(information) * scales[..., :, None] * scales[..., None, :]


_UNITS = {
    **dict.fromkeys(("radii", "rim", "margin"), "_m"),
    **dict.fromkeys(("forces", "noise", "clip"), "_N"),
    "gain": "_relative",
}

Lengths = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]


@dataclass(frozen=True)
class Findings:
    """Local precision of touches with one force, as standard deviations.

    Attributes:
        force_N: of the touches.
        blind_share: touches that raise no sensor above three standard deviations of the noise of a frame.
        place_m: of the place, the root of the mean variance along x and y, median over touches.
        place_90_m: its 90 % quantile.
        radius_m: of the radius, median over touches.
        force_relative: of the force, as a share of it, median over touches.
        receptive_radius_m: radius of the disc with the area over which a touch raises a sensor above three
            standard deviations, median over sensors.
    """

    force_N: float  # noqa: N815 - the unit
    blind_share: float
    place_m: float
    place_90_m: float
    radius_m: float
    force_relative: float
    receptive_radius_m: float


@checked("design")
@dataclass(frozen=True, kw_only=True)
class LocalPrecision:
    """Computes how precisely readings determine place, radius and force of fingertips, to first order.

    Touches are spread evenly over places, at least ``margin`` from the edges, and over radii (Halton points).
    The priors are the standard deviations of a uniform distribution over the surface and over the radii, and
    half of the force.

    Args:
        forces: N.
        radii: least and largest radius of a fingertip, m.
        rim: softness of its edge, m (:class:`skin.mechanics.geometry.Fingertip`).
        frames: number of frames of a touch that are averaged.
        noise: standard deviation of a sensor's noise in a frame, N.
        gain: standard deviation of the unknown gain of a sensor, relative.
        clip: largest force that a sensor measures, N.
        margin: m.
        touches: number of touches.
        seed: of the touches.
    """

    forces: Annotated[Sequence[PositiveFloat], MinLen(1)] = (1.0, 5.0, 20.0)
    radii: Lengths = (0.004, 0.012)
    rim: PositiveFloat = 0.0015
    frames: PositiveInt = 10
    noise: Annotated[float, Gt(0)] = 0.05
    gain: NonNegativeFloat = 0.0
    clip: PositiveFloat = 10.0
    margin: NonNegativeFloat = 0.015
    touches: Annotated[int, Ge(16)] = 1024
    seed: Annotated[int, Ge(0)] = 0

    def run(self, config: Config, folder: Path) -> None:
        """Write design.json and design.png for the configured skin, and print a table.

        Raises:
            InputError: a skin that cannot be built, or a margin that leaves no place.
        """
        from skin.design.drawing import draw_precision, print_precision

        skin = build_skin(config)
        simulator = skin.simulator(skin.body, skin.sensors)
        findings = self.find(simulator, skin.body)
        maps = dict(zip(self.forces, self.maps(simulator, skin.body), strict=True))
        print_precision(findings)
        settings = {name + _UNITS.get(name, ""): value for name, value in asdict(self).items()}
        lines = [asdict(finding) for finding in findings]
        about = {"sensors": len(skin.sensors), "settings": settings, "precision": lines}
        print(
            write(json_text(about), folder / "design.json"),
            draw_precision(skin.body, skin.sensors, maps, folder / "design.png"),
            sep="\n",
        )

    def find(self, simulator: AbstractSimulator, body: AbstractBody) -> list[Findings]:
        """Return the findings for each force.

        Raises:
            InputError: the margin leaves no place.
        """
        touches = self.sample(body)
        felt = sensitivity(simulator, Fingertip(body, self.rim, simulator.smooth), touches)
        area = math.prod(self._extent(body))
        return [self._findings(felt.of_force(force), force, body, area) for force in self.forces]

    def _findings(self, felt: Sensitivity, force: float, body: AbstractBody, area: float) -> Findings:
        place, radius, relative = self._deviations(felt, force, body)
        raised = self._noise.felt(felt.readings)
        reach = (raised.double().mean(0) * area / math.pi).sqrt()
        numbers = (
            (~raised.any(1)).double().mean(),
            place.median(),
            place.quantile(0.9),
            radius.median(),
            relative.median(),
            reach.median(),
        )
        return Findings(force, *map(float, numbers))

    def _deviations(
        self, felt: Sensitivity, force: float, body: AbstractBody
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the standard deviations of place, m, radius, m, and force, relative; each (B,)."""
        covariance = local_covariance(felt, self._noise, self.priors(force, body))
        variances = covariance.diagonal(dim1=1, dim2=2)
        return variances[:, :2].mean(1).sqrt(), variances[:, 2].sqrt(), variances[:, 3].sqrt() / force

    @property
    def _noise(self) -> Noise:
        return Noise(self.noise, self.frames, self.gain, self.clip)

    def priors(self, force: float, body: AbstractBody) -> Tensor:
        """Return the standard deviations of x, y, radius and force before a touch, (4,), m and N."""
        spreads = [*body.size, self.radii[1] - self.radii[0]]
        return torch.tensor([spread / math.sqrt(12) for spread in spreads] + [force / 2]).double()

    def sample(self, body: AbstractBody) -> Tensor:
        """Return touches with a force of 1 N, (B, 4).

        Raises:
            InputError: the margin leaves no place.
        """
        shares = torch.from_numpy(Halton(3, seed=self.seed).random(self.touches))
        least = torch.tensor([self.margin, self.margin, self.radii[0]]).double()
        extent = torch.tensor([*self._extent(body), self.radii[1] - self.radii[0]]).double()
        return torch.cat([least + shares * extent, torch.ones(self.touches, 1)], dim=1)

    def _extent(self, body: AbstractBody) -> tuple[float, float]:
        width, height = (side - 2 * self.margin for side in body.size)
        if min(width, height) <= 0:
            raise InputError(
                f"design.margin={self.margin:g} m leaves no place on {body.size[0]:g} x {body.size[1]:g} m: "
                f"give less than {min(body.size) / 2:g}"
            )
        return width, height

    def maps(self, simulator: AbstractSimulator, body: AbstractBody) -> Tensor:
        """Return the local precision of the place on each cell, for the mean radius, (forces, H, W), m."""
        x, y = ((torch.arange(count) + 0.5) * cell for count, cell in zip(body.cells, body.cell, strict=True))
        down, across = torch.meshgrid(y, x, indexing="ij")
        constants = torch.tensor([sum(self.radii) / 2, 1.0]).expand(across.numel(), 2)
        touches = torch.cat([torch.stack([across, down], -1).flatten(0, 1), constants], dim=1)
        felt = sensitivity(simulator, Fingertip(body, self.rim, simulator.smooth), touches)
        places = [self._deviations(felt.of_force(force), force, body)[0] for force in self.forces]
        return torch.stack(places).unflatten(1, body.shape)


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
