"""The layers that a configuration gives of a body."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import PositiveFloat

from skin.errors import InputError
from skin.material import Material
from skin.settings import checked, configured

__all__ = ["Layer", "layers_of"]


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


def layers_of(given: Sequence[Layer | Mapping[str, Any]]) -> tuple[Layer, ...]:
    """Return the layers from the table up.

    Raises:
        InputError: no layer, or one that cannot be used.
    """
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise InputError(
            f"body.layers must list at least one layer from the table up, got {given}: "
            "as in body.layers=[{material: EcoFlex 00-30, thickness: 0.005}]"
        )
    return tuple(
        one if isinstance(one, Layer) else configured(_layer, one, f"body.layers.{number}")
        for number, one in enumerate(given)
    )


def _layer(material: Any, thickness: PositiveFloat) -> Layer:
    return Layer(Material.of(material), float(thickness))
