"""Where the sensors of a skin are, and which way they face."""

from dataclasses import dataclass, field

import numpy as np

MOST = 10_000
"""Sensors that a file may have: a thousand times those of a usual skin."""

REACHES = (0.0, 0.01, 0.02, 0.04)
"""Distances from a sensor at which its response to a fingertip is known, m."""

GEOMETRY = (
    *("x", "y", "depth", "normal_x", "normal_y", "normal_z", "footprint_x", "footprint_y"),
    *("width", "height", "thickness", "share"),
    *(f"response_{1e3 * reach:g}mm" for reach in REACHES),
)
"""What is known of a sensor and its skin: m, unit vectors; extent and thickness of the body, m; reading under
uniform pressure as a share of the force on the footprint; readings under a fingertip of 1 N at the distances
:data:`REACHES`, N."""


@dataclass(frozen=True)
class Sensors:
    """Sensors placed in a body.

    Attributes:
        positions: (S, 3), m: x to the right and y downwards from the body's upper left corner, z the depth
            below the surface. The order of the sensors is the order of the readings everywhere.
        footprint: extent (x, y) of the area over which one sensor feels, m.
        normals: (S, 3), unit vectors n, in the local frame (x, y, into the skin), along which each sensor
            feels: it reads n . sigma . n. One (3,) holds for all; by default they face the surface.
    """

    positions: np.ndarray
    footprint: tuple[float, float]
    normals: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        normals = np.broadcast_to(np.asarray(self.normals, dtype=float), self.positions.shape)
        object.__setattr__(self, "normals", normals.copy())

    @property
    def tilted(self) -> np.ndarray:
        """Which sensors do not face the surface, (S,), bool; up or down reads the same."""
        return (self.normals[:, :2] != 0).any(axis=1)

    def __len__(self) -> int:
        return len(self.positions)
