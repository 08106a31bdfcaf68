"""Frames from a serial port or socket, with their tare and their conversion to newtons."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from skin.errors import InputError
from skin.signal.calibration import Calibration, read_calibration
from skin.wire.announcement import AnnouncementListener
from skin.wire.conversion import UnitConversion, check_scale, unit_conversion
from skin.wire.format_detection import Format
from skin.wire.open import PortSettings, open_skin
from skin.wire.skin import Skin
from skin.wire.source import Source
from skin.wire.tare import Tare
from skin.wire.text import Header
from skin.wire.transport import open_stream

_AS_OPENED = ("baudrate", "format", "timeout", "backoff", "silence")


@dataclass(kw_only=True, eq=False)
class SerialSettings:
    """How to read a skin at a port.

    Attributes:
        port, baudrate, format, limits, timeout, backoff, silence: as in :func:`skin.wire.open.open_skin`.
        tare: duration of the tare, s.
        scale: N per unit; negative if values fall with force.
        calibration: calibration file.
    """

    port: str | None = None
    baudrate: int = 115200
    format: Format = "auto"
    tare: float = 2.0
    scale: float | None = None
    calibration: str | None = None
    limits: Sequence[float | None] | None = None
    timeout: float = 10.0
    backoff: Sequence[float] = (1.0, 10.0)
    silence: float | None = 5.0


@dataclass(kw_only=True, eq=False)
class SerialSource(SerialSettings):
    """A skin at a port. torch is not imported.

    Attributes:
        sensors: S.
        rate: of the model, Hz.
        port, baudrate, ...: as in :class:`SerialSettings`.

    Raises:
        InputError: an invalid setting, or a calibration of another number of sensors.
    """

    sensors: int
    rate: float

    def __post_init__(self) -> None:
        if not self.tare >= 0:
            raise InputError(f"device.tare is s without touch and must be 0 or more, got {self.tare}")
        check_scale(self.scale, self._known)
        PortSettings(**self._settings)  # checks them
        if self._known is not None:
            self._known.fits(self.sensors)
            if self._known.values()["dead"].all():
                raise InputError(f"every sensor is broken in device.calibration={self.calibration}")

    @property
    def _settings(self) -> dict[str, Any]:
        limits = None if self.limits is None else tuple(self.limits)
        return {name: getattr(self, name) for name in _AS_OPENED} | {"limits": limits}

    @cached_property
    def _known(self) -> Calibration | None:
        return None if self.calibration is None else read_calibration(self.calibration)

    def open(self, reconnect: bool = False) -> tuple[Skin, AnnouncementListener]:
        """Open the port and collect its announcements; ``reconnect`` waits for an unplugged skin."""
        if self.port is None:
            raise InputError("device=serial needs a port, device.port=/dev/ttyACM0; skin emulate makes one")
        listener = AnnouncementListener(partial(open_stream, self.port, self.baudrate))
        sensors = range(self.sensors)
        skin = open_skin(
            self.port,
            sensors,
            opener=listener,
            reconnect=reconnect,
            channels=self._known.channels if self._known else (),
            polarity=self.polarity,
            **self._settings,
        )
        return skin, listener

    @property
    def polarity(self) -> Sequence[int]:
        """1 or -1 per sensor, -1 where the value falls with force; empty: 1 for all."""
        if self._known is not None:
            return self._known.polarity
        return [-1] * self.sensors if self.scale is not None and self.scale < 0 else ()

    def source(self) -> Source:
        """Open the port as a stream of frames; wait for an unplugged skin."""
        skin, _ = self.open(reconnect=True)
        limits = None if self.limits is None else (self.limits[0], self.limits[1])
        return Source(str(self.port), skin, self.taring(skin), limits)

    def taring(self, skin: Skin) -> Tare:
        """Return the tare of an open skin."""
        return Tare(self.conversion, self.tare, self.rate, lambda: skin.header)

    def conversion(self, baseline: np.ndarray | None, header: Header | None) -> UnitConversion:
        """Return the conversion of values to N, given a baseline (S,) and the header of the device.

        Raises:
            InputError: the scale is unknown.
        """
        return unit_conversion(self.sensors, baseline, self.scale, self._known, header)
