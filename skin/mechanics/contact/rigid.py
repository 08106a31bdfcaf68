"""Rigid objects: the image gives their height, and contact mechanics the pressure."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple, final

import numpy as np
import torch
from annotated_types import Ge
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor

from skin.body.base import AbstractBody
from skin.core.settings import checked
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.gestures import GestureSettings
from skin.touch.movie import AbstractContact, ContactProblem, ContactResult, measure_gestures
from skin.touch.paths import Trajectories
from skin.touch.shapes import Pose, Shapes

# Contact of rigid objects with an elastic surface, in batches, by projected conjugate gradients.


# Problems per batch, so that their vectors stay in the processor's cache.
_PART = 256
# Errors below this fraction of the tolerance are rounding, and give no search direction.
_REST = 0.1


class Equilibrium(NamedTuple):
    """Solutions of contact problems.

    Attributes:
        pressure: (B, N), Pa, not negative.
        residual: (B,), of the contact conditions; see :func:`solve_contact`.
        iterations: (B,), number of iterations.
    """

    pressure: Tensor
    residual: Tensor
    iterations: Tensor


def solve_contact(
    compliance: Tensor,
    gap: Tensor,
    total: Tensor,
    start: Tensor | None = None,
    tolerance: float = 1e-4,
    iterations: int = 200,
) -> Equilibrium:
    """Minimise p' C p / 2 + g' p over p >= 0 with sum(p) given.

    The conditions are C p + g = d where p > 0 and C p + g >= d elsewhere, for one approach d. The residual is
    the largest gap under pressure or overlap anywhere, as a fraction of the largest deflection max(C p). Sum
    and sign of the pressure hold exactly at any residual.

    The method is that of Polonsky and Keer (Wear 231, 1999): conjugate gradients over the cells in contact.
    Cells whose pressure becomes negative leave the contact; cells that overlap enter it and restart the
    directions. An iteration costs one or two products of all pressures with C. Solved problems leave the
    batch. Where the errors of the cells in contact are only rounding, which differs between processors, they
    give no direction; this happens under symmetric objects.

    Args:
        compliance: C (N, N), m/Pa, symmetric and positive definite; its dtype is that of the solution.
        gap: g (B, N), m; infinite where there is no object.
        total: (B,), sum of the pressures, Pa: force by the area of a cell.
        start: (B, N), initial pressures, up to a factor; None: uniform.
        tolerance: the residual at which a problem is solved.
        iterations: maximum number of iterations.

    Raises:
        InputError: a sum below 0, or a gap that is nowhere finite.
    """
    if not ((total >= 0).all() and gap.isfinite().any(1).all()):
        raise InputError(
            "solve_contact takes sums of pressure of 0 Pa or more, and gaps that are finite somewhere"
        )
    parts = [
        _solve_part(
            compliance,
            gap[first : first + _PART].to(compliance),
            total[first : first + _PART].to(compliance),
            None if start is None else start[first : first + _PART].to(compliance),
            tolerance,
            iterations,
        )
        for first in range(0, len(gap), _PART)
    ]
    if not parts:
        return Equilibrium(gap.to(compliance), total.to(compliance), torch.zeros(0, dtype=torch.long))
    return Equilibrium(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _solve_part(
    compliance: Tensor,
    gap: Tensor,
    total: Tensor,
    start: Tensor | None,
    tolerance: float,
    iterations: int,
) -> Equilibrium:
    equilibrium = Equilibrium(
        torch.zeros_like(gap), torch.full_like(total, torch.inf), torch.zeros(len(gap), dtype=torch.long)
    )
    state = _State(compliance, gap, total, start, _REST * tolerance)
    rows = torch.arange(len(gap))
    for step in range(iterations + 1):
        residual = state.residual()
        # The last iteration stores all remaining problems; a residual of NaN never counts as solved.
        leaves = residual <= tolerance if step < iterations else torch.ones_like(residual, dtype=torch.bool)
        if leaves.any():
            gone = rows[leaves]
            equilibrium.pressure[gone] = state.pressure[leaves]
            equilibrium.residual[gone] = residual[leaves]
            equilibrium.iterations[gone] = step
            rows = rows[~leaves]
            if not len(rows):
                break
            state.keep(~leaves)
        state.step()
    return equilibrium


class _State:
    """The problems still to be solved, one per row."""

    def __init__(
        self, compliance: Tensor, gap: Tensor, total: Tensor, start: Tensor | None, rest: float
    ) -> None:
        # The rest is a fraction of the largest deflection.
        self.compliance, self.rest, self.total = compliance, rest, total
        self.allowed = gap.isfinite()
        self.gap = gap.where(self.allowed, 0)
        even = self.allowed.to(gap)
        begin = even if start is None else start.clamp(min=0) * even
        # The initial pressure is not usable where the object covers none of its cells.
        begin = torch.where(begin.sum(1, keepdim=True) > 0, begin, even)
        self.pressure = self._loaded(begin, total)
        self.deflection = self.pressure @ compliance
        self.direction = torch.zeros_like(gap)
        self.carried = torch.zeros_like(total)  # fraction of the last direction in the next, times its square
        self._update_contact()

    def _loaded(self, pressure: Tensor, total: Tensor) -> Tensor:
        return pressure * (total / pressure.sum(1))[:, None]

    def _update_contact(self) -> None:
        """Find the cells in contact and how far each surface is from the mean of theirs."""
        self.touches = self.pressure > 0
        self.count = self.touches.sum(1).clamp(min=1)
        error = self.deflection + self.gap
        self.error = error - ((error * self.touches).sum(1) / self.count)[:, None]

    def residual(self) -> Tensor:
        """Return how far each problem is from its conditions, (B,)."""
        overlap = (-self.error).clamp(min=0).where(self.allowed, 0)
        worst = torch.where(self.touches, self.error.abs(), overlap).amax(1)
        return worst / self.deflection.amax(1)

    def keep(self, rows: Tensor) -> None:
        """Forget the other problems."""
        for name, value in vars(self).items():
            if isinstance(value, Tensor) and name != "compliance":
                setattr(self, name, value[rows])

    def step(self) -> None:
        """Move every pressure along its direction as far as energy falls, and project it."""
        inside = self.error.where(self.touches, 0)
        # A single cell in contact is always at rest.
        moves = inside.abs().amax(1) > self.rest * self.deflection.amax(1)
        inside = inside.where(moves[:, None], 0)
        square = (inside * inside).sum(1)
        fraction = torch.where(self.carried > 0, square / self.carried, 0)
        along = (inside + fraction[:, None] * self.direction).where(self.touches, 0)
        # Cells that have left took their part of the sum with them.
        along = (along - (along.sum(1) / self.count)[:, None]).where(self.touches & moves[:, None], 0)
        answer = along @ self.compliance
        curvature = (along * answer).sum(1)
        # Without a direction, the compliance of a cell alone gives the step of a joining cell.
        length = torch.where(
            moves, (inside * along).sum(1) / curvature, 1 / self.compliance.diagonal().mean()
        )

        trial = self.pressure - length[:, None] * along
        joins = self.allowed & ~self.touches & (self.error < 0)
        projected = trial.clamp(min=0).where(~joins, -length[:, None] * self.error)
        joined = joins.any(1)
        changed = joined | (trial < 0).any(1)
        self.direction, self.carried = along, square.where(~joined, 0)
        self.pressure, self.deflection = projected, self.deflection - length[:, None] * answer
        if changed.any():
            self.pressure[changed] = self._loaded(projected[changed], self.total[changed])
            self.deflection[changed] = self.pressure[changed] @ self.compliance
        self._update_contact()


# Checkerboard stabilisation of the compliance of a mesh that is as coarse as the loaded cells.


# Smallest eigenvalue of square cells on a half-space, times E / (1 - nu^2) h; its mode is the checkerboard.
_CHECKERBOARD = 0.34


def stabilise_checkerboard(compliance: Tensor, body: AbstractBody) -> Tensor:
    """Return a compliance (N, N), m/Pa, with the stiffness of the top layer under a checkerboard of pressure.

    Where the mesh has nodes at the corners of the loaded cells only, the pressure of a cell acts on its
    corners, and its displacement is their mean. The mesh then filters pressures by S (1/4, 1/2, 1/4 along
    both axes), and a checkerboard of pressure gives no displacement: contact pressures would not be unique.
    This function adds (I - S) times the compliance of a half-space of the top layer's material for the
    checkerboard, less the compliance that the mesh has. Uniform pressure is not affected. A compliance that
    already resolves the checkerboard is returned unchanged.
    """
    height, width = body.shape
    material = body.layers[-1].material
    whole = _CHECKERBOARD * (1 - material.poisson**2) * float(np.sqrt(np.prod(body.cell))) / material.young
    board = torch.from_numpy((np.indices((height, width)).sum(axis=0) % 2 * 2.0 - 1).ravel()).to(compliance)
    lacking = max(0.0, whole - float(board @ compliance @ board) / len(board))
    smooth = torch.kron(_filter(height), _filter(width)).to(compliance)
    return compliance + lacking * (torch.eye(len(board)).to(compliance) - smooth)


def surface_compliance(simulator: AbstractSimulator, body: AbstractBody) -> Tensor:
    """Return the compliance (N, N), m/Pa, of the N cells of a skin for :func:`solve_contact`, float32.

    Raises:
        InputError: the simulator has no compliance.
    """
    return stabilise_checkerboard(simulator.compliance().detach().cpu().double(), body).float()


def _filter(count: int) -> Tensor:
    """Return the filter (1/4, 1/2, 1/4), (count, count), reflected at both ends; rows sum to 1."""
    rows = torch.eye(count, dtype=torch.float64)
    corners = torch.cat([rows[:1], (rows[1:] + rows[:-1]) / 2, rows[-1:]])
    return (corners[1:] + corners[:-1]) / 2


# Search, for each gesture, for the force that gives its wanted labels.


# Relative tolerance of the peak. The tolerance at an end of its range, where a search fails, is tighter, so
# that the result does not depend on the side from which the search has come.
_NEAR = 1.03
_END = 1.0003
_STEPS = 24


class ForceSearch(NamedTuple):
    """Forces, one per gesture (B,).

    Attributes:
        load: N; NaN where no load gives the wanted classes.
        area: bool, whether the area class could not be reached.
        failed: bool, whether the contact did not converge.
        pressure: (B, N), Pa, at the last load.
    """

    load: np.ndarray
    area: np.ndarray
    failed: np.ndarray
    pressure: torch.Tensor


def find_force(
    solve: Callable[[np.ndarray, np.ndarray, torch.Tensor], tuple[Equilibrium, np.ndarray]],
    begin: torch.Tensor,
    peak: np.ndarray,
    labels: np.ndarray,
    problem: ContactProblem,
) -> ForceSearch:
    """Find loads at which single frames are big or small, dangerous or safe, as wanted.

    A secant search on logarithms first finds the load at which the peak pressure is the drawn one. Where the
    classes are wrong there, the wanted peak moves half of the way towards one end of its range, repeatedly.
    At the end of the range the search fails.

    Args:
        solve: takes rows (b,), their loads (b,), N, and initial pressures; returns their equilibrium and
            which of them did not converge.
        begin: (B, N), initial pressures.
        peak: (B,), drawn peak pressure, Pa.
        labels: (B, 4), bool, wanted labels in the order of ``TOUCH``.
        problem: the body, ranges and thresholds.
    """
    search = _Search.of(begin, peak, labels, problem)
    rows = np.arange(len(peak))
    for _ in range(_STEPS):
        selected = torch.from_numpy(rows)
        equilibrium, lost = solve(rows, search.load[rows], search.pressure[selected])
        search.pressure[selected] = equilibrium.pressure.to(search.pressure)
        peaks, classes = _classes(equilibrium.pressure, problem, labels[rows, 2])
        rows = search.move(rows, search.judge(rows, peaks, classes != search.wanted[rows], lost), peaks)
        if not len(rows):
            break
    search.result[search.failed] = np.nan
    return ForceSearch(search.result, search.area, search.failed, search.pressure)


@dataclass
class _Search:
    """State of the search, per gesture.

    Attributes:
        wanted: (B, 2), bool: big, dangerous.
        minimum: (B,), Pa, lower end of the range of the peak pressure.
        maximum: (B,), Pa, its upper end.
        target: (B,), Pa, peak pressure to find.
        load: (B,), N, next load to try.
        pressure: (B, N), Pa, last solution.
        power: (B,), exponent of the load as a function of the peak: 3 under a sphere, 1 under a flat punch.
        last: (2, B), logarithms of the last load and of its peak.
        result, area, failed: as in :class:`ForceSearch`.
    """

    wanted: np.ndarray
    minimum: np.ndarray
    maximum: np.ndarray
    target: np.ndarray
    load: np.ndarray
    pressure: torch.Tensor
    power: np.ndarray
    last: np.ndarray
    result: np.ndarray
    area: np.ndarray
    failed: np.ndarray

    @classmethod
    def of(
        cls, begin: torch.Tensor, peak: np.ndarray, labels: np.ndarray, problem: ContactProblem
    ) -> "_Search":
        """Return a search that begins at the drawn peaks (B,), Pa, scaled and clipped to their ranges."""
        settings, cell = problem.settings, problem.shapes.body.cell
        ends, scale = _peak_range(labels, settings)
        minimum, maximum = ends[:, 0] * _NEAR, np.maximum(ends[:, 1] / _NEAR, ends[:, 0] * _NEAR)
        target = np.clip(peak * scale, minimum, maximum)
        fraction = torch.from_numpy(target / begin.amax(1).double().numpy()).to(begin)
        pressure = begin * fraction[:, None]
        load = pressure.sum(1).double().numpy() * (cell[0] * cell[1])
        count = len(peak)
        power, last = np.full(count, 1.5), np.full((2, count), np.nan)
        result = np.full(count, np.nan), np.zeros(count, bool), np.zeros(count, bool)
        return cls(labels[:, [0, 3]], minimum, maximum, target, load, pressure, power, last, *result)

    def judge(self, rows: np.ndarray, peak: np.ndarray, wrong: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Store finished searches, and move the target where the classes at it are wrong.

        Args:
            rows: (b,), the gestures that were tried.
            peak: (b,), Pa, their peak pressure.
            wrong: (b, 2), bool, which of their classes are wrong.
            lost: (b,), bool, whether the contact did not converge.

        Returns:
            (b,), bool, which searches continue.
        """
        target, minimum, maximum = self.target[rows], self.minimum[rows], self.maximum[rows]
        up, down = ((wrong & side).any(1) for side in (self.wanted[rows], ~self.wanted[rows]))
        away = np.abs(np.log(peak / target))
        met = away < np.log(_NEAR)
        done = met & ~up & ~down
        self.result[rows[done]] = self.load[rows[done]]
        # The classes ask for both directions, or the target is already at the end.
        at_end = (away < np.log(_END)) & ((up & (target >= maximum)) | (down & (target <= minimum)))
        over = met & up & down | at_end
        self.area[rows[over]] = wrong[over, 0]
        self.failed[rows[lost]] = True
        for side, end in ((met & up, maximum), (met & down, minimum)):
            self.target[rows[side]] = _halfway(self.target[rows[side]], end[side])
        return ~done & ~over & ~lost

    def move(self, rows: np.ndarray, goes_on: np.ndarray, peak: np.ndarray) -> np.ndarray:
        """Set the next load of the searches that continue, (b,), and return their rows."""
        tried = np.log(self.load[rows]), np.log(peak)
        self.power[rows] = _power(self.power[rows], *tried, self.last[:, rows])
        self.last[:, rows] = tried
        rows, peak = rows[goes_on], peak[goes_on]
        step = self.power[rows] * (np.log(self.target[rows]) - np.log(peak))
        self.load[rows] *= np.exp(np.clip(step, -1.5, 1.5))
        return rows


