"""The expected posterior of fingertips on a skin: errors, blind touches and reach; a sweep over designs."""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from annotated_types import Ge, Gt, MinLen
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from rich.console import Console
from rich.progress import track
from scipy.stats.qmc import Halton
from torch import Tensor

from skin.body.base import AbstractBody, Layer, Sensors
from skin.body.layout import Footprint, Grid
from skin.body.material import Material
from skin.core.files import json_text, write
from skin.core.rng import Stream, generator
from skin.core.settings import RISING, checked
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.inference.candidates import CandidateReadings, FingertipPrior, disc_readings
from skin.inference.contact import Cloud, blur_first, one_contact
from skin.inference.likelihood import Observation, blend
from skin.inference.noise import Noise
from skin.mechanics.geometry import PARAMETERS, Fingertip
from skin.mechanics.simulator.base import AbstractSimulator
from skin.runs.build import SkinModel

_UNITS = {
    **dict.fromkeys(("radii", "rim", "margin"), "_m"),
    **dict.fromkeys(("forces", "noise", "clip"), "_N"),
    "gain": "_relative",
}

_FRICTION = 0.8  # of touches on three axes, and of those on their normal ones alone

Lengths = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]


# The local precision of fingertips: how well readings tell a touch from its neighbours.


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
    parts = list[tuple[Tensor, Tensor]]()
    for part in touches.double().split(_AT_ONCE):
        slopes = []
        for axis in range(len(PARAMETERS)):
            along = torch.zeros_like(part)
            along[:, axis] = 1
            # Touches do not influence each other, so one direction serves all of them.
            pair = torch.func.jvp(lambda touch: simulator.press(fingertip(touch)).readings, (part,), (along,))
            slopes.append(pair[1])
        parts.append((pair[0], torch.stack(slopes, dim=-1)))
    return Sensitivity(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def local_covariance(sensitivity: Sensitivity, noise: Noise, priors: Tensor) -> Tensor:
    """Return the covariance of the parameters given the readings, to first order, (B, 4, 4), m and N.

    Args:
        sensitivity: of the touches.
        noise: of the readings.
        priors: standard deviation of each parameter before the touch, (4,) or (B, 4), m and N.
    """
    variance = noise.floor + (noise.relative * sensitivity.readings).square()
    weights = (1 / variance).masked_fill(sensitivity.readings >= noise.clip, 0.0)
    # Parameters in units of their priors: the matrix is then well conditioned.
    slopes = sensitivity.slopes * priors[..., None, :].to(sensitivity.slopes)
    information = torch.einsum("bsi,bs,bsj->bij", slopes, weights, slopes) + torch.eye(len(PARAMETERS))
    scales = priors.to(slopes)
    return torch.linalg.inv(information) * scales[..., :, None] * scales[..., None, :]


@dataclass(frozen=True)
class Findings:
    """Errors of the posterior mean for drawn touches around one force.

    The error of a position is that along one axis, the root of the mean square along x and y.

    Attributes:
        force_N: median of the forces.
        blind_share: touches that raise no sensor above three standard deviations of the noise of a frame.
        place_m: error of the position, root of the mean square over touches.
        place_median_m: its median.
        place_90_m: its 90 % quantile.
        place_raised_m: as ``place_m``, over touches that raise a sensor; NaN without any.
        radius_m: error of the radius, median over touches.
        force_relative: error of the force, as a fraction of it, median over touches.
        receptive_radius_m: radius of the disc with the area over which a touch raises a sensor above three
            standard deviations, median over sensors.
        local_precision_m: standard deviation of the position near the true touch, to first order, median over
            touches (:mod:`skin.design.expected`). It is no limit.
    """

    force_N: float  # noqa: N815 - the unit
    blind_share: float
    place_m: float
    place_median_m: float
    place_90_m: float
    place_raised_m: float
    radius_m: float
    force_relative: float
    receptive_radius_m: float
    local_precision_m: float


@dataclass(frozen=True)
class Trials:
    """What the posterior tells of drawn touches.

    Attributes:
        touches: (B, 4), x, y and radius, m, and force, N.
        raised: (B, S), bool, sensors above three standard deviations of the noise of a frame.
        means: (B, 4), posterior means of the touches.
        deviation: (B,), posterior standard deviation of the position along one axis, m.
    """

    touches: np.ndarray
    raised: np.ndarray
    means: np.ndarray
    deviation: np.ndarray


def try_touches(
    candidates: CandidateReadings,
    prior: FingertipPrior,
    noise: Noise,
    touches: np.ndarray,
    readings: np.ndarray,
    rng: np.random.Generator,
) -> Trials:
    """Measure touches on a device with noise and unknown gains, and return what the posterior tells.

    Args:
        candidates: of the skin.
        prior: of one contact.
        noise: of the device.
        touches: (B, 4), m and N.
        readings: (B, S), their true readings, N.
        rng: of noise and gains.
    """
    first = blur_first(candidates, noise)
    gains = 1 + noise.gain * rng.standard_normal(readings.shape)
    measured = gains * readings + math.sqrt(noise.floor) * rng.standard_normal(readings.shape)
    valid = np.ones(readings.shape[1], bool)
    frames = (Observation.of(frame, valid, frame >= noise.clip, noise) for frame in measured)
    moments = [_moments(one_contact(candidates, prior, frame, first)) for frame in frames]
    raised = noise.exceeds(np.abs(readings))
    return Trials(touches, raised, *(np.array(part) for part in zip(*moments, strict=True)))


def _moments(cloud: Cloud) -> tuple[np.ndarray, float]:
    """Return the mean (4,) of a contact, and the standard deviation of its position along one axis."""
    weight, (centre, width) = cloud.weight.sum(1), cloud.boxes
    mean = weight @ centre
    variance = weight @ ((centre - mean) ** 2 + width**2 / 12)
    return np.append(mean, (cloud.weight * cloud.force).sum()), math.sqrt(variance[:2].mean())


@checked("design")
@dataclass(frozen=True, kw_only=True)
class ExpectedPosterior:
    """Computes how well the posterior of one contact tells place, radius and force of fingertips.

    Touches are spread evenly over places and radii (Halton points). Their forces are log-normal around each
    of ``forces``, which is also the prior (:class:`skin.inference.candidates.FingertipPrior`).

    Args:
        forces: medians, N.
        radii: least and largest radius of a fingertip, m.
        rim: softness of its edge, m (:class:`skin.mechanics.geometry.Fingertip`).
        frames: number of frames of a touch that are averaged.
        noise: standard deviation of a sensor's noise in a frame, N.
        gain: standard deviation of the unknown gain of a sensor, relative.
        clip: largest force that a sensor measures, N.
        margin: least distance of touches from the edges, m.
        touches: number of touches of each force.
        seed: of the touches and of the noise.
    """

    forces: Annotated[Sequence[PositiveFloat], MinLen(1)] = (1.0, 5.0, 20.0)
    radii: Lengths = (0.004, 0.012)
    rim: PositiveFloat = 0.0015
    frames: PositiveInt = 10
    noise: Annotated[float, Gt(0)] = 0.05
    gain: NonNegativeFloat = 0.0
    clip: PositiveFloat = 10.0
    margin: NonNegativeFloat = 0.0
    touches: Annotated[int, Ge(16)] = 512
    seed: Annotated[int, Ge(0)] = 0

    def run(self, skin: SkinModel, make_device: Callable[[], AbstractDevice], folder: Path) -> None:
        """Write design.json and design.png for a skin, and print a table; no device is needed.

        Raises:
            InputError: a skin that cannot be built, or a margin that leaves no position.
        """
        from skin.design.drawing import draw_expected, print_blind_places, print_expected

        simulator = skin.simulator(skin.body, skin.sensors)
        trials, facing = self.trials(simulator, skin.body), skin.sensors
        found = {"expected": self.find(simulator, skin.body, trials)}
        if facing.axes > 1:
            facing = Sensors(facing.positions[2::3], facing.footprint, facing.normals[2::3])
            normal = skin.simulator(skin.body, facing)
            found["normal"] = self.find(normal, skin.body, self.trials(normal, skin.body, _FRICTION))
        print_expected(**found)
        print_blind_places(
            skin.body,
            facing,
            self.forces,
            lambda places: self.count_unfelt(simulator, skin.body, places),
        )
        settings = {name + _UNITS.get(name, ""): value for name, value in asdict(self).items()}
        tables = {name: list(map(asdict, findings)) for name, findings in found.items()}
        content = {"sensors": len(skin.sensors), "settings": settings} | tables
        maps = {force: self.expected_map(trial, skin.body) for force, trial in trials.items()}
        print(
            write(json_text(content), folder / "design.json"),
            draw_expected(skin.body, skin.sensors, maps, folder / "design.png"),
            sep="\n",
        )

    def trials(
        self, simulator: AbstractSimulator, body: AbstractBody, friction: float | None = None
    ) -> dict[float, Trials]:
        """Return what the posterior tells of touches around each force, N.

        Args:
            simulator, body: of the skin.
            friction: of the touches, unknown to the posterior (:class:`FingertipPrior`).

        Raises:
            InputError: the margin leaves no position.
        """
        positions = self.sample(body)
        prior = FingertipPrior(radii=self.radii, rim=self.rim, friction=friction)
        priors = {force: replace(prior, force=force) for force in self.forces}
        candidates = CandidateReadings(simulator, body, prior)
        loads = disc_readings(simulator, body, positions, self.rim, candidates.friction)
        loads = loads.reshape(len(positions), -1, candidates.sensors)
        trials = dict[float, Trials]()
        for number, (force, prior) in enumerate(priors.items()):
            rng = generator(Stream.DESIGN, self.seed, number)
            drawn = force * np.exp(prior.spread * rng.standard_normal(len(positions)))
            touches = np.column_stack([positions, drawn])
            true = (
                drawn[:, None] * blend(loads, rng.standard_normal((len(loads), 1, loads.shape[1] - 1)))[:, 0]
            )
            trials[force] = try_touches(candidates, prior, self._noise, touches, true, rng)
        return trials

    def find(
        self, simulator: AbstractSimulator, body: AbstractBody, trials: Mapping[float, Trials] | None = None
    ) -> list[Findings]:
        """Return the findings for each force.

        Args:
            simulator, body: of the skin.
            trials: of :meth:`trials`; None: they are computed.

        Raises:
            InputError: the margin leaves no position.
        """
        trials = trials or self.trials(simulator, body)
        unit = torch.from_numpy(np.column_stack([self.sample(body), np.ones(self.touches)]))
        responses = sensitivity(simulator, Fingertip(body, self.rim, simulator.smooth), unit)
        simulator.float()
        area = math.prod(self._extent(body))
        return [
            _findings(force, trial, area, self._local_precision(responses.of_force(force), force, body))
            for force, trial in trials.items()
        ]

    def count_unfelt(
        self, simulator: AbstractSimulator, body: AbstractBody, places: np.ndarray
    ) -> np.ndarray:
        """Return how many of the forces raise no sensor, (N,), at places (N, 2), m, by a medium fingertip."""
        discs = np.column_stack([places, np.full(len(places), sum(self.radii) / 2)])
        largest = np.abs(disc_readings(simulator, body, discs, self.rim)).max(axis=1)
        return np.sum([~self._noise.exceeds(force * largest) for force in self.forces], axis=0)

    def _local_precision(self, responses: Sensitivity, force: float, body: AbstractBody) -> float:
        """Return the median local precision of the position, m."""
        variances = local_covariance(responses, self._noise, self.priors(force, body)).diagonal(
            dim1=1, dim2=2
        )
        return float(variances[:, :2].mean(1).sqrt().median())

    @property
    def _noise(self) -> Noise:
        return Noise(self.noise, self.frames, self.gain, self.clip)

    def priors(self, force: float, body: AbstractBody) -> torch.Tensor:
        """Return the standard deviations of x, y, radius and force before a touch, (4,), m and N.

        They are those of uniform places and radii, and half of the force.
        """
        spreads = [*body.size, self.radii[1] - self.radii[0]]
        return torch.tensor([spread / math.sqrt(12) for spread in spreads] + [force / 2]).double()

    def sample(self, body: AbstractBody) -> np.ndarray:
        """Return places and radii of touches, (B, 3), m.

        Raises:
            InputError: the margin leaves no position.
        """
        fractions = Halton(3, seed=self.seed).random(self.touches)
        extent = np.array([*self._extent(body), self.radii[1] - self.radii[0]])
        return np.array([self.margin, self.margin, self.radii[0]]) + fractions * extent

    def _extent(self, body: AbstractBody) -> tuple[float, float]:
        width, height = (side - 2 * self.margin for side in body.size)
        if min(width, height) <= 0:
            raise InputError(
                f"design.margin={self.margin:g} m leaves no place on {body.size[0]:g} x {body.size[1]:g} m: "
                f"give less than {min(body.size) / 2:g}"
            )
        return width, height

    def expected_map(self, trials: Trials, body: AbstractBody) -> np.ndarray:
        """Return the expected error of the position along one axis on each cell, (H, W), m.

        It is the root of the mean posterior variance of the touches around a cell, weighted by a normal
        distribution as wide as their mean distance. Cells nearer to the edge than the margin are NaN.
        """
        width = math.sqrt(math.prod(self._extent(body)) / len(trials.touches))
        near, inside = [], []
        for axis in (0, 1):
            middles = (np.arange(body.cells[axis]) + 0.5) * body.cell[axis]
            near.append(np.exp(-0.5 * ((middles[:, None] - trials.touches[:, axis]) / width) ** 2))
            inside.append((middles >= self.margin) & (middles <= body.size[axis] - self.margin))
        across, down = near
        variance = (down * trials.deviation**2) @ across.T / (down @ across.T)
        return np.where(np.outer(inside[1], inside[0]), np.sqrt(variance), np.nan)


def _findings(force: float, trials: Trials, area: float, local: float) -> Findings:
    """Return the findings of touches on an area, m^2."""
    errors = trials.means - trials.touches
    position = np.sqrt((errors[:, :2] ** 2).mean(1))
    raised = trials.raised.any(1)
    numbers = (
        1 - raised.mean(),
        _rms(position),
        np.median(position),
        np.quantile(position, 0.9),
        _rms(position[raised]) if raised.any() else math.nan,
        np.median(np.abs(errors[:, 2])),
        np.median(np.abs(errors[:, 3]) / trials.touches[:, 3]),
        np.median(np.sqrt(trials.raised.mean(0) * area / math.pi)),
        local,
    )
    return Findings(force, *map(float, numbers))


def _rms(values: np.ndarray) -> float:
    return math.sqrt((values**2).mean())


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


@checked("design")
@dataclass(frozen=True, kw_only=True)
class Sweep(ExpectedPosterior):
    """Computes the expected posterior of one layer for several thicknesses and regular grids of sensors.

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

    def run(self, skin: SkinModel, make_device: Callable[[], AbstractDevice], folder: Path) -> None:
        """Write design_sweep.csv and design_sweep.png; no device is needed.

        Raises:
            InputError: a skin that cannot be built, a simulator without mechanics, or sensors outside the
                layer.
        """
        from skin.design.drawing import draw_sweep, print_sweep

        cases = [
            (thickness, (rows, columns)) for thickness in self.thicknesses for rows, columns in self.grids
        ]
        shown = track(cases, "solving", console=Console(stderr=True), disable=not sys.stderr.isatty())
        steps = [self.step(skin, *case) for case in shown]
        print_sweep(steps)
        table = pd.DataFrame(
            {
                "thickness_m": step.thickness,
                "rows": step.grid[0],
                "columns": step.grid[1],
                "pitch_m": step.pitch,
                **asdict(finding),
            }
            for step in steps
            for finding in step.findings
        ).to_csv(index=False, na_rep="nan")
        path = write(table, folder / "design_sweep.csv")
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
