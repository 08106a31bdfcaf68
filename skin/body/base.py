"""Bodies: layers of silicone on a rigid support, a chart of their surface, and sensors in them."""

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import psutil
from annotated_types import Ge
from pydantic import PositiveFloat

from skin.body.material import Material
from skin.core.settings import checked, configured
from skin.errors import InputError

MOST = 10_000
"""Sensors that a file may have: a thousand times those of a usual skin."""

REACHES = (0.0, 0.01, 0.02, 0.04)
"""Distances from a sensor at which its response to a fingertip is known, m."""

GEOMETRY = (
    *("x", "y", "depth", "normal_x", "normal_y", "normal_z", "footprint_x", "footprint_y"),
    *("width", "height", "thickness", "share"),
    *(f"response_{1e3 * reach:g}mm" for reach in REACHES),
)
"""Geometry of a sensor and its skin: m, unit vectors; extent and thickness of the body, m; reading under
uniform pressure as a fraction of the force on the footprint; readings under a fingertip of 1 N at the
distances :data:`REACHES`, N."""


@dataclass(frozen=True)
class Sensors:
    """Sensors placed in a body.

    Attributes:
        positions: (S, 3), m: x to the right and y downwards from the body's upper left corner, z the depth
            below the surface. The order of the sensors is the order of the readings everywhere.
        footprint: extent (x, y) of the sensitive area of one sensor, m.
        normals: (S, 3), unit vectors n, in the local frame (x, y, into the skin), across the footprint of
            each sensor. One (3,) holds for all; by default they face the surface.
        directions: (S, 3), unit vectors d in the same frame: a sensor reads d . sigma . n, the force along d
            that what is above its footprint exerts on it; None: d is n. A site of three axes is three
            sensors, one after the other: two along its plane, and one inwards.
    """

    positions: np.ndarray
    footprint: tuple[float, float]
    normals: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    directions: np.ndarray | None = None

    def __post_init__(self) -> None:
        normals = np.broadcast_to(np.asarray(self.normals, dtype=float), self.positions.shape)
        object.__setattr__(self, "normals", normals.copy())

    @property
    def axes(self) -> int:
        """Sensors of a site: 3 if they measure along its plane too, else 1."""
        return 1 if self.directions is None else 3

    @property
    def measured(self) -> np.ndarray:
        """Directions of the forces that the sensors read, (S, 3), unit vectors."""
        return self.normals if self.directions is None else self.directions

    @property
    def tilted(self) -> np.ndarray:
        """Which sensors do not face the surface, (S,), bool; up or down reads the same."""
        return (self.normals[:, :2] != 0).any(axis=1)

    def __len__(self) -> int:
        return len(self.positions)


def plane_axes(normals: np.ndarray) -> np.ndarray:
    """Return the chart's x and y turned the shortest way into planes across normals (S, 3), (S, 2, 3)."""
    x, y, z = (normals * np.where(normals[:, 2:] < 0, -1, 1)).T
    along_x = np.stack([1 - x * x / (1 + z), -x * y / (1 + z), -x], axis=-1)
    along_y = np.stack([-x * y / (1 + z), 1 - y * y / (1 + z), -y], axis=-1)
    return np.stack([along_x, along_y], axis=1) + 0.0  # -0.0 would give other keys of stored operators


# Check that arrays fit into memory before they are allocated.


