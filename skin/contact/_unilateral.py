"""Contact of rigid objects with an elastic surface, in batches, by projected conjugate gradients."""

from typing import NamedTuple

import torch
from torch import Tensor

# Problems per batch, so that their vectors stay in the processor's cache.
_PART = 256
# Errors below this share of the tolerance are rounding, and give no search direction.
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
    the largest gap under pressure or overlap anywhere, as a share of the largest deflection max(C p). Sum and
    sign of the pressure hold exactly at any residual.

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
        # The rest is a share of the largest deflection.
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
