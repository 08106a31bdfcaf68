"""Check the lengths, cells and layers that a configuration gives of a body."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skin.errors import InputError
from skin.material import Material

__all__ = ["Layer", "cells_of", "layers_of", "positive", "size_of"]


@dataclass(frozen=True)
class Layer:
    """One layer of a body.

    Attributes:
        material: what it is made of.
        thickness: m.
    """

    material: Material
    thickness: float


def positive(value: Any) -> bool:
    """Return whether a value is a finite number above 0."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    )


def size_of(given: Sequence[float]) -> tuple[float, float]:
    """Return the extent (x, y), m, or refuse what is none."""
    if not isinstance(given, Sequence) or len(given) != 2 or not all(map(positive, given)):
        raise InputError(
            f"body.size must be two positive lengths (x, y) in m, got {given}: as in body.size=[0.16,0.16]"
        )
    return float(given[0]), float(given[1])


def cells_of(given: Sequence[int]) -> tuple[int, int]:
    """Return the number of cells (along x, along y), or refuse what is none."""
    whole = isinstance(given, Sequence) and len(given) == 2 and all(type(n) is int and n >= 2 for n in given)
    if not whole:
        raise InputError(
            f"body.cells must be two whole numbers (along x, along y) of at least 2, got {given}: "
            "as in body.cells=[32,32]"
        )
    return given[0], given[1]


def layers_of(given: Sequence[Any]) -> tuple[Layer, ...]:
    """Return the layers from the table up, or refuse what is none."""
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
    if not positive(given["thickness"]):
        raise InputError(
            f"layer {number} from the table: thickness must be a positive length in m, "
            f"got {given['thickness']!r}"
        )
    return Layer(Material.of(given["material"]), float(given["thickness"]))
