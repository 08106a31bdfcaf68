"""Exact solution for layers on a rigid base under waves of pressure.

Under a pressure p cos(k x) every quantity is a wave of the same length times a function of depth, which obeys
four ordinary differential equations (Vlasov's method of initial functions). A pressure on a rectangle within
smooth walls is a sum of such waves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Slab:
    """One layer: thickness, m, Young's modulus, Pa, Poisson's ratio. Stacks go from the surface down."""

    thickness: float
    young: float
    poisson: float

    @property
    def shear(self) -> float:
        """G, Pa."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def confined(self) -> float:
        """Modulus of confined compression lambda + 2 G, Pa."""
        return 2 * self.shear * (1 - self.poisson) / (1 - 2 * self.poisson)


def bonded_layer(number: float, slab: Slab) -> float:
    """Return the surface's motion per pressure under a wave, m/Pa, in closed form.

    One layer bonded to a rigid base (Aleksandrov and Vorovich): 2 (1 - nu^2) / (E k) times
    (2 c sinh 2 kh - 4 kh) / (2 c cosh 2 kh + 4 (kh)^2 + 1 + c^2), c = 3 - 4 nu.

    Args:
        number: k, 1/m.
        slab: the layer.
    """
    depth, c = number * slab.thickness, 3 - 4 * slab.poisson
    share = 2 * c * np.sinh(2 * depth) - 4 * depth
    share /= 2 * c * np.cosh(2 * depth) + 4 * depth**2 + 1 + c**2
    return float(share * 2 * (1 - slab.poisson**2) / (slab.young * number))


def waves(number: np.ndarray, slabs: Sequence[Slab], depth: float) -> np.ndarray:
    """Return how waves of pressure of 1 Pa move and stress a depth: (n, 2), m/Pa and Pa/Pa.

    The first is the motion into the skin, the second sigma_zz, both in phase with the pressure.

    Args:
        number: k, (n,), 1/m; 0 is an even pressure.
        slabs: from the surface down; the last is bonded to a rigid base.
        depth: m; at an interface it may belong to either layer.
    """
    found = np.empty((len(number), 2))
    even = number == 0
    found[even] = _even(slabs, depth)
    found[~even] = _waving(number[~even], slabs, depth)
    return found


def patch_mean(lengths: np.ndarray, side: float, low: float, high: float) -> np.ndarray:
    """Return the means of cos(m pi x / side) between two places, (m,)."""
    turn = np.pi * lengths / side
    safe = np.where(turn == 0, 1, turn)
    return np.where(turn == 0, 1, (np.sin(safe * high) - np.sin(safe * low)) / (safe * (high - low)))


def patch(
    slabs: Sequence[Slab],
    size: tuple[float, float],
    loaded: tuple[float, float, float, float],
    felt: tuple[float, float, float, float],
    depth: float,
    count: int = 400,
) -> np.ndarray:
    """Return motion (m/Pa) and sigma_zz (Pa/Pa) per even pressure on a rectangle, (2,), means over another.

    The layers lie within smooth walls, so that they continue as their own mirror image for ever.

    Args:
        slabs: from the surface down.
        size: extent (x, y) between the walls, m.
        loaded: x from, x to, y from, y to, m.
        felt: the same, of the rectangle over which is averaged.
        depth: of the averaged rectangle, m.
        count: waves along each side.
    """
    order = np.arange(count)
    weights = []
    for axis, side in enumerate(size):
        low, high = loaded[2 * axis : 2 * axis + 2]
        strength = patch_mean(order, side, low, high) * (high - low) / side * np.where(order == 0, 1, 2)
        weights.append(strength * patch_mean(order, side, *felt[2 * axis : 2 * axis + 2]))
    number = np.pi * np.hypot(order[:, None] / size[0], order / size[1])
    answer = waves(number.ravel(), slabs, depth).reshape(count, count, 2)
    return np.einsum("m,n,mnk->k", weights[0], weights[1], answer)


def _even(slabs: Sequence[Slab], depth: float) -> tuple[float, float]:
    """Return motion and stress under an even pressure: confined compression."""
    bottoms = np.cumsum([slab.thickness for slab in slabs])
    below = sum(
        min(slab.thickness, max(bottom - depth, 0)) / slab.confined
        for slab, bottom in zip(slabs, bottoms, strict=True)
    )
    return float(below), -1.0


def _waving(number: np.ndarray, slabs: Sequence[Slab], depth: float) -> np.ndarray:
    """Solve for two waves that fade downwards and two that fade upwards in each slab."""
    unknowns = 4 * len(slabs)
    system = np.zeros((len(number), unknowns, unknowns))
    scale = slabs[0].shear * number[:, None, None]
    row, last = 0, len(slabs) - 1
    for index, slab in enumerate(slabs):
        own = slice(4 * index, 4 * index + 4)
        top, bottom = (_basis(number, slab, at, scale) for at in (0.0, slab.thickness))
        if index == 0:
            system[:, 0:2, own] = top[:, 2:]
            row = 2
        else:
            system[:, row : row + 4, own] = -top
            row += 4
        if index < last:
            system[:, row : row + 4, own] = bottom
        else:
            system[:, row : row + 2, own] = bottom[:, :2]
    right = np.zeros((len(number), unknowns, 1))
    right[:, 0] = -1 / scale[:, 0]
    amounts = np.linalg.solve(system, right)
    above = 0.0
    for index, slab in enumerate(slabs):
        if depth <= above + slab.thickness or index == last:
            state = _basis(number, slab, depth - above, scale) @ amounts[:, 4 * index : 4 * index + 4]
            return np.column_stack([state[:, 1, 0], state[:, 2, 0] * scale[:, 0, 0]])
        above += slab.thickness
    raise AssertionError


def _basis(number: np.ndarray, slab: Slab, at: float, scale: np.ndarray) -> np.ndarray:
    """Return the states (n, 4, 4) of four solutions at a depth within a slab.

    A state holds the motions along the wave and down, then sigma_zz and the shear over ``scale`` (n, 1, 1),
    Pa/m. Solutions fade from the face where they begin, so that no exponential overflows.
    """
    matrix = _matrix(slab)
    down, up = number * at, number * (slab.thickness - at)
    states = []
    for sign, way in ((-1.0, down), (1.0, up)):
        shifted = matrix - sign * np.eye(4)
        # matrix has the eigenvalues 1 and -1 twice each; this is the invariant plane of ``sign``.
        plane = np.linalg.svd((matrix + sign * np.eye(4)) @ (matrix + sign * np.eye(4)))[0][:, :2]
        grown = plane - sign * way[:, None, None] * (shifted @ plane)
        states.append(np.exp(-way)[:, None, None] * grown)
    basis = np.concatenate(states, axis=2)
    own = np.ones((len(number), 4, 1))
    own[:, 2:] = slab.shear * number[:, None, None] / scale
    return basis * own


def _matrix(slab: Slab) -> np.ndarray:
    """Return d/d(kz) of (motion along, motion down, sigma_zz / Gk, shear / Gk) under a wave, (4, 4)."""
    ratio = 2 * slab.poisson / (1 - 2 * slab.poisson)  # lambda / G
    whole = ratio + 2
    return np.array(
        [
            [0, -1, 0, 1],
            [ratio / whole, 0, 1 / whole, 0],
            [0, 0, 0, 1],
            [whole - ratio**2 / whole, 0, -ratio / whole, 0],
        ]
    )
