"""Pressure under rigid objects on an elastic surface, many at once, by projected conjugate gradients."""

from typing import NamedTuple

import torch
from torch import Tensor

# Problems solved at once: their vectors then stay in the cache.
_PART = 256
# Errors under pressure this much smaller than the tolerance are rounding: no direction is taken from them.
_REST = 0.1


class Equilibrium(NamedTuple):
    """Where objects come to rest.

    Attributes:
        pressure: (B, N), Pa, not negative.
        residual: (B,), how far it is from fulfilling the conditions, as :func:`solve_contact` measures it.
        iterations: (B,), how many were taken.
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
    the largest gap under pressure or overlap anywhere, as a share of the largest deflection max(C p). Sum and
    sign of the pressure hold exactly at any residual.

    The method is that of Polonsky and Keer (Wear 231, 1999): conjugate gradients in the cells in contact;
    pressures that turn negative leave, cells that overlap join and restart the directions. Every iteration is
    one or two products of all pressures with C. Problems that are solved leave the batch. Where the cells in
    contact are at rest and only others overlap, as under symmetric objects, there is no direction: what is
    left of their errors is rounding, which differs from one processor to the next, or exactly 0.

    Args:
        compliance: C (N, N), m/Pa, symmetric and positive definite; its dtype is that of the solution.
        gap: g (B, N), m; infinite where there is no object.
        total: (B,), sum of the pressures, Pa: force by the area of a cell.
        start: (B, N), pressures to begin with, up to a factor; None: even.
        tolerance: the residual at which a problem is solved.
        iterations: at which it is given up.
    """
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
    found = Equilibrium(
        torch.zeros_like(gap), torch.full_like(total, torch.inf), torch.zeros(len(gap), dtype=torch.long)
    )
    state = _State(compliance, gap, total, start, _REST * tolerance)
    rows = torch.arange(len(gap))
    for step in range(iterations + 1):
        residual = state.residual()
        # The last look is at everything that is left; a residual that is no number is never solved.
        leaves = residual <= tolerance if step < iterations else torch.ones_like(residual, dtype=torch.bool)
        if leaves.any():
            gone = rows[leaves]
            found.pressure[gone] = state.pressure[leaves]
            found.residual[gone] = residual[leaves]
            found.iterations[gone] = step
            rows = rows[~leaves]
            if not len(rows):
                break
            state.keep(~leaves)
        state.step()
    return found


class _State:
    """The problems still to be solved, one per row."""

    def __init__(
        self, compliance: Tensor, gap: Tensor, total: Tensor, start: Tensor | None, rest: float
    ) -> None:
        # The rest is a share of the largest deflection.
        self.compliance, self.rest, self.total = compliance, rest, total
        self.allowed = gap.isfinite()
        self.gap = gap.where(self.allowed, 0)
        even = self.allowed.to(gap)
        begin = even if start is None else start.clamp(min=0) * even
        # Where the object has left all cells that it pressed before, memory is of no use.
        begin = torch.where(begin.sum(1, keepdim=True) > 0, begin, even)
        self.pressure = self._loaded(begin, total)
        self.deflection = self.pressure @ compliance
        self.direction = torch.zeros_like(gap)
        self.carried = torch.zeros_like(total)  # share of the last direction in the next, times its square
        self._look()

    def _loaded(self, pressure: Tensor, total: Tensor) -> Tensor:
        return pressure * (total / pressure.sum(1))[:, None]

    def _look(self) -> None:
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
        share = torch.where(self.carried > 0, square / self.carried, 0)
        along = (inside + share[:, None] * self.direction).where(self.touches, 0)
        # Cells that have left took their part of the sum with them.
        along = (along - (along.sum(1) / self.count)[:, None]).where(self.touches & moves[:, None], 0)
        answer = along @ self.compliance
        curvature = (along * answer).sum(1)
        # Without a direction the dent of a cell alone tells what a joining one needs.
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
        self._look()