def require_memory(needed: float, what: str, advice: str) -> None:
    """Raise InputError unless ``needed`` bytes of memory are available.

    Args:
        needed: estimate, bytes.
        what: subject of the error message.
        advice: end of the error message: what to set instead.

    Raises:
        InputError: the estimate exceeds the available memory.
    """
    available = psutil.virtual_memory().available
    if needed > available:
        raise InputError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory, {available / 1e9:.3g} GB are free: {advice}"
        )


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
            as in :meth:`skin.body.material.Material.of` and the thickness in m.
        flat: whether the body is flat, so that the chart is the body itself.

    Raises:
        InputError: a size or thickness that is not positive, fewer than two cells along a side, no layer, an
            unknown material, or more cells than fit into memory.
    """

    size: tuple[PositiveFloat, PositiveFloat]
    cells: tuple[Annotated[int, Ge(2)], Annotated[int, Ge(2)]]
    layers: tuple[Layer, ...]

    flat: ClassVar[bool]

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", tuple(map(float, self.size)))
        object.__setattr__(self, "cells", tuple(self.cells))
        object.__setattr__(self, "layers", _layers(self.layers))
        # Any simulator holds at least 25 sensors' float64 weights and a gesture of 30 float32 frames.
        require_memory(
            (25 * 8 + 30 * 4) * math.prod(self.cells),
            f"body.cells=[{self.cells[0]},{self.cells[1]}]",
            "give fewer cells, such as body.cells=[32,32]",
        )

    def resized(self, size: tuple[float, float]) -> str:
        """Return the overrides that set the extent (x, y) of the body, m."""
        return f"body.size=[{size[0]:g},{size[1]:g}]"

    @abstractmethod
    def locate(self, points: np.ndarray) -> np.ndarray:
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


def _layers(entries: Sequence[Layer | Mapping[str, Any]]) -> tuple[Layer, ...]:
    """Return the layers from the base up.

    Raises:
        InputError: no layer, or one that cannot be used.
    """
    if not isinstance(entries, Sequence) or isinstance(entries, str) or not entries:
        raise InputError(
            f"body.layers must list at least one layer from the base up, got {entries}: "
            "as in body.layers=[{material: EcoFlex 00-30, thickness: 0.005}]"
        )
    return tuple(
        entry if isinstance(entry, Layer) else configured(_layer, entry, f"body.layers.{number}")
        for number, entry in enumerate(entries)
    )


def _layer(material: Any, thickness: PositiveFloat) -> Layer:
    return Layer(Material.of(material), float(thickness))


# Plausible ranges of a configuration, where 12 in place of 0.012 m is a mistake. The classes take any value
# that has a meaning, however large a sheet or stiff a layer a proof needs.


class _Range(NamedTuple):
    low: float
    high: float
    unit: str


_LENGTH = _Range(0.005, 3, "m")
_PRESSURE = _Range(100, 1e8, "Pa")
# As configurations are nested; a list is each of its entries.
_RANGES: Mapping[str, Any] = {
    "body": {
        "size": _LENGTH,
        "length": _LENGTH,
        "radius": _LENGTH,
        "layers": {
            "thickness": _Range(1e-5, 0.2, "m"),
            "material": {"young": _Range(1e3, 1e12, "Pa"), "relaxation": {"time": _Range(1e-3, 1e5, "s")}},
        },
    },
    "layout": {"footprint": _Range(1e-4, 0.5, "m")},
    "contact": {"relief": _Range(0, 0.1, "m"), "fillet": _Range(0, 0.1, "m")},
    "device": {"position_error": _Range(0, 0.1, "m")},
    "touch": {
        "rate": _Range(0.1, 1e4, "Hz"),
        "window": _Range(0, 20, "s"),
        "tap": _Range(0, 15, "s"),
        "press": _Range(0, 15, "s"),
        "safe_peak": _PRESSURE,
        "dangerous_peak": _PRESSURE,
        "speed": _Range(0, 10, "m/s"),
        "path": _Range(0, 1, "m"),
        "spare": _Range(0, 1, "m"),
        "thresholds": {"pressure": _PRESSURE, "travel": _Range(1e-6, 0.5, "m")},
    },
}


def check_plausibility(groups: Mapping[str, Any]) -> None:
    """Refuse a configuration with a value that no skin has in the unit that is asked for.

    Args:
        groups: the configuration, in plain containers. Values of other types are left to the classes.

    Raises:
        InputError: a value is out of its range.
    """
    for name, ranges in _RANGES.items():
        _check_ranges(name, groups.get(name), ranges)


def _check_ranges(name: str, group: Any, ranges: Mapping[str, Any]) -> None:
    if isinstance(group, list):
        for number, entry in enumerate(group):
            _check_ranges(f"{name}.{number}", entry, ranges)
    if not isinstance(group, Mapping):
        return
    for key, within in ranges.items():
        setting = group.get(key)
        if isinstance(within, Mapping):
            _check_ranges(f"{name}.{key}", setting, within)
            continue
        low, high, unit = within
        for value in setting if isinstance(setting, list) else [setting]:
            # The classes refuse other values with a sentence of their own.
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if 0 < value < math.inf and not low <= value <= high:
                raise InputError(
                    f"{name}.{key}={value:g} {unit} is not plausible: it is given in {unit}, from {low:g} to "
                    f"{high:g} {unit}; was another unit meant?"
                )


def warn_of_surface(body: AbstractBody, sensors: Sensors) -> None:
    """Warn where sensors lie on the surface: there they read the pressure itself, whatever is below."""
    count = int((sensors.positions[:, 2] <= 1e-3 * body.thickness).sum())
    if count:
        warnings.warn(
            f"{count} of {len(sensors)} sensors lie on the surface, where they read the pressure itself: the "
            "layers' thickness and stiffness change nothing; put them at a depth, as in "
            f"layout.depth={body.thickness / 3:.2g} simulator=solid, or with a column depth_m in layout.path",
            UserWarning,
            stacklevel=3,
        )


def __getattr__(name: str) -> Any:
    """Return ``Sheet`` or ``Arm``, which configurations of stored runs name by this module."""
    if name in ("Arm", "Sheet"):
        return getattr(import_module(f"skin.body.{name.lower()}"), name)
    raise AttributeError(name)
