"""Streams of frames with their tare and their conversion to newtons. torch is not imported."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from skin.device.calibration import read_calibration
from skin.device.resampling import Frame, check_rate
from skin.errors import InputError
from skin.hardware.wire.channels import (
    PATIENCE,
    Limits,
    RawRange,
    SkinTouched,
    Tare,
    UnitConversion,
    check_scale,
    unit_conversion,
)
from skin.hardware.wire.protocol import Header
from skin.hardware.wire.reader import PortSettings, SkinDisconnected, SkinTimeout, open_stream
from skin.hardware.wire.segmentation import AnnouncementListener
from skin.hardware.wire.skin import Skin, open_skin

_LEAST = 1.0  # s over which the rate is measured


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
            saturation = limits if self.limits else (None, largest)
            return RawRange(0.0, largest, header.unit != "N", saturation)
        return RawRange(limits[0], limits[1], False, limits)

    @classmethod
    def in_newtons(cls, name: str, skin: Skin, sensors: int) -> "Source":
        """Return a source whose values are already in N."""
        # No baseline is taken: a run trained on such values expects their offsets.
        conversion = unit_conversion(sensors, None, 1.0, None, None)
        return cls(name, skin, Tare(lambda baseline, header: conversion, 0.0, 1.0))


class SerialSource:
    """A skin at a port, with its conversion to N.

    Args:
        settings: of the port.
        sensors: S.
        rate: of the model, Hz.

    Raises:
        InputError: an invalid setting, or a calibration of another number of sensors.
    """

    def __init__(self, settings: PortSettings, sensors: int, rate: float) -> None:
        self._settings, self._sensors, self._rate = settings, sensors, rate
        path = settings.calibration
        self._calibration = None if path is None else read_calibration(path)
        check_scale(settings.scale, self._calibration)
        if self._calibration is not None:
            self._calibration.fits(sensors)
            if self._calibration.values()["dead"].all():
                raise InputError(f"every sensor is broken in device.calibration={path}")

    @property
    def polarity(self) -> Sequence[int]:
        """1 or -1 per sensor, -1 where the value falls with force; empty: 1 for all."""
        if self._calibration is not None:
            return self._calibration.polarity
        scale = self._settings.scale
        return [-1] * self._sensors if scale is not None and scale < 0 else ()

    def open(self, reconnect: bool = False) -> tuple[Skin, AnnouncementListener]:
        """Open the port and collect its announcements; ``reconnect`` waits for an unplugged skin."""
        port = self._settings.port
        if port is None:
            raise InputError("device=serial needs a port, device.port=/dev/ttyACM0; skin emulate makes one")
        listener = AnnouncementListener(partial(open_stream, port, self._settings.baudrate))
        skin = open_skin(
            self._settings,
            range(self._sensors),
            opener=listener,
            reconnect=reconnect,
            channels=self._calibration.channels if self._calibration else (),
            polarity=self.polarity,
        )
        return skin, listener

    def open_source(self) -> Source:
        """Open the port as a stream of frames; wait for an unplugged skin."""
        skin, _ = self.open(reconnect=True)
        return Source(str(self._settings.port), skin, self.tare(skin), self._settings.limits)

    def tare(self, skin: Skin) -> Tare:
        """Return the tare of an open skin."""
        return Tare(self.convert, self._settings.tare, self._rate, lambda: skin.header)

    def convert(self, baseline: np.ndarray | None, header: Header | None) -> UnitConversion:
        """Return the conversion of values to N, given a baseline (S,) and the header of the device.

        Raises:
            InputError: the scale is unknown.
        """
        return unit_conversion(self._sensors, baseline, self._settings.scale, self._calibration, header)

    def warm_up(self, skin: Skin, notify: Callable[[str], None]) -> tuple[list[Frame], UnitConversion]:
        """Read frames until rate and conversion are known; return all frames read, and the conversion.

        Raises:
            InputError: no frames arrive, the device is too slow, or the scale is unknown.
            SkinTouched: the skin was still touched after a minute.
        """
        try:
            return warm_up(skin, self.tare(skin), self._rate, self._settings.tare, notify)
        except (SkinTimeout, SkinDisconnected) as error:
            raise InputError(f"{self._settings.port}: {error}") from error


def warm_up(
    skin: Skin, tare: Tare, rate: float, seconds: float, notify: Callable[[str], None]
) -> tuple[list[Frame], UnitConversion]:
    """Read frames until rate and conversion are known; return all frames read, and the conversion.

    Args:
        skin: just opened.
        tare: gets every frame.
        rate: of the model, Hz: a slower device is refused.
        seconds: of the tare.
        notify: called with each message for the user.

    Raises:
        InputError: the device is too slow, or the scale is unknown.
        SkinTouched: the skin was still touched after a minute.
    """
    notify("reading the untouched skin: keep off" if seconds else "reading the rate")
    frames, least, measured = list[Frame](), max(seconds, _LEAST), False
    while True:
        frames += skin.read(1)
        if frames[-1].segment != frames[0].segment:
            del frames[:-1]
        tare.add(frames[-1])
        passed = frames[-1].t - frames[0].t
        if len(frames) < 3 or passed < least:
            continue
        if not measured:
            # By the device's clock, with lost frames.
            count = len(frames) - 1 + sum(frame.lost for frame in frames[1:])
            check_rate(count / passed, rate)
        if tare.conversion is not None:
            return frames, tare.conversion
        if not measured and tare.status.startswith("no baseline"):
            notify("the skin is touched: let go")
        measured = True
        if passed > least + PATIENCE:
            raise SkinTouched(tare.status)
