"""What a device's numbers mean: force above what the untouched skin reads."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skin.errors import InputError
from skin.port.baseline import rest
from skin.port.frame import Frame
from skin.port.text import Header

if TYPE_CHECKING:
    from skin.calibration.values import Calibration

__all__ = ["Newtons", "Unit"]

_HEADER = 3.0  # s in which a device must tell its unit
_OFTEN = 0.2  # s between two attempts at a baseline


@dataclass(frozen=True)
class Unit:
    """How numbers become newtons.

    Attributes:
        scale: N per number that the device sends; None: as its header tells.
        tare: s without touch that give the baseline; 0: there is none.

    Raises:
        InputError: a scale that is not above 0, or a negative time.
    """

    scale: float | None = None
    tare: float = 1.0

    def __post_init__(self) -> None:
        if (self.scale is not None and not self.scale > 0) or self.tare < 0:
            raise InputError(
                f"live.scale must be above 0 and live.tare at least 0, got {self.scale} and {self.tare}"
            )


class Newtons:
    """Turns frames as sent into frames in N above the baseline.

    The baseline is that of the first quiet stretch; until then there are no frames, and ``waiting`` says why.
    It is kept over restarts of the device: nobody knows whether that happened under a touch.

    Args:
        unit: how numbers become newtons.
        header: what the device tells of itself, once it does.
        calibration: of this device; takes the place of the scale, and its broken sensors are masked.
        plain: numbers are N, as those of a recording or of the simulator.

    Attributes:
        waiting: why there are no frames; empty if there are.
    """

    def __init__(
        self,
        unit: Unit,
        header: Callable[[], Header | None],
        calibration: "Calibration | None" = None,
        plain: bool = False,
    ) -> None:
        self._unit, self._header, self._calibration = unit, header, calibration
        self.waiting = "waiting for the first frame"
        self._scale = unit.scale or (1.0 if plain else None)
        self._baseline: np.ndarray | None = None
        self._gain: np.ndarray | float = 1.0
        self._usable: np.ndarray | bool = True
        self._quiet: list[Frame] = []
        self._first: float | None = None
        self._tried = -np.inf
        if calibration is not None:
            values = calibration.values()
            self._scale, self._gain, self._usable = calibration.scale, values["gain"], ~values["dead"]

    def __call__(self, frame: Frame) -> Frame | None:
        """Return a frame in N; None while unit or baseline are not known.

        Raises:
            InputError: the device does not tell what its numbers mean, and nobody else does.
        """
        scale = self._known(frame.t_host)
        if scale is None or (self._baseline is None and not self._tare(frame)):
            return None
        self.waiting = ""
        values = (frame.values - self._baseline) * scale / self._gain
        return frame._replace(values=values, valid=frame.valid & self._usable)

    def _known(self, now: float) -> float | None:
        """Return N per number as the header tells, if nothing else did."""
        if self._scale is not None:
            return self._scale
        header = self._header()
        self._first = now if self._first is None else self._first
        if header is not None and header.unit == "N":
            self._scale = 1.0
        elif header is not None and header.unit:
            raise InputError(
                f"the device sends {header.unit}, not N: give live.scale=N_PER_COUNT (experiments/emulate.py "
                "prints its own) or live.calibration=FILE.yaml"
            )
        elif now - self._first > _HEADER:
            raise InputError(
                "the device does not tell what its numbers mean: give live.scale=N_PER_COUNT (1 if it sends "
                "N) or live.calibration=FILE.yaml"
            )
        self.waiting = "waiting for the device to tell its unit"
        return self._scale

    def _tare(self, frame: Frame) -> bool:
        """Take the baseline from the last quiet frames, if they are long enough and quiet."""
        if not self._unit.tare:
            zero = 0.0 if self._calibration is None else self._calibration.zero
            offset = 0.0 if self._calibration is None else self._calibration.values()["offset"]
            self._baseline = zero + offset / (self._scale or 1.0) + np.zeros(len(frame.values))
            return True
        if self._quiet and self._quiet[-1].segment != frame.segment:
            self._quiet.clear()
        self._quiet.append(frame)
        while frame.t - self._quiet[0].t > 1.5 * self._unit.tare:
            self._quiet.pop(0)
        if frame.t - self._quiet[0].t < self._unit.tare:
            self.waiting = "taking the baseline: do not touch the skin"
        elif frame.t_host - self._tried >= _OFTEN:
            self._tried = frame.t_host
            self._try()
        return self._baseline is not None

    def _try(self) -> None:
        values, valid = (
            np.stack([getattr(one, name) for one in self._quiet]) for name in ("values", "valid")
        )
        try:
            self._baseline = rest(values, valid)
        except InputError as touched:
            self.waiting = f"no baseline yet: {str(touched).split(';')[0]}"
