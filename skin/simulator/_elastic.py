"""A solid body, factorised once: rows over its surface cells, and how all of it moves under each of them."""

import os
import sys
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from rich.console import Console
from rich.progress import track
from scipy.sparse.linalg import SuperLU

from skin.body._memory import require_memory
from skin.files import whole
from skin.simulator._factors import factorised
from skin.simulator._hexahedra import Hexahedra

_AT_ONCE = 32  # right-hand sides


class Elastic:
    """Hexahedra glued to a table.

    Args:
        mesh: the elements.

    Raises:
        InputError: more elements than memory allows.
    """

    def __init__(self, mesh: Hexahedra) -> None:
        self.mesh = mesh

    @cached_property
    def _factors(self) -> SuperLU:
        columns, rows, deep = self.mesh.counts
        require_memory(
            _bytes(columns, rows, deep),
            f"the stiffness of {columns} x {rows} x {deep} solid elements",
            "give fewer, such as body.cells=[32,32] or simulator.divisions=2",
        )
        return factorised(self.mesh.stiffness()[self._free][:, self._free].tocsc())

    @cached_property
    def _free(self) -> np.ndarray:
        return np.flatnonzero(~self.mesh.held)

    def solve(self, forces: np.ndarray) -> np.ndarray:
        """Return how far nodes move (3 N, L), m, under nodal forces (3 N, L), N."""
        moves = np.zeros_like(forces)
        moves[self._free] = self._factors.solve(np.ascontiguousarray(forces[self._free]))
        return moves

    def transfer(self, rows: sp.csr_matrix, axes: tuple[int, ...] = (0, 1, 2)) -> np.ndarray:
        """Return what rows (R, 3 N) read of 1 Pa on each cell along each axis: (axes, R, cells).

        One solve per row, of the transposed problem (K is symmetric), whatever the number of cells.
        """
        loads = [self.mesh.loads(axis) for axis in axes]
        influence = np.empty((len(axes), rows.shape[0], loads[0].shape[1]))
        for first in range(0, rows.shape[0], _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            adjoint = self.solve(rows[part].T.toarray())
            for load, out in zip(loads, influence, strict=True):
                out[part] = (load.T @ adjoint).T
        return influence

    def influence(self, axis: int, path: Path) -> np.ndarray:
        """Return how every node moves under 1 Pa on each cell, (3 N, cells) float32, m/Pa, read from a file.

        From it any row is read without another solve: ``rows @ influence``.

        Args:
            axis: along which the cells are loaded.
            path: of the file, x.npy; it is written if it is not there.
        """
        influence = self._influence(path)
        if influence is None:
            self._write_influence(axis, path)
            influence = self._influence(path)
        assert influence is not None
        return influence

    def _influence(self, path: Path) -> np.ndarray | None:
        """Return what a file holds, or None if there is none or it is no such array."""
        columns, rows, _ = self.mesh.counts
        shape = (len(self.mesh.held), columns * rows)
        try:
            influence = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, EOFError, ValueError):
            return None
        return influence if influence.shape == shape and influence.dtype == np.float32 else None

    def _write_influence(self, axis: int, path: Path) -> None:
        loads = self.mesh.loads(axis)
        parts = range(0, loads.shape[1], _AT_ONCE)
        with whole(path, "SKIN_CACHE=FOLDER") as partial:
            influence = np.lib.format.open_memmap(partial, mode="w+", dtype=np.float32, shape=loads.shape)
            _reserve(partial)
            console = Console(stderr=True)
            terminal = sys.stderr.isatty()
            for first in track(parts, "solving for each surface cell", console=console, disable=not terminal):
                influence[:, first : first + _AT_ONCE] = self.solve(
                    loads[:, first : first + _AT_ONCE].toarray()
                )
            influence.flush()
            del influence  # Windows does not rename a file that is mapped


def _reserve(path: Path) -> None:
    """Claim the disk space of a file that is mapped: to write to a map of a full disk kills the process."""
    if hasattr(os, "posix_fallocate"):
        with open(path, "rb+") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def _bytes(columns: int, rows: int, deep: int) -> float:
    """Estimate the memory that assembly and factors take, bytes.

    Measured on 16 to 48 cells a side and 4 to 6 rows: both factors have about (21.8 log2(side) - 59) entries
    per place and squared unknown of a column, at 18 bytes with what the solver holds besides; the assembly
    holds 24 x 24 numbers per element, five times over. The sum came within 10 % of the memory then measured.
    """
    places = float((columns + 1) * (rows + 1))
    filling = max(21.8 * np.log2(places**0.5) - 59, 12.0)
    return 18 * places * (3 * deep) ** 2 * filling + 40 * 24 * 24 * columns * rows * deep
