"""Rigid objects: the image gives their height, and contact mechanics the pressure."""

from typing import Annotated, final

import numpy as np
import torch
from annotated_types import Ge
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor

from skin.body.base import AbstractBody
from skin.contact._checkerboard import stabilise_checkerboard
from skin.contact._force import ForceSearch, find_force
from skin.contact._unilateral import Equilibrium, solve_contact
from skin.contact.base import AbstractContact
from skin.settings import checked
from skin.simulator.base import AbstractSimulator
from skin.touch.gesture import Trajectories
from skin.touch.sampler import ContactProblem, ContactResult


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
    range (:mod:`skin.contact._force`). A frame that does not converge to ``tolerance`` is not used: its
    gesture is drawn again and counted.

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
        self.compliance = stabilise_checkerboard(simulator.compliance().detach().cpu().double(), body).float()

    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure at a force that gives the wanted classes, if there is one."""
        body = problem.shapes.body
        cell = body.cell[0] * body.cell[1]
        gap = self.gap(trajectories, problem)
        full = np.zeros(len(trajectories.peak))
        np.maximum.at(full, trajectories.owner, trajectories.share)
        reference = _reference_frames(trajectories, full, gap, problem.footprints)
        forces, lost = self._sought(trajectories, gap, reference, problem)
        force = forces.load / full
        refused = np.isnan(force)

        solved = np.flatnonzero(~refused[trajectories.owner])
        rows, owner = torch.from_numpy(solved), torch.from_numpy(trajectories.owner[solved])
        totals = torch.from_numpy(force[trajectories.owner[solved]] * trajectories.share[solved] / cell)
        # A static touch starts from its solution at the largest force.
        stands = (
            trajectories.place[solved] == trajectories.place[reference][trajectories.owner[solved]]
        ).all(axis=1)
        start = forces.pressure[owner] * torch.from_numpy(stands)[:, None]
        states = solve_contact(self.compliance, gap[rows], totals, start, self.tolerance, self.iterations)
        missed = trajectories.owner[solved][(~(states.residual <= self.tolerance)).numpy()]
        lost += np.bincount(missed, minlength=len(force))

        frames = gap.isfinite().float()
        shares = torch.from_numpy(trajectories.share).float()[:, None]
        frames[rows] = states.pressure
        peak = np.zeros(len(force))
        np.maximum.at(peak, trajectories.owner[solved], states.pressure.amax(1).double().numpy())
        frames = (frames / shares).view(-1, *body.shape)
        # At other places of a path, or under a small object, the peak may exceed its range.
        settings = problem.settings
        dangerous = trajectories.wanted[:, 3]
        refused |= peak > np.where(dangerous, settings.dangerous_peak[1], settings.safe_peak[1])
        refused |= lost > 0
        return ContactResult(frames, force, peak, refused, forces.area, lost)

    def gap(self, trajectories: Trajectories, problem: ContactProblem) -> Tensor:
        """Return the gap between object and cells at first contact, (U, H * W), m.

        Infinite where there is no object. On an arm the object moves along the normal at its middle, and the
        gap includes the curvature of the skin.
        """
        solids = problem.shapes.solids(*trajectories.poses)
        lower = self.relief * (1 - solids.grey)
        inward = (self.fillet - solids.rim).clamp(min=0, max=self.fillet)
        lower += self.fillet - (self.fillet**2 - inward**2).clamp(min=0).sqrt()
        lower = (lower.flatten(1) + _sag(problem.shapes.body, solids.inside.flatten(1))).where(
            solids.inside.flatten(1), torch.inf
        )
        return lower - lower.amin(1, keepdim=True)

    def _sought(
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
            solved, own_gap.isfinite().float(), trajectories.peak, trajectories.wanted[:, [0, 3]], problem
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
    below = inward @ body.place(cells).T - (inward * body.place(middle)).sum(axis=1, keepdims=True)
    return torch.from_numpy(below).float()


def _reference_frames(
    trajectories: Trajectories, full: np.ndarray, gap: Tensor, footprints: Tensor
) -> np.ndarray:
    """Return the frame of each gesture with the largest cover of a sensor, at its largest force, (B,)."""
    cover = (gap.isfinite().float() @ footprints.T).amax(1).double().numpy()
    strongest = trajectories.share >= full[trajectories.owner] * (1 - 1e-9)
    order = np.lexsort((-cover, ~strongest, trajectories.owner))
    return order[np.searchsorted(trajectories.owner[order], np.arange(len(full)))]
