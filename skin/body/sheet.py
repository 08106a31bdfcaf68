"""A flat sheet of silicone layers on a table."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from skin.body._memory import require_memory
from skin.body._variation import along, check_variation, factors
from skin.errors import InputError
from skin.material import Material

if TYPE_CHECKING:
    from skin.layout.base import Sensors

__all__ = ["Layer", "Sheet", "overlaps"]

# What any simulator holds per cell at least: 25 sensors' float64 weights and a gesture of 30 float32 frames.
_BYTES_PER_CELL = 25 * 8 + 30 * 4


@dataclass(frozen=True)
class Layer:
    """One layer of a sheet.

    Attributes:
        material: what it is made of.
        thickness: m.
    """

    material: Material
    thickness: float


@dataclass(frozen=True)
class Sheet:
    """A rectangular sheet of layers, glued to a table and cut into equal cells.

    x runs to the right, y downwards, both from the upper left corner; z is the depth below the surface.

    Attributes:
        size: extent (x, y), m.
        cells: number of cells (along x, along y); a pressure on the sheet is (..., H, W) with H = cells[1]
            and W = cells[0].
        layers: from the table up. A configuration gives each as ``{material, thickness}``, with the material
            as in :meth:`skin.material.Material.of` and the thickness in m.
        variation: standard deviation of Young's modulus from cell to cell of each layer, as a share of the
            layer's own, which stays its mean (log-normal, independent, so never below 0); 0: the same
            everywhere. Another mesh is another draw.
        variation_seed: what the moduli are drawn from.

    Raises:
        InputError: a size or thickness that is not positive, fewer than two cells along a side, no layer, an
            unknown material, a variation below 0, or more cells than memory allows.
    """

    size: tuple[float, float]
    cells: tuple[int, int]
    layers: tuple[Layer, ...]
    variation: float = 0.0
    variation_seed: int = 0

    def __post_init__(self) -> None:
        check_variation(self.variation, self.variation_seed)
        object.__setattr__(self, "size", _size(self.size))
        object.__setattr__(self, "cells", _cells(self.cells))
        object.__setattr__(self, "layers", _layers(self.layers))
        require_memory(
            _BYTES_PER_CELL * math.prod(self.cells),
            f"body.cells=[{self.cells[0]},{self.cells[1]}]",
            "give fewer cells, such as body.cells=[32,32]",
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W): the shape of a pressure frame, rows along y."""
        return self.cells[1], self.cells[0]

    @property
    def cell(self) -> tuple[float, float]:
        """Extent (x, y) of one cell, m."""
        return self.size[0] / self.cells[0], self.size[1] / self.cells[1]

    @property
    def thickness(self) -> float:
        """Thickness of all layers, m."""
        return sum(layer.thickness for layer in self.layers)

    @cached_property
    def interfaces(self) -> tuple[float, ...]:
        """Depth below the surface of each layer's upper face, m, from the table up; the last is 0.

        The table itself is no interface: nothing moves there.
        """
        above = [layer.thickness for layer in self.layers[1:]]
        return tuple(math.fsum(above[level:]) for level in range(len(self.layers)))

    @property
    def sensor_depth(self) -> float:
        """Where sensors lie by default, m: under the top layer; on the surface of a single layer."""
        return self.interfaces[-2] if len(self.layers) > 1 else 0.0

    @cached_property
    def moduli(self) -> np.ndarray:
        """Young's modulus of each cell over that of its layer, (layers, H, W), from the table up."""
        return factors(self.variation, self.variation_seed, (len(self.layers), *self.shape))

    @property
    def tension(self) -> float:
        """Force along the sheet per width and strain, N/m: the layers' E h together, without variation."""
        return sum(layer.material.young * layer.thickness for layer in self.layers)

    def stiffness(self, first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
        """Return how stiff strips of the sheet between places are along themselves, (n,), N/m.

        That is the layers' E h, averaged along the straight line where the modulus varies, times w / d.

        Args:
            first: where the strips begin, (n, 3), m.
            second: where they end, (n, 3), m; elsewhere than they begin.
            width: w of every strip, m.
        """
        per_layer = [layer.material.young * layer.thickness for layer in self.layers]
        per_cell = np.tensordot(per_layer, self.moduli, axes=1)
        tension = along(per_cell, self.cell, first[:, :2], second[:, :2])
        return tension * width / np.linalg.norm(second - first, axis=1)

    def footprint_areas(self, sensors: "Sensors") -> np.ndarray:
        """Return the area that each sensor's footprint shares with each cell, (S, H*W), m^2.

        A footprint that passes the sheet's edge is cut there.
        """
        along_x, along_y = (
            overlaps(
                np.linspace(0, self.size[axis], self.cells[axis] + 1),
                sensors.positions[:, axis],
                sensors.footprint[axis],
            )
            for axis in (0, 1)
        )
        return np.einsum("sh,sw->shw", along_y, along_x).reshape(len(sensors), -1)

    def footprints(self, sensors: "Sensors") -> np.ndarray:
        """Return weights (S, H*W) that sum to 1 per sensor.

        ``footprints(sensors) @ pressure.reshape(H * W)`` is the mean pressure over each sensor's footprint,
        Pa; cells that it covers in part weigh by area.
        """
        areas = self.footprint_areas(sensors)
        return areas / areas.sum(axis=1, keepdims=True)


def overlaps(edges: np.ndarray, centres: np.ndarray, extent: float) -> np.ndarray:
    """Return the length that intervals share with the cells between consecutive edges.

    Args:
        edges: (n + 1,), ascending, m.
        centres: (S,), the intervals' centres, m.
        extent: the intervals' length, m.

    Returns:
        (S, n), m.
    """
    low, high = (centres[:, None] + side * extent / 2 for side in (-1, 1))
    return np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0, None)


def _positive(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    )


def _size(given: Sequence[float]) -> tuple[float, float]:
    if not isinstance(given, Sequence) or len(given) != 2 or not all(map(_positive, given)):
        raise InputError(
            f"body.size must be two positive lengths (x, y) in m, got {given}: as in body.size=[0.16,0.16]"
        )
    return float(given[0]), float(given[1])


def _cells(given: Sequence[int]) -> tuple[int, int]:
    whole = isinstance(given, Sequence) and len(given) == 2 and all(type(n) is int and n >= 2 for n in given)
    if not whole:
        raise InputError(
            f"body.cells must be two whole numbers (along x, along y) of at least 2, got {given}: "
            "as in body.cells=[32,32]"
        )
    return given[0], given[1]


def _layers(given: Sequence[Any]) -> tuple[Layer, ...]:
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise InputError(
            f"body.layers must list at least one layer from the table up, got {given}: "
            "as in body.layers=[{material: EcoFlex 00-30, thickness: 0.005}]"
        )
    return tuple(_layer(number, layer) for number, layer in enumerate(given, start=1))


def _layer(number: int, given: Any) -> Layer:
    if isinstance(given, Layer):
        given = {"material": given.material, "thickness": given.thickness}
    if not isinstance(given, Mapping) or set(given) != {"material", "thickness"}:
        raise InputError(
            f"layer {number} from the table must be {{material, thickness}}, thickness in m, got {given}"
        )
    if not _positive(given["thickness"]):
        raise InputError(
            f"layer {number} from the table: thickness must be a positive length in m, "
            f"got {given['thickness']!r}"
        )
    return Layer(Material.of(given["material"]), float(given["thickness"]))
