"""Solutions for an elastic half-space: tractions on a square, and rigid objects.

Point solutions of Boussinesq (across the surface) and Cerruti (along x), as in K. L. Johnson, Contact
Mechanics (1985), sections 3.2 and 3.6. x and y lie on the surface, z points into the body, stress is positive
in tension.
"""

import math
from dataclasses import dataclass

import numpy as np

# F / (E* d side) of a rigid square punch is pi times the capacitance of a unit square plate over 4 pi eps0:
# both ask for the density whose 1/r potential is even. 0.3667874 is F. H. Read's (J. Comput. Phys. 133,
# 1997).
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

    def under_pressure(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return motion (P, 3), m, and stress (P, 3): zz, xz, yz, Pa, under pressure.

        Args:
            places: (P, 3), m; not within the square itself.
        """
        x, y, z, r, weights = self._about(places)
        nu = self.poisson
        aside = z / r**3 - (1 - 2 * nu) / (r * (r + z))
        down = z**2 / r**3 + 2 * (1 - nu) / r
        motion = np.stack([x * aside, y * aside, down], axis=-1) / (4 * np.pi * self.shear)
        stress = -3 * z[..., None] ** 2 / (2 * np.pi * r[..., None] ** 5) * np.stack([z, x, y], axis=-1)
        return _sum(motion, weights), _sum(stress, weights)

    def under_shear(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same under a traction of 1 Pa along x."""
        x, y, z, r, weights = self._about(places)
        rest = 1 - 2 * self.poisson
        along = 1 / r + x**2 / r**3 + rest * (1 / (r + z) - x**2 / (r * (r + z) ** 2))
        across = x * y / r**3 - rest * x * y / (r * (r + z) ** 2)
        down = x * z / r**3 + rest * x / (r * (r + z))
        motion = np.stack([along, across, down], axis=-1) / (4 * np.pi * self.shear)
        stress = -3 * (x * z / r**5)[..., None] / (2 * np.pi) * np.stack([z, x, y], axis=-1)
        return _sum(motion, weights), _sum(stress, weights)

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

    def _about(self, places: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return x, y, z and r from each point of the square (Q,) to each place (P,), and point areas."""
        source = self.half * np.stack(np.meshgrid(_POINTS, _POINTS), axis=-1).reshape(-1, 2)
        weights = self.half**2 * np.outer(_WEIGHTS, _WEIGHTS).ravel()
        x, y = (places[:, axis, None] - source[:, axis] for axis in (0, 1))
        z = np.broadcast_to(places[:, 2, None], x.shape)
        return x, y, z, np.sqrt(x**2 + y**2 + z**2), weights


@dataclass(frozen=True)
class Hertz:
    """A rigid sphere on a half-space (Johnson, section 4.2).

    Attributes:
        radius: of the sphere, m.
        modulus: E / (1 - nu^2), Pa.
    """

    radius: float
    modulus: float

    def force(self, approach: float) -> float:
        """Return the force, N, at an approach, m."""
        return 4 / 3 * self.modulus * math.sqrt(self.radius) * approach**1.5

    def contact(self, force: float) -> float:
        """Return the contact's radius, m."""
        return (3 * force * self.radius / (4 * self.modulus)) ** (1 / 3)

    def peak(self, force: float) -> float:
        """Return the peak pressure, Pa."""
        return 1.5 * force / (math.pi * self.contact(force) ** 2)


def round_punch(modulus: float, radius: float, approach: float) -> float:
    """Return the force, N, of a flat round punch without friction (Johnson, section 3.4)."""
    return 2 * radius * modulus * approach


def square_punch(modulus: float, side: float, approach: float) -> float:
    """Return the force, N, of a flat square punch without friction."""
    return SQUARE_PUNCH * modulus * side * approach


def _sum(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Integrate (P, Q, k) over the square, (P, k)."""
    return np.einsum("pqk,q->pk", values, weights)
