"""A stream of frames for the live view, with its tare."""

from dataclasses import dataclass

from skin.wire.conversion import unit_conversion
from skin.wire.health import Limits, RawRange
from skin.wire.skin import Skin
from skin.wire.tare import Tare


@dataclass(frozen=True)
class Source:
    """An open stream of frames and its tare.

    Attributes:
        name: shown in the live view.
        skin: open.
        tare: gives the conversion of values to N.
        limits: smallest and largest value of a channel, as given by the user.
    """

    name: str
    skin: Skin
    tare: Tare
    limits: Limits | None = None

    @property
    def raw_range(self) -> RawRange:
        """The values that the device can send, as far as it declares them."""
        header, limits = self.skin.header, self.limits or (None, None)
        if header is not None and header.bits:
            largest = 2.0**header.bits - 1
            known = limits if self.limits else (None, largest)
            return RawRange(0.0, largest, header.unit != "N", known)
        return RawRange(limits[0], limits[1], False, limits)

    @classmethod
    def of_newtons(cls, name: str, skin: Skin, sensors: int) -> "Source":
        """Return a source whose values are already in N."""
        # No baseline is taken: a run trained on such values expects their offsets.
        conversion = unit_conversion(sensors, None, 1.0, None, None)
        return cls(name, skin, Tare(lambda baseline, header: conversion, 0.0, 1.0))
