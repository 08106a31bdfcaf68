"""Find the response of every channel: a line, a power law, or a table, chosen by held-out presses.

Only the shape within a press counts. A sensor that is not where the layout says, or an indenter of another
size, multiplies all readings of a press, so every press has a free factor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear

from skin.device.calibration import Curves, Table

_STEP = 0.06  # of the logarithm of the force: points of a press
_LOWEST = 0.02  # of the largest true reading
_PLATEAU = 0.03  # of the largest value: values that high may be at the limit
_WIDE = 0.85  # of the largest true reading, from which on values do not rise: a limit
_FEWEST = 4  # points of a press
_KNOTS = 8  # of a table
_STORED = 33  # columns of a table
_LINE = 0.05  # an exponent this near to 1 is a line
_BETTER = 0.5, 0.005  # of the error of a simpler shape, and less than it, that a shape may leave
_MAD = 1.4826


@dataclass(frozen=True)
class Points:
    """Values of a channel over true readings while the force rises, below the limit of the channel.

    Attributes:
        true: logarithm of the true reading, (n,).
        value: logarithm of the change against the rest, (n,), in the session's unit.
        press: number of the press, (n,).
    """

    true: np.ndarray
    value: np.ndarray
    press: np.ndarray

    def of(self, rows: np.ndarray) -> "Points":
        """Return some of them."""
        return Points(self.true[rows], self.value[rows], self.press[rows])


@dataclass(frozen=True)
class Shape:
    """The shape of a channel's response.

    Attributes:
        kind: ``linear``, ``power`` or ``table``.
        exponent: of the power law.
        knots: of the table: logarithms of values, and of true readings up to a constant; (2, K).
        errors: mean relative error of the force of held-out presses, by kind.
        middle: value in the middle of the points, in the session's unit; 0 without points.
    """

    kind: Literal["linear", "power", "table"] = "linear"
    exponent: float = 1.0
    knots: np.ndarray | None = None
    errors: tuple[float, ...] = ()
    middle: float = 0.0

    def table(self, at: float) -> Table:
        """Return the table in the session's unit, in which reading and value are equal at ``at``."""
        assert self.knots is not None
        low, high = self.knots[0][[0, -1]]
        value = np.linspace(low, high, _STORED - 1)
        reading = np.exp(_interpolate(value, *self.knots) - _interpolate(np.array(np.log(at)), *self.knots))
        return [[0.0, *(at * reading).tolist()], [0.0, *np.exp(value).tolist()]]


def fit_shape(true: np.ndarray, measured: np.ndarray, press: np.ndarray, noise: float, step: float) -> Shape:
    """Return the simplest shape that predicts the force of held-out presses about as well as the best.

    Args:
        true: (n,), N, with all lags, in frames at the largest force of their press so far.
        measured: (n,), change against the rest, above 0 under force, in the session's unit.
        press: (n,), number of the press.
        noise: standard deviation of a frame at rest.
        step: of the converter; 0: continuous.
    """
    points = collect_points(true, measured, press, noise, step)
    if len(points.true) < 2 * _FEWEST:
        return Shape()
    folds = _folds(points)
    middle = float(np.exp(np.median(points.value)))
    line = np.array([[0.0, 1.0], [0.0, 1.0]])
    exponent = _fit_exponent(points)
    errors = [_error(points, folds, lambda _: line), _error(points, folds, _fit_power)]
    shape = Shape(errors=(*errors,), middle=middle)
    if abs(exponent - 1) > _LINE and _clearly_better(errors[1], errors[0]):
        shape = Shape("power", exponent, None, (*errors,), middle)
    errors.append(_error(points, folds, _fit_table))
    if _clearly_better(errors[2], errors[0 if shape.kind == "linear" else 1]):
        return Shape("table", 1.0, _fit_table(points), (*errors,), middle)
    return shape


def _clearly_better(error: float, simpler: float) -> bool:
    factor, minimum = _BETTER
    return error < factor * simpler and error < simpler - minimum


def collect_points(
    true: np.ndarray, measured: np.ndarray, press: np.ndarray, noise: float, step: float
) -> Points:
    """Return medians of values over small steps of the true reading; arguments as of :func:`fit_shape`."""
    top = measured[true >= 0.9 * true.max(initial=0)]
    level = float(np.median(top)) if len(top) else 0.0
    # A response that flattens amplifies noise at rest, which then says nothing of that under load.
    moving = np.abs(np.diff(measured))
    loaded = min(noise, _MAD / np.sqrt(2) * float(np.median(moving))) if len(moving) else noise
    limit = _find_limit(true, measured, level, loaded)
    usable = (
        (true > _LOWEST * true.max(initial=0)) & (measured > max(5 * loaded, 3 * step)) & (measured < limit)
    )
    bins = np.full(len(true), -1)
    bins[usable] = np.floor(np.log(true[usable]) / _STEP).astype(int)
    bins[usable] -= bins[usable].min(initial=0)
    rows = []
    for number in np.unique(press[usable]):
        mine = usable & (press == number)
        for position in np.unique(bins[mine]):
            group = mine & (bins == position)
            rows.append((np.median(np.log(true[group])), np.log(np.median(measured[group])), number))
    values = np.array(rows).reshape(-1, 3)
    enough = [np.sum(values[:, 2] == number) >= _FEWEST for number in values[:, 2]]
    values = values[np.array(enough, dtype=bool)]
    return Points(values[:, 0], values[:, 1], values[:, 2].astype(int))