def _peak_range(labels: np.ndarray, settings: GestureSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges (B, 2), Pa, of the peak pressure of touches with labels (B, 4), bool, and a scale.

    They are relative to a limit of pressure. A wide touch reaches a limit of force far below that.
    """
    ends = np.where(labels[:, 3:], settings.dangerous_peak, settings.safe_peak)
    pressure, force = settings.danger.of_contact(labels[:, 2])
    scale = np.where(np.isfinite(pressure), pressure / settings.thresholds.pressure, 1)
    ends *= scale[:, None]
    ends[:, 0] *= np.where(np.isfinite(force), 0.01, 1)
    return ends, scale


def _classes(
    pressure: torch.Tensor, problem: ContactProblem, press: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the peak pressure (b,), Pa, and the classes big and dangerous (b, 2) of frames."""
    body, thresholds = problem.shapes.body, problem.settings.thresholds
    frames = pressure.float().view(-1, *body.shape)
    index, once = torch.arange(len(frames))[:, None], torch.ones(len(frames), 1)
    measures = measure_gestures(frames, index, once, problem.footprints, body.cell, thresholds.contact)
    force = frames.sum((1, 2)).numpy() * np.prod(body.cell)
    excess = problem.settings.danger.excess(measures.pressure.numpy(), force, press)
    held = measures.area.numpy() > thresholds.area, excess > 1
    return frames.flatten(1).amax(1).double().numpy(), np.stack(held, axis=1)


def _halfway(target: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the geometric mean of target and end, or the end where they are close."""
    return np.where(np.abs(np.log(end / target)) < 0.1, end, np.sqrt(target * end))


def _power(power: np.ndarray, load: np.ndarray, peak: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return d log load / d log peak from the last two points, where they differ enough."""
    rise, run = load - last[0], peak - last[1]
    apart = np.abs(run) > 1e-3
    slope = np.divide(rise, run, out=power.copy(), where=apart)
    return np.clip(slope, 0.5, 5.0)


class Solids(NamedTuple):
    """Shapes as objects with an outline, sampled on the cells.

    Attributes:
        inside: (F, H, W), bool, cells that the object covers by at least half; if there are none, those with
            the largest cover.
        grey: (F, H, W), mean grey of the covered part, 1 = white; 0 outside.
        rim: (F, H, W), its mean distance from the outline, m, which stretching does not change; 0 outside.
    """

    inside: Tensor
    grey: Tensor
    rim: Tensor


def solids(shapes: Shapes, drawn: Pose) -> Solids:
    """Return shapes (F,) as objects, which are where the image is brighter than ``shapes.contact``."""
    cells = torch.cat([part for _, part in shapes.cells(shapes.objects, drawn)])
    cover, grey, rim = cells.unbind(1)
    maximum = cover.amax((1, 2), keepdim=True)
    inside = cover >= torch.minimum(maximum, torch.tensor(2.0))  # of 2 x 2 samples
    size = torch.from_numpy(shapes.visible(drawn)).float()[:, None, None]
    return Solids(inside, *((value / cover).where(inside, 0) for value in (grey, rim * size)))


@final
@checked("contact")
class Rigid(AbstractContact):
    """Presses a rigid object, whose image is a height map, into the skin, without friction.

    White parts touch first. Other parts are lower by up to ``relief``; there is no object where the image is
    black. The outline is rounded by an arc of radius ``fillet``, because the pressure under a sharp edge is
    unbounded. The object does not rotate. The image of a fist shows it from below with white knuckles; with
    ``relief: 0`` the object is a stamp with the outline of a fist. Heights do not scale with the image.

    The pressure p satisfies p >= 0 and sum(p) = force / cell, and the surface follows the object where p > 0:
    min p' C p / 2 + g' p, with C the compliance of the surface and g the gap to the object. The force is that
    at which the peak pressure is the drawn one, or, where the classes are wrong there, another one in its
    range (:mod:`skin.mechanics.contact.rigid`). A frame that does not converge to ``tolerance`` is not used:
    its gesture is drawn again and counted.

    Use it for hard objects, and to assess prescribed pressure. Peaks follow from the mechanics: at the edges
    of flat objects, in the middle of round ones.

    Args:
        body: the skin.
        simulator: gives the compliance of its surface.
        relief: height of white above black, m.
        fillet: radius of the rounded outline, m.
        tolerance: largest gap under pressure, or overlap, relative to the largest deflection.
        iterations: maximum number of iterations per frame.

    Raises:
        InputError: a simulator without a compliance, or settings that cannot be used.
    """

    proportional = False
    advice = "; a rigid object touches less than its image shows: lower contact.relief"

    def __init__(
        self,
        body: AbstractBody,
        simulator: AbstractSimulator,
        relief: NonNegativeFloat = 0.004,
        fillet: NonNegativeFloat = 0.005,
        tolerance: Annotated[float, Ge(1e-5)] = 1e-4,  # what single precision resolves
        iterations: PositiveInt = 200,
    ) -> None:
        self.relief, self.fillet = relief, fillet
        self.tolerance, self.iterations = tolerance, iterations
        self.compliance = surface_compliance(simulator, body)

    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure at a force that gives the wanted classes, if there is one."""
        body = problem.shapes.body
        cell = body.cell[0] * body.cell[1]
        gap = self.gap(trajectories, problem)
        full = np.zeros(len(trajectories.peak))
        np.maximum.at(full, trajectories.owner, trajectories.fraction)
        reference = _reference_frames(trajectories, full, gap, problem.footprints)
        forces, lost = self._search_forces(trajectories, gap, reference, problem)
        force = forces.load / full
        refused = np.isnan(force)

        solved = np.flatnonzero(~refused[trajectories.owner])
        rows, owner = torch.from_numpy(solved), torch.from_numpy(trajectories.owner[solved])
        totals = torch.from_numpy(force[trajectories.owner[solved]] * trajectories.fraction[solved] / cell)
        # A static touch starts from its solution at the largest force.
        stands = (
            trajectories.poses.position[solved]
            == trajectories.poses.position[reference][trajectories.owner[solved]]
        ).all(axis=1)
        start = forces.pressure[owner] * torch.from_numpy(stands)[:, None]
        states = solve_contact(self.compliance, gap[rows], totals, start, self.tolerance, self.iterations)
        missed = trajectories.owner[solved][(~(states.residual <= self.tolerance)).numpy()]
        lost += np.bincount(missed, minlength=len(force))

        frames = gap.isfinite().float()
        fractions = torch.from_numpy(trajectories.fraction).float()[:, None]
        frames[rows] = states.pressure
        peak = np.zeros(len(force))
        np.maximum.at(peak, trajectories.owner[solved], states.pressure.amax(1).double().numpy())
        frames = (frames / fractions).view(-1, *body.shape)
        # At other positions of a path, or under a small object, the peak may exceed its range.
        refused |= peak > _peak_range(trajectories.wanted, problem.settings)[0][:, 1]
        refused |= force > problem.settings.danger.human_force
        refused |= lost > 0
        return ContactResult(frames, force, peak, refused, forces.area, lost)

    def gap(self, trajectories: Trajectories, problem: ContactProblem) -> Tensor:
        """Return the gap between object and cells at first contact, (U, H * W), m.

        Infinite where there is no object. On an arm the object moves along the normal at its middle, and the
        gap includes the curvature of the skin.
        """
        inside, grey, rim = solids(problem.shapes, trajectories.poses)
        lower = self.relief * (1 - grey)
        inward = (self.fillet - rim).clamp(min=0, max=self.fillet)
        lower += self.fillet - (self.fillet**2 - inward**2).clamp(min=0).sqrt()
        lower = (lower.flatten(1) + _sag(problem.shapes.body, inside.flatten(1))).where(
            inside.flatten(1), torch.inf
        )
        return lower - lower.amin(1, keepdim=True)

    def _search_forces(
        self, trajectories: Trajectories, gap: Tensor, reference: np.ndarray, problem: ContactProblem
    ) -> tuple[ForceSearch, np.ndarray]:
        """Return the loads of each gesture's reference frame, and how many of these did not converge."""
        own_gap = gap[torch.from_numpy(reference)]
        cell = problem.shapes.body.cell[0] * problem.shapes.body.cell[1]

        def solved(rows: np.ndarray, load: np.ndarray, start: Tensor) -> tuple[Equilibrium, np.ndarray]:
            total = torch.from_numpy(load / cell)
            state = solve_contact(
                self.compliance,
                own_gap[torch.from_numpy(rows)],
                total,
                start,
                self.tolerance,
                self.iterations,
            )
            return state, (~(state.residual <= self.tolerance)).numpy()

        solution = find_force(
            solved, own_gap.isfinite().float(), trajectories.peak, trajectories.wanted, problem
        )
        return solution, solution.failed.astype(np.int64)


def _sag(body: AbstractBody, inside: Tensor) -> Tensor:
    """Return the distance of cells below the tangent plane at each object, (U, H * W), m; 0 on a flat body.

    Args:
        body: the touched body.
        inside: (U, H * W), bool, the cells under each object.
    """
    x, y = ((np.arange(count) + 0.5) * size for count, size in zip(body.cells, body.cell, strict=True))
    cells = np.stack([*np.meshgrid(x, y), np.zeros(body.shape)], axis=-1).reshape(-1, 3)
    cover = inside.double().numpy()
    middle = cover @ cells / np.maximum(cover.sum(axis=1, keepdims=True), 1)
    inward = body.frame(middle)[:, 2]
    below = inward @ body.locate(cells).T - (inward * body.locate(middle)).sum(axis=1, keepdims=True)
    return torch.from_numpy(below).float()


def _reference_frames(
    trajectories: Trajectories, full: np.ndarray, gap: Tensor, footprints: Tensor
) -> np.ndarray:
    """Return the frame of each gesture with the largest cover of a sensor, at its largest force, (B,)."""
    cover = (gap.isfinite().float() @ footprints.T).amax(1).double().numpy()
    strongest = trajectories.fraction >= full[trajectories.owner] * (1 - 1e-9)
    order = np.lexsort((-cover, ~strongest, trajectories.owner))
    return order[np.searchsorted(trajectories.owner[order], np.arange(len(full)))]
