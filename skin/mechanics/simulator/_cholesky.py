"""Cholesky factors of a grid's stiffness: nested dissection of its plan, with dense fronts.

The grid is thin: its plan has many more nodes along each side than lie above each other. All unknowns above a
place of the plan are therefore eliminated together. The plan is halved by lines of positions until its parts
have a few positions a side; a part is eliminated before the lines around it (George, 1973). What remains of a
part is a dense matrix over the positions next to it, its front (Duff and Reid, 1983).
"""

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cholesky
from scipy.linalg.blas import dsyrk, dtrsm

_LEAF = 4  # places along a part that is not halved; 3 to 8 take the same time within 10 %

Part = tuple[slice, slice]  # of the plan: rows, columns


class Cholesky:
    """The factors of a symmetric and positive definite matrix over the positions of a plan.

    Args:
        stiffness: (layers * places * 3, the same); unknowns are layer by layer, each row by row, three to a
            place. A place touches its eight neighbours only.
        plan: rows and columns of positions.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """

    def __init__(self, stiffness: sp.csr_array, plan: tuple[int, int]) -> None:
        grid = np.arange(plan[0] * plan[1]).reshape(plan)
        parts = list(_dissected((slice(0, plan[0]), slice(0, plan[1]))))
        order = np.concatenate([grid[own].ravel() for own, _ in parts])
        rank = np.argsort(order).reshape(plan)
        unknowns = np.arange(stiffness.shape[0]).reshape(-1, grid.size, 3).swapaxes(0, 1)
        self._order = unknowns[order].reshape(grid.size, -1)
        self._fronts = list(self._eliminated(stiffness, parts, rank))

    def _eliminated(
        self, stiffness: sp.csr_array, parts: list[tuple[Part, Part]], rank: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield what each step eliminates: its unknowns, those that they touch, and the factors of both.

        Unknowns are numbered as they are eliminated. The factors are a lower triangle (own, own), and what is
        below it, (touched, own).
        """
        deep = self._order.shape[1]
        local = np.full(stiffness.shape[0], -1)  # where an unknown is in the front at hand
        waiting: list[tuple[np.ndarray, np.ndarray]] = []  # what is left of parts, and the ranks of positions
        for own, part in parts:
            grown = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in part)
            ranks = np.concatenate([rank[own].ravel(), np.setdiff1d(rank[grown], rank[part])])
            unknowns, inner = self._order[ranks].ravel(), rank[own].size * deep
            front = np.zeros((len(unknowns), len(unknowns)), order="F")
            local[unknowns] = np.arange(len(unknowns))
            rows = stiffness[unknowns[:inner]]
            into, column = local[rows.indices], np.repeat(np.arange(inner), np.diff(rows.indptr))
            front[into[into >= 0], column[into >= 0]] = rows.data[into >= 0]
            local[unknowns] = -1
            for child, positions in [waiting.pop() for _ in range(2 * (own != part))]:
                _add(front, child, np.searchsorted(ranks, positions), deep)
            diagonal = cholesky(front[:inner, :inner], lower=True, check_finite=False)
            below, rest = (
                np.asfortranarray(front[inner:, part]) for part in (slice(inner), slice(inner, None))
            )
            if len(below):  # nothing is left of the last line
                below = dtrsm(1.0, diagonal, below, side=1, lower=1, trans_a=1, overwrite_b=1)
                waiting.append(
                    (dsyrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1), ranks[inner // deep :])
                )
            first, *_ = numbers = (ranks[:, None] * deep + np.arange(deep)).ravel()
            yield slice(first, first + inner), numbers[inner:], diagonal, below

    def solve(self, forces: np.ndarray) -> np.ndarray:
        """Return the solutions (n, L) of right-hand sides (n, L)."""
        order = self._order.ravel()
        values = np.ascontiguousarray(forces[order])
        for own, border, diagonal, below in self._fronts:
            values[own] = dtrsm(1.0, diagonal, values[own].T, side=1, lower=1, trans_a=1).T
            values[border] -= below @ values[own]
        for own, border, diagonal, below in reversed(self._fronts):
            values[own] -= below.T @ values[border]
            values[own] = dtrsm(1.0, diagonal, values[own].T, side=1, lower=1).T
        solved = np.empty_like(values)
        solved[order] = values
        return solved


def _dissected(part: Part) -> Iterator[tuple[Part, Part]]:
    """Yield what is eliminated at once, a line or a small part, and the part that is then done with."""
    sides = [side.stop - side.start for side in part]
    axis = int(sides[1] >= sides[0])
    if sides[axis] <= _LEAF:
        yield part, part
        return
    middle = (part[axis].start + part[axis].stop) // 2
    line, *pieces = (
        (part[0], slice(*ends)) if axis else (slice(*ends), part[1])
        for ends in ((middle, middle + 1), (part[axis].start, middle), (middle + 1, part[axis].stop))
    )
    for piece in pieces:
        yield from _dissected(piece)
    yield line, part


def _add(front: np.ndarray, child: np.ndarray, positions: np.ndarray, deep: int) -> None:
    """Add the lower triangle of a matrix over some positions of a front, ascending, to it, run by run."""
    starts = np.flatnonzero(np.diff(positions, prepend=-2) != 1)
    runs = [
        (slice(deep * start, deep * stop), slice(deep * positions[start], deep * (positions[stop - 1] + 1)))
        for start, stop in zip(starts, [*starts[1:], len(positions)], strict=True)
    ]
    for number, (rows, into) in enumerate(runs):
        for columns, across in runs[: number + 1]:
            front[into, across] += child[rows, columns]
