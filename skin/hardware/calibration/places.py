"""Places of presses in the frame of another axis convention: mirrored, turned or exchanged."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from skin.hardware.calibration.bench import Gauge

Turn = Literal[
    "as_given",
    "mirror_x",
    "mirror_y",
    "rotate_180",
    "transpose",
    "rotate_90",
    "rotate_270",
    "transpose_other",
]
TURNS: tuple[Turn, ...] = get_args(Turn)
"""What ``calibrate.places`` takes, the simplest first."""
WORDS: dict[Turn, str] = {
    "as_given": "as given",
    "mirror_x": "mirrored in x (the x axis counts to the left)",
    "mirror_y": "mirrored in y (the y axis counts upwards)",
    "rotate_180": "turned by 180 degrees (both axes count backwards)",
    "transpose": "transposed (x and y are exchanged)",
    "rotate_90": "turned by 90 degrees",
    "rotate_270": "turned by 270 degrees",
    "transpose_other": "mirrored at the other diagonal (x and y are exchanged, and both count backwards)",
}
_MATRICES: dict[Turn, tuple[tuple[int, int], tuple[int, int]]] = {
    "as_given": ((1, 0), (0, 1)),
    "mirror_x": ((-1, 0), (0, 1)),
    "mirror_y": ((1, 0), (0, -1)),
    "rotate_180": ((-1, 0), (0, -1)),
    "transpose": ((0, 1), (1, 0)),
    "rotate_90": ((0, -1), (1, 0)),
    "rotate_270": ((0, 1), (-1, 0)),
    "transpose_other": ((0, -1), (-1, 0)),
}
"""From the direction in the gauge's frame to that on the sheet, x right and y down."""


def turn_gauge(gauge: Gauge, turn: Turn, size: Sequence[float]) -> Gauge:
    """Return a gauge with its places and angles in the frame of the sheet.

    Args:
        gauge: with places in a frame of other axes.
        turn: from this frame to that of the sheet.
        size: of the sheet, x and y, m.
    """
    matrix = np.array(_MATRICES[turn], dtype=float)
    middle = np.array(size) / 2
    centred = gauge.place - np.abs(matrix).T @ middle
    direction = matrix @ np.stack([np.cos(gauge.angle), np.sin(gauge.angle)])
    angle = gauge.angle if turn == "as_given" else np.arctan2(direction[1], direction[0])
    return replace(gauge, place=centred @ matrix.T + middle, angle=angle)


def inside(gauge: Gauge, size: Sequence[float]) -> bool:
    """Return whether all places of a gauge are on a sheet of this size, x and y, m."""
    return bool((gauge.place >= 0).all() and (gauge.place <= np.array(size)).all())


def composed(first: Turn, then: Turn) -> Turn:
    """Return the turn that is the same as one turn after another."""
    product = np.array(_MATRICES[then]) @ np.array(_MATRICES[first])
    return next(turn for turn in TURNS if (np.array(_MATRICES[turn]) == product).all())
