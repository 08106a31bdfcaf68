"""The interface of a body: layers of silicone on a rigid support, and a chart of their surface."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from skin.body._memory import require_memory
from skin.body._variation import along, factors
from skin.errors import InputError
from skin.material import Material
from skin.settings import checked, configured

if TYPE_CHECKING:
    from skin.sensors import Sensors

# What any simulator holds per cell at least: 25 sensors' float64 weights and a gesture of 30 float32 frames.
_BYTES_PER_CELL = 25 * 8 + 30 * 4


@checked("body.layers")
@dataclass(frozen=True)
class Layer:
    """One layer of a body.

    Attributes:
        material: what it is made of.
        thickness: m.
    """

    material: Material
    thickness: PositiveFloat


@dataclass(frozen=True)
class AbstractBody(ABC):
    """Layers on a rigid base, divided into equal cells, with a chart of their surface.

    In the chart the surface is a rectangle: x runs to the right, y downwards, both along the surface from the
    upper left corner; z is the depth below it. Positions, pressures and images are in the chart. Only
    three-dimensional mechanics and plots use positions in space (:meth:`place`, :meth:`frame`).

    Attributes:
        size: extent (x, y) along the surface, m.
        cells: number of cells (along x, along y); a pressure on the body is (..., H, W) with H = cells[1]
            and W = cells[0].
        layers: from the base up. A configuration gives each as ``{material, thickness}``, with the material
            as in :meth:`skin.material.Material.of` and the thickness in m.
        variation: standard deviation of Young's modulus between the cells of a layer, relative to the mean
            (independent, log-normal); 0: uniform. Another mesh gives another draw.
        variation_seed: of the moduli.
        flat: whether the body is flat, so that the chart is the body itself.

    Raises:
        InputError: a size or thickness that is not positive, fewer than two cells along a side, no layer, an
            unknown material, a variation below 0, or more cells than fit into memory.
    """

    size: tuple[PositiveFloat, PositiveFloat]
    cells: tuple[Annotated[int, Ge(2)], Annotated[int, Ge(2)]]
    layers: tuple[Layer, ...]
    variation: NonNegativeFloat = 0.0
    variation_seed: NonNegativeInt = 0

    flat: ClassVar[bool]

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", tuple(map(float, self.size)))
        object.__setattr__(self, "cells", tuple(self.cells))
        object.__setattr__(self, "layers", _layers(self.layers))
        require_memory(
            _BYTES_PER_CELL * math.prod(self.cells),
            f"body.cells=[{self.cells[0]},{self.cells[1]}]",
            "give fewer cells, such as body.cells=[32,32]",
        )

    def resized(self, size: tuple[float, float]) -> str:
        """Return the overrides that set the extent (x, y) of the body, m."""
        return f"body.size=[{size[0]:g},{size[1]:g}]"

    @abstractmethod
    def place(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) of the chart, m, are in space, (..., 3), m."""

    @abstractmethod
    def frame(self, points: np.ndarray) -> np.ndarray:
        """Return the local axes at points (..., 3) of the chart, m, as (..., 3, 3).

        The rows are the unit vectors, in space, along the chart's x, along its y, and into the skin.
        """

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
        """Depth below the surface of each layer's upper face, m, from the base up; the last is 0.

        The base is not included, because it is fixed.
        """
        above = [layer.thickness for layer in self.layers[1:]]
        return tuple(math.fsum(above[level:]) for level in range(len(self.layers)))

    @property
    def sensor_depth(self) -> float:
        """Default depth of sensors, m: below the top layer, or on the surface of a single layer."""
        return self.interfaces[-2] if len(self.layers) > 1 else 0.0

    @cached_property
    def moduli(self) -> np.ndarray:
        """Young's modulus of each cell divided by that of its layer, (layers, H, W), from the base up."""
        return factors(self.variation, self.variation_seed, (len(self.layers), *self.shape))

    @property
    def tension(self) -> float:
        """Force along the surface per width and strain, N/m: the layers' E h together, without variation."""
        return sum(layer.material.young * layer.thickness for layer in self.layers)

    def stiffness(self, first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
        """Return the axial stiffness of strips of the body between two points, (n,), N/m.

        It is the sum of E h over the layers, averaged along the line between the points, times w / d.

        Args:
            first: start points of the strips, (n, 3), m.
            second: end points, (n, 3), m, different from the start points.
            width: w of the strips, m.
        """
        per_layer = [layer.material.young * layer.thickness for layer in self.layers]
        per_cell = np.tensordot(per_layer, self.moduli, axes=1)
        tension = along(per_cell, self.cell, first[:, :2], second[:, :2])
        return tension * width / np.linalg.norm(second - first, axis=1)

    def footprint_areas(self, sensors: "Sensors") -> np.ndarray:
        """Return the overlap of each sensor's footprint with each cell, (S, H*W), m^2.

        A footprint beyond the edge of the body is clipped.
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
        Pa; partly covered cells are weighted by area.
        """
        areas = self.footprint_areas(sensors)
        return areas / areas.sum(axis=1, keepdims=True)


def overlaps(edges: np.ndarray, centres: np.ndarray, extent: float) -> np.ndarray:
    """Return the overlap of intervals with the cells between consecutive edges.

    Args:
        edges: (n + 1,), ascending, m.
        centres: (S,), the intervals' centres, m.
        extent: the intervals' length, m.

    Returns:
        (S, n), m.
    """
    low, high = (centres[:, None] + side * extent / 2 for side in (-1, 1))
    return np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0, None)


def _layers(given: Sequence[Layer | Mapping[str, Any]]) -> tuple[Layer, ...]:
    """Return the layers from the base up.

    Raises:
        InputError: no layer, or one that cannot be used.
    """
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise InputError(
            f"body.layers must list at least one layer from the base up, got {given}: "
            "as in body.layers=[{material: EcoFlex 00-30, thickness: 0.005}]"
        )
    return tuple(
        one if isinstance(one, Layer) else configured(_layer, one, f"body.layers.{number}")
        for number, one in enumerate(given)
    )


def _layer(material: Any, thickness: PositiveFloat) -> Layer:
    return Layer(Material.of(material), float(thickness))