def _find_limit(true: np.ndarray, measured: np.ndarray, level: float, noise: float) -> float:
    """Return the value from which a channel is at its limit; infinite if it still rises at the end."""
    high = measured > level - max(3 * noise, _PLATEAU * level)
    if not high.any():
        return np.inf
    start, maximum = np.quantile(true[high], 0.05), true.max()
    if start > _WIDE * maximum:
        return np.inf
    inside = high & (true > start)
    half = true[inside] > np.median(true[inside])
    if not half.any() or half.all():
        return level - max(3 * noise, _PLATEAU * level)
    lower, upper = (measured[inside][side] for side in (~half, half))
    rise = float(np.median(upper) - np.median(lower))
    # A plateau rises by no more than noise; a response that flattens still does.
    if rise > max(2 * noise / np.sqrt(min(len(lower), len(upper))), 0.005 * level):
        return np.inf
    return level - max(3 * noise, _PLATEAU * level)


def _folds(points: Points) -> list[np.ndarray]:
    """Return rows of the held-out points, bool each: those of a press, or of one press every other one."""
    numbers = np.unique(points.press)
    if len(numbers) > 1:
        return [points.press == number for number in numbers]
    return [np.arange(len(points.press)) % 2 == side for side in (0, 1)]


def _error(points: Points, folds: Sequence[np.ndarray], fit) -> float:  # type: ignore[no-untyped-def]
    """Return the mean relative error of the force of held-out points, up to a factor of each press."""
    errors = []
    for held in folds:
        off = points.true[held] - _interpolate(points.value[held], *fit(points.of(~held)))
        errors.append(np.abs(np.expm1(off - np.median(off))).mean())
    return float(np.mean(errors))


def _fit_exponent(points: Points) -> float:
    """Return the slope of values over true readings in logarithms, with a constant of each press."""
    true, value = (_centre(column, points.press) for column in (points.true, points.value))
    return float((true * value).sum() / (true**2).sum())


def _centre(values: np.ndarray, press: np.ndarray) -> np.ndarray:
    centred = values.copy()
    for number in np.unique(press):
        centred[press == number] -= values[press == number].mean()
    return centred


def _fit_power(points: Points) -> np.ndarray:
    return np.array([[0.0, max(_fit_exponent(points), 0.01)], [0.0, 1.0]])


def _fit_table(points: Points) -> np.ndarray:
    """Return knots of a rising line through the points in logarithms, with a constant of each press."""
    count = int(np.clip(len(points.value) // 3, 2, _KNOTS))
    knots = np.unique(np.quantile(points.value, np.linspace(0, 1, count)))
    if len(knots) < 2:
        return _fit_power(points)
    # Coefficients are the rises between knots, which are not negative.
    rises = np.clip((points.value[:, None] - knots[:-1]) / np.diff(knots), 0, 1)
    presses = points.press[:, None] == np.unique(points.press)
    lower = np.r_[np.full(rises.shape[1], 1e-6), np.full(presses.shape[1], -np.inf)]
    solution = lsq_linear(np.hstack([rises, presses]), points.true, (lower, np.inf))
    return np.stack([knots, np.r_[0.0, np.cumsum(solution.x[: rises.shape[1]])]])


def _interpolate(values: np.ndarray, given: np.ndarray, result: np.ndarray) -> np.ndarray:
    """Return values of a line through knots, continued with its first and last slopes."""
    slopes = np.diff(result)[[0, -1]] / np.diff(given)[[0, -1]]
    outside = np.minimum(values - given[0], 0) * slopes[0] + np.maximum(values - given[-1], 0) * slopes[1]
    return np.asarray(np.interp(values, given, result) + outside)


def curves_of(shapes: Sequence[Shape]) -> Curves | None:
    """Return the curves of all channels, in the session's unit; None: all are linear."""
    bent = [shape for shape in shapes if shape.kind != "linear"]
    if not bent:
        return None
    at = float(np.median([shape.middle for shape in bent]))
    tables = {n: shape.table(at) for n, shape in enumerate(shapes) if shape.kind == "table"}
    return Curves(np.array([shape.exponent for shape in shapes]), np.full(len(shapes), at), tables)


def describe_shapes(shapes: Sequence[Shape]) -> list[str]:
    """Return a line for each group of channels with the same response that is no line."""
    groups: dict[str, list[int]] = {}
    for number, shape in enumerate(shapes):
        if shape.kind == "power":
            groups.setdefault(f"force^{shape.exponent:.2f}", []).append(number)
        elif shape.kind == "table":
            assert shape.knots is not None
            slopes = np.diff(shape.knots[0])[[0, -1]] / np.diff(shape.knots[1])[[0, -1]]
            groups.setdefault(
                f"a table, from force^{slopes[0]:.1f} at small to force^{slopes[1]:.1f} at large forces", []
            ).append(number)
    lines = []
    for words, numbers in groups.items():
        errors = np.array([shapes[n].errors[: 3 if "table" in words else 2] for n in numbers]).mean(axis=0)
        noun = f"channel {numbers[0]} follows" if len(numbers) == 1 else (
            f"channels {', '.join(map(str, numbers))} follow"
        )  # fmt: skip
        lines.append(
            f"{noun} {words}: on held-out presses the shape is off by {errors[-1]:.1%}, "
            f"a line by {errors[0]:.0%}"
        )
    return lines
