"""A stream of frames for the live view, with its tare."""

from dataclasses import dataclass

from skin.wire.conversion import unit_conversion
from skin.wire.skin import Skin
from skin.wire.tare import Tare


@dataclass(frozen=True)
class Source:
    """An open stream of frames and its tare.

    Attributes:
        name: shown in the live view.
        skin: open.
        tare: gives the conversion of values to N.
    """

    name: str
    skin: Skin
    tare: Tare

    @classmethod
    def of_newtons(cls, name: str, skin: Skin, sensors: int) -> "Source":
        """Return a source whose values are already in N."""
        # No baseline is taken: a run trained on such values expects their offsets.
        conversion = unit_conversion(sensors, None, 1.0, None, None)
        return cls(name, skin, Tare(lambda baseline, header: conversion, 0.0, 1.0))
