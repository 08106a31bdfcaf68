"""The beginning of a session: is the skin fast enough, and what does it say untouched?"""

from collections.abc import Callable
from math import inf

import numpy as np

from skin.port.baseline import rest
from skin.port.errors import SkinTouched
from skin.port.frame import Frame
from skin.port.live import Skin
from skin.session.reduction import check_rate, rate_of, reduced

__all__ = ["settle"]

_LEAST = 1.0  # s in which the rate shows
_PATIENCE = 60.0  # s for which a touch may delay the baseline


def settle(
    skin: Skin, rate: float, tare: float, tell: Callable[[str], None]
) -> tuple[list[Frame], np.ndarray | None]:
    """Read until the rate has shown and, for the baseline, until nothing has touched the skin for a while.

    Args:
        skin: just opened.
        rate: of the model, Hz: a slower device is refused.
        tare: s without a touch that give the baseline, of values reduced to ``rate``; 0: no baseline.
        tell: says a sentence to the person.

    Returns:
        All frames that came, and the baseline (S,) in the device's unit; None without ``tare``.

    Raises:
        InputError: too slow a device, or too short a tare.
        SkinTouched: the skin was still touched after a minute.
    """
    tell("reading the untouched skin: keep off" if tare else "reading the rate")
    frames, least = list[Frame](), max(tare, _LEAST)
    _listen(skin, frames, least)
    check_rate(rate_of(frames), rate)
    if not tare:
        return frames, None
    intervals, waited = int(tare * rate + 1e-6), 0
    while True:
        begin = frames[-1].t - intervals / rate
        newest = [frame for frame in frames if frame.t >= begin]
        try:
            return frames, rest(*reduced(newest, begin, rate, intervals))
        except SkinTouched:
            if waited > _PATIENCE * rate:
                raise
        if not waited:
            tell("the skin is touched: let go")
        waited += 1
        _listen(skin, frames, least, 1 / rate)


def _listen(skin: Skin, frames: list[Frame], least: float, more: float = 0.0) -> None:
    """Add the frames of ``more`` s, then until all are of one start and ``least`` s long."""
    until = frames[-1].t + more if frames else -inf
    while len(frames) < 3 or frames[-1].t - frames[0].t < least or frames[-1].t < until:
        frames += skin.read(1)
        if frames[-1].segment != frames[0].segment:
            del frames[:-1]
            until = -inf
