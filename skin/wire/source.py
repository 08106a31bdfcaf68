"""A stream of frames that can be watched, with the tare that says what its values mean."""

from dataclasses import dataclass

from skin.wire.conversion import unit_conversion
from skin.wire.skin import Skin
from skin.wire.tare import Tare


@dataclass(frozen=True)
class Source:
    """Where frames come from.

    Attributes:
        name: of it, for a person.
        skin: open.
        tare: finds out what its values mean.
    """

    name: str
    skin: Skin
    tare: Tare

    @classmethod
    def of_newtons(cls, name: str, skin: Skin, sensors: int) -> "Source":
        """Return one whose values are N already, of so many sensors."""
        # No baseline is taken: a run that learned from such values expects their offsets.
        conversion = unit_conversion(sensors, None, 1.0, None, None)
        return cls(name, skin, Tare(lambda baseline, header: conversion, 0.0, 1.0))
