"""Independent solutions: exact ones, and by the solid's elements without the simulator's own solver.

A half-space: point solutions of Boussinesq (across the surface) and Cerruti (along x), as in K. L. Johnson,
Contact Mechanics (1985), sections 3.2 and 3.6. x and y lie on the surface, z points into the body, stress is
positive in tension.

Layers: under a load cos(k x) every quantity is a wave of the same length times a function of depth, which
obeys four ordinary differential equations (Vlasov's method of initial functions), and two for motions across
the wave. A pressure on a rectangle within smooth walls is a sum of such waves.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.special import j0, j1

from skin.body.sheet import Sheet
from skin.mechanics.simulator._mesh import Hexahedra
from skin.mechanics.simulator.base import factorised

# F / (E* d side) of a flat rigid square punch without friction, E* = E / (1 - nu^2), is pi times the
# capacitance of a unit square plate over 4 pi eps0: both ask for the density whose 1/r potential is even.
# 0.3667874 is F. H. Read's (J. Comput. Phys. 133, 1997).
SQUARE_PUNCH = math.pi * 0.3667874

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(24)


@dataclass(frozen=True)
class HalfSpace:
    """An elastic half-space under 1 Pa on the square |x|, |y| < half.

    Attributes:
        young: E, Pa.
        poisson: nu.
        half: of the square's side, m.
    """

    young: float
    poisson: float
    half: float

    @property
    def shear(self) -> float:
        """G, Pa."""
        return self.young / (2 * (1 + self.poisson))

    def under_pressure(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return motion (P, 3), m, and stress (P, 3): zz, xz, yz, Pa, under pressure.

        Args:
            positions: (P, 3), m; not within the square itself.
        """
        x, y, z, r, weights = self._distances(positions)
        nu = self.poisson
        aside = z / r**3 - (1 - 2 * nu) / (r * (r + z))
        down = z**2 / r**3 + 2 * (1 - nu) / r
        motion = np.stack([x * aside, y * aside, down]) / (4 * np.pi * self.shear)
        stress = -3 * z**2 / (2 * np.pi * r**5) * np.stack([z, x, y])
        return (motion @ weights).T, (stress @ weights).T

    def under_shear(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same under a traction of 1 Pa along x."""
        x, y, z, r, weights = self._distances(positions)
        fraction = 1 - 2 * self.poisson
        along = 1 / r + x**2 / r**3 + fraction * (1 / (r + z) - x**2 / (r * (r + z) ** 2))
        across = x * y / r**3 - fraction * x * y / (r * (r + z) ** 2)
        down = x * z / r**3 + fraction * x / (r * (r + z))
        motion = np.stack([along, across, down]) / (4 * np.pi * self.shear)
        stress = -3 * x * z / (2 * np.pi * r**5) * np.stack([z, x, y])
        return (motion @ weights).T, (stress @ weights).T

    def middle(self) -> tuple[float, float]:
        """Return the displacement of the square's middle, m: down under pressure, along x under traction.

        In polar coordinates the singularity cancels: the integral of f(angle) / r is that of f times the
        distance to the square's edge.
        """
        angle = (np.arange(4000) + 0.5) * np.pi / 8000  # by the middle rule; a quarter of the turn
        edge = self.half / np.maximum(np.cos(angle), np.sin(angle))
        step = 4 * np.pi / 8000 / (2 * np.pi * self.shear)
        down = (1 - self.poisson) * edge.sum() * step
        along = ((1 - self.poisson + self.poisson * np.cos(angle) ** 2) * edge).sum() * step
        return float(down), float(along)

    def _distances(self, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return x, y, z and r from each point of the square (Q,) to each position (P,), and areas."""
        source = self.half * np.stack(np.meshgrid(_POINTS, _POINTS), axis=-1).reshape(-1, 2)
        weights = self.half**2 * np.outer(_WEIGHTS, _WEIGHTS).ravel()
        x, y = (positions[:, axis, None] - source[:, axis] for axis in (0, 1))
        z = np.broadcast_to(positions[:, 2, None], x.shape)
        return x, y, z, np.sqrt(x**2 + y**2 + z**2), weights


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
    fraction = 2 * c * np.sinh(2 * depth) - 4 * depth
    fraction /= 2 * c * np.cosh(2 * depth) + 4 * depth**2 + 1 + c**2
    return float(fraction * 2 * (1 - slab.poisson**2) / (slab.young * number))


class Discs:
    """Forces on squares at a depth of endless layers under discs of even load, by Hankel integrals.

    Stresses of a disc are tabulated over its radius and the distance, and joined by cubic splines.

    Args:
        slabs: from the surface down.
        depth: of the squares, m; where waves shorter than 1 / 40 of it have died away.
        radii: least and largest radius of a disc, m.
        reach: largest distance of a square's middle, m.
        edges: what is added to the radius, m; the load is the mean of such discs.
    """

    def __init__(
        self,
        slabs: Sequence[Slab],
        depth: float,
        radii: tuple[float, float],
        reach: float = 0.1,
        edges: Sequence[float] = (0.0,),
    ) -> None:
        knots, weight = np.polynomial.legendre.leggauss(1200)
        longest = 40 / depth
        number, weight = (knots + 1) / 2 * longest, weight / 2 * longest
        states = waves(number, slabs, depth)[:, 3:]
        (down, along), (sunk, dragged), across = -states[:, 0, :2].T, states[:, 1, :2].T, states[:, 2, 2]
        # Waves from the surface fade over a depth, so that a twelfth of it is a fine step.
        step = min(depth / 12, 5e-4)
        radius = np.linspace(*radii, max(5, math.ceil((radii[1] - radii[0]) / step)))
        away = np.linspace(0, 1.1 * reach, math.ceil(1.1 * reach / step))
        discs = (radius[:, None] + np.array(edges)).clip(min=0)
        strength = weight * np.mean([part * j1(number * part) for part in discs.T[..., None]], axis=0)
        phase = np.outer(number, away).clip(1e-9)
        even, once = j0(phase), j1(phase)
        twice = 2 * once / phase - even
        terms = [(down, even), (sunk, once), (-along, once)]
        terms += [((dragged + across) / 2, even), ((across - dragged) / 2, twice)]
        self._stresses = [
            RectBivariateSpline(radius, away, (strength * wave) @ function) for wave, function in terms
        ]

    def forces(self, discs: np.ndarray, squares: np.ndarray, side: float) -> np.ndarray:
        """Return the forces (N, S) into the layers, N, of discs under a pressure of 1 Pa.

        Args:
            discs: (N, 3), x, y and radius, m.
            squares: (S, 2), their middles, m.
            side: of the squares, m.
        """
        return self._integrate(discs, squares, side, 1)[..., 0]

    def tractions(self, discs: np.ndarray, squares: np.ndarray, side: float) -> np.ndarray:
        """Return the forces (N, S, 3, 3) along x, along y and inwards, N, of discs under 1 Pa along each.

        Args:
            discs, squares, side: as of :meth:`forces`.
        """
        down, pushed_x, pushed_y, sunk_x, sunk_y, even, cos, sin = np.moveaxis(
            self._integrate(discs, squares, side, 5), 2, 0
        )
        forces = [[even + cos, sin, pushed_x], [sin, even - cos, pushed_y], [sunk_x, sunk_y, down]]
        return np.moveaxis(np.array(forces), (0, 1), (2, 3))

    def _integrate(self, discs: np.ndarray, squares: np.ndarray, side: float, count: int) -> np.ndarray:
        """Return integrals over squares of the first tables, times the cosine and sine of their angle."""
        points, weights = np.polynomial.legendre.leggauss(6)
        total = np.zeros((len(discs), len(squares), 1 if count == 1 else 8))
        radius = np.broadcast_to(discs[:, 2:], total.shape[:2])
        for (x, along), (y, across) in product(zip(points, weights, strict=True), repeat=2):
            shift = squares + np.array([x, y]) * side / 2 - discs[:, None, :2]
            away = np.hypot(*np.moveaxis(shift, 2, 0))
            tables = [table.ev(radius, away) for table in self._stresses[:count]]
            if count > 1:
                cos, sin = np.moveaxis(shift / away.clip(1e-12)[..., None], 2, 0)
                down, pushed, sunk, even, twice = tables
                turned = pushed * cos, pushed * sin, sunk * cos, sunk * sin, even
                tables = [down, *turned, twice * (cos**2 - sin**2), twice * 2 * cos * sin]
            total += along * across * side**2 / 4 * np.stack(tables, axis=-1)
        return total


def waves(number: np.ndarray, slabs: Sequence[Slab], depth: float) -> np.ndarray:
    """Return how waves of 1 Pa move and stress a depth, (n, 6, 3), m/Pa and Pa/Pa.

    Rows are the motions along the wave, into the skin and across, then sigma_zz and the shears along and
    across. Columns are the loads: pressure, and shear along and across. Motions along and shears along are a
    quarter of a wave before the others. In each slab three waves fade downwards and three upwards.

    Args:
        number: k, (n,), 1/m, above 0.
        slabs: from the surface down; the last is bonded to a rigid base.
        depth: m; at an interface it may belong to either layer.
    """
    unknowns = 6 * len(slabs)
    system = np.zeros((len(number), unknowns, unknowns))
    scale = slabs[0].shear * number[:, None, None]
    row, last = 0, len(slabs) - 1
    for index, slab in enumerate(slabs):
        columns = slice(6 * index, 6 * index + 6)
        top, bottom = (_basis(number, slab, at, scale) for at in (0.0, slab.thickness))
        if index == 0:
            system[:, 0:3, columns] = top[:, 3:]
            row = 3
        else:
            system[:, row : row + 6, columns] = -top
            row += 6
        if index < last:
            system[:, row : row + 6, columns] = bottom
        else:
            system[:, row : row + 3, columns] = bottom[:, :3]
    right = np.zeros((len(number), unknowns, 3))
    right[:, :3] = np.diag([-1, 1, 1]) / scale
    amounts = np.linalg.solve(system, right)
    above = 0.0
    for index, slab in enumerate(slabs):
        if depth <= above + slab.thickness or index == last:
            state = _basis(number, slab, depth - above, scale) @ amounts[:, 6 * index : 6 * index + 6]
            return state * np.concatenate([np.ones((len(number), 3, 1)), np.tile(scale, (1, 3, 1))], axis=1)
        above += slab.thickness
    raise AssertionError


def _basis(number: np.ndarray, slab: Slab, at: float, scale: np.ndarray) -> np.ndarray:
    """Return the states (n, 6, 6) of six solutions at a depth within a slab.

    A state holds the rows of :func:`waves`, stresses over ``scale`` (n, 1, 1), Pa/m. Solutions fade from the
    face where they begin, so that no exponential overflows.
    """
    matrix = _matrix(slab)
    down, up = number * at, number * (slab.thickness - at)
    states = []
    for sign, way in ((-1.0, down), (1.0, up)):
        shifted = matrix - sign * np.eye(6)
        # matrix has the eigenvalues 1 and -1 three times each; this is the invariant space of ``sign``.
        plane = np.linalg.svd((matrix + sign * np.eye(6)) @ (matrix + sign * np.eye(6)))[0][:, :3]
        grown = plane - sign * way[:, None, None] * (shifted @ plane)
        states.append(np.exp(-way)[:, None, None] * grown)
    basis = np.concatenate(states, axis=2)
    units = np.ones((len(number), 6, 1))
    units[:, 3:] = slab.shear * number[:, None, None] / scale
    return basis * units


def _matrix(slab: Slab) -> np.ndarray:
    """Return d/d(kz) of motions along, down and across, sigma_zz / Gk and shears / Gk of a wave, (6, 6)."""
    ratio = 2 * slab.poisson / (1 - 2 * slab.poisson)  # lambda / G
    whole = ratio + 2
    return np.array(
        [
            [0, -1, 0, 0, 1, 0],
            [ratio / whole, 0, 0, 1 / whole, 0, 0],
            [0, 0, 0, 0, 0, 1],
            [0, 0, 0, 0, 1, 0],
            [whole - ratio**2 / whole, 0, 0, -ratio / whole, 0, 0],
            [0, 0, 1, 0, 0, 0],
        ]
    )


# Faces of a block, as indices into its nodes (depth, y, x).
FACES: dict[str, tuple[int | slice, ...]] = {
    "left": (slice(None), slice(None), 0),
    "right": (slice(None), slice(None), -1),
    "near": (slice(None), 0, slice(None)),
    "far": (slice(None), -1, slice(None)),
    "top": (0, slice(None), slice(None)),
    "base": (-1, slice(None), slice(None)),
}
ALL = (0, 1, 2)
# Smooth walls on all sides: the block is then one period of an infinite layer.
WALLS: dict[str, tuple[int, ...]] = {"left": (0,), "right": (0,), "near": (1,), "far": (1,), "base": ALL}

_FLAT = Sheet([1.0, 1.0], [2, 2], [{"material": "EcoFlex 00-30", "thickness": 1.0}])  # type: ignore[arg-type]


def block(
    lines: tuple[np.ndarray, np.ndarray, np.ndarray], young: float | np.ndarray, poisson: float | np.ndarray
) -> Hexahedra:
    """Return a flat block.

    Args:
        lines: of its elements along x, y and depth, m.
        young: E, Pa, of all or of each row of elements (K,).
        poisson: nu, of all or of each row (K,).
    """
    young, poisson = (np.broadcast_to(values, len(lines[2]) - 1).astype(float) for values in (young, poisson))
    return Hexahedra(lines, young, poisson, _FLAT.locate, _FLAT.frame)


def graded(fine: float, count: int, far: float, growth: float) -> np.ndarray:
    """Return grid lines from 0: ``count`` steps of length ``fine``, then growing steps to beyond ``far``."""
    beyond = math.log1p((far / fine - count) * (1 - 1 / growth)) / math.log(growth)  # of a geometric sum
    steps = fine * growth ** np.arange(1, math.ceil(beyond) + 1)
    return np.concatenate([fine * np.arange(count + 1), fine * count + steps.cumsum()])


def held(mesh: Hexahedra, faces: Mapping[str, tuple[int, ...]]) -> np.ndarray:
    """Return which degrees of freedom are fixed, (3 N,), bool, from the fixed axes of each face."""
    columns, rows, deep = mesh.counts
    mask = np.zeros((deep + 1, rows + 1, columns + 1, 3), dtype=bool)
    for face, axes in faces.items():
        for axis in axes:
            mask[(*FACES[face], axis)] = True
    return mask.ravel()


def solve_block(mesh: Hexahedra, fixed: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Return the nodal displacements (3 N, L), m, under nodal forces (3 N, L), N.

    Args:
        mesh: the elements.
        fixed: (3 N,), bool, which degrees of freedom are fixed.
        forces: N.
    """
    free = np.flatnonzero(~fixed)
    factors = factorised(mesh.stiffness()[free][:, free].tocsc())
    moves = np.zeros_like(forces)
    moves[free] = factors.solve(np.ascontiguousarray(forces[free]))
    return moves
