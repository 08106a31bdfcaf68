"""One model of a channel, fitted to the presses of a bench: gain, curve, lag, limit and hysteresis.

Under a press p the channel shows min(C(f_p x), limit) above its rest, where x = lag(e_p (F + h B)): F is the
force of the gauge, e_p the simulated true reading per N, h the hysteresis and B its gap, 6 F (1 - F / peak).
The curve C is a line in logarithms: of slope 1 (a gain), of another one (a power law), or of several (a
table). A sensor that is not where the layout says, or an indenter of another size, multiplies all readings of
a press, so every press has a factor f_p, near 1.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pandas as pd
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import OptimizeResult, least_squares

from skin.calibration.bench import BenchData
from skin.calibration.wiring import MAD
from skin.device.calibration import Table
from skin.mechanics.relaxation import first_order_lag

_LAGS = 24  # time constants for which the lagged force is tabulated
_SLOWEST = 1.0  # s, the longest of them: what the tail of a press can show
# Of the peak, a change between frames; frames beside it, which an error of the clocks shifts.
_SUDDEN = 0.1, 2
_REACHED = 0.05  # of the strongest press of a sensor: a weaker one says nothing that can be relied on
# Of a value: error of the simulated shape of a press, added to the noise. Of the factors of the nearest
# presses: what sensors misplaced by 1 mm cause.
_MODEL, _FACTOR = 0.01, 0.05
_FEWEST, _BELOW = 10, 3  # frames that determine anything; frames of a rising force below the limit
_MOST = 40  # evaluations of a solution: a curve that wavers between two knots needs no more
_KNOTS, _STORED = 8, 33  # of a table that is fitted; columns of one that is stored
_GOOD, _BETTER = 0.3, 0.5  # loss per frame of a curve that needs no other; part of it that another may leave
_RISE = 0.005  # of a limit: a response that flattens rises by more in the upper half of its frames
_SURE = 6.0  # standard errors: a slope of noise alone exceeds them in 2 of 1e9 channels


@dataclass(frozen=True)
class Channel:
    """What a channel shows above its rest under force, in the session's unit.

    Attributes:
        slopes: of the logarithm of values over that of true readings, (K,); 1 for a line.
        edges: logarithms of true readings, N, between which the slopes hold, (K + 1,); infinite at both ends.
        middle: logarithms of a true reading, N, and of the value that it has.
        span: logarithms of the least and largest true reading that were seen, N.
        error: standard error of the logarithm of the gain, of the noise alone.
        clip: largest value; NaN: it was not reached.
        time_constant: of a first-order lag, s.
        hysteresis: mean gap between unloading and loading, fraction of the peak; NaN: not observed.
    """

    slopes: np.ndarray = field(default_factory=lambda: np.ones(1))
    edges: np.ndarray = field(default_factory=lambda: np.array([-np.inf, np.inf]))
    middle: tuple[float, float] = (0.0, 0.0)
    span: tuple[float, float] = (0.0, 0.0)
    error: float = np.inf
    clip: float = np.nan
    time_constant: float = 0.0
    hysteresis: float = np.nan

    @property
    def kind(self) -> str:
        """``linear``, ``power`` or ``table``."""
        return "table" if len(self.slopes) > 1 else "linear" if self.slopes[0] == 1 else "power"

    @property
    def known(self) -> bool:
        """Whether the gain is above what noise gives."""
        return self.error < 1 / _SURE

    def value(self, true: np.ndarray) -> np.ndarray:
        """Return logarithms of values over those of true readings (...), N."""
        return self.middle[1] + _rises(true - self.middle[0], self.edges - self.middle[0]) @ self.slopes

    def gain(self, at: float) -> float:
        """Return the gain, per N, of a curve whose linear reading equals its value at ``at``."""
        knots = np.array([*self.edges[1:-1], self.middle[0]])
        knots = np.sort([*knots, knots.min() - 30, knots.max() + 30])  # e^30: beyond any reading
        return at / float(np.exp(np.interp(np.log(at), self.value(knots), knots)))

    def table(self, at: float) -> Table:
        """Return linear readings and values of the curve, which are equal at ``at``."""
        true = np.linspace(*self.span, _STORED - 1)
        return [[0.0, *(self.gain(at) * np.exp(true)).tolist()], [0.0, *np.exp(self.value(true)).tolist()]]


def _rises(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the part of each value, from 0, that lies between edges, (..., K)."""
    low, high = edges[:-1], edges[1:]
    return np.clip(values[..., None], low, high) - np.clip(0.0, low, high)


@dataclass(frozen=True)
class Loads:
    """The force of a session as all channels feel it.

    Attributes:
        bench: the session.
        presses: numbers of the presses to use.
    """

    bench: BenchData
    presses: Collection[int]

    @cached_property
    def owner(self) -> np.ndarray:
        """The press of every frame, (T,), until its lag is over; -1 outside, and where the force jumps."""
        bench, owner = self.bench, self.bench.begun - 1
        force, (fraction, beside) = pd.Series(bench.applied[0]), _SUDDEN
        near = np.convolve(
            force.diff().abs() > fraction * force.groupby(owner).transform("max"),
            np.ones(2 * beside + 1),
            mode="same",
        )
        return np.where(bench.idle | (near > 0) | ~np.isin(owner, list(self.presses)), -1, owner)

    @cached_property
    def lags(self) -> np.ndarray:
        """Time constants, s, (24,); between them and 0 a lag is too short to be seen."""
        step = float(np.median(np.diff(self.bench.session.time)))
        return np.r_[0.0, np.geomspace(step / 2, max(_SLOWEST, 2 * step), _LAGS - 1)]

    @cached_property
    def lagged(self) -> np.ndarray:
        """Force of the gauge and gap of a hysteresis of 1 after each lag, (24, 2, T), N."""
        force, peaks = self.bench.applied[0], self.bench.peaks
        gap = 6 * force * (1 - force / np.where(peaks > 0, peaks, 1.0))
        both = torch.from_numpy(np.stack([force, gap]))[..., None].expand(-1, -1, _LAGS)
        time, lags = torch.from_numpy(self.bench.session.time), torch.from_numpy(self.lags)
        return first_order_lag(both, lags[None], time).permute(2, 0, 1).numpy()


@dataclass(frozen=True)
class _Model:
    """The frames of a channel (N,), and the residuals of a solution.

    A solution is: logarithms of the value in the middle and of the limit, number of the lag, hysteresis,
    logarithms of the factors of P presses, slopes of the curve (none for a line).

    Attributes:
        felt: force and gap over the number of a lag, -> (2, N).
        reach: logarithm of the true reading per N.
        press: number of the press, from 0 to P - 1.
        value: above the rest.
        scale: error of ``value``.
        spread: of the factors, (P,).
        loading: bool: the force is the largest of the press so far.
        noise: standard deviation of ``value`` under load.
    """

    felt: CubicSpline
    reach: np.ndarray
    press: np.ndarray
    value: np.ndarray
    scale: np.ndarray
    spread: np.ndarray
    loading: np.ndarray
    noise: float

    def true(self, solution: np.ndarray) -> np.ndarray:
        """Return logarithms of the true readings with lag, hysteresis and factors, (N,)."""
        force, gap = self.felt(solution[2])
        factors = solution[4 : 4 + len(self.spread)]
        factors = factors - np.average(factors, weights=self.spread**-2)  # else they could replace the gain
        return self.reach + factors[self.press] + np.log(np.maximum(force + solution[3] * gap, 1e-12))

    def curve(self, solution: np.ndarray, edges: np.ndarray) -> np.ndarray:
        """Return values without the limit, (N,); ``edges`` (K + 1,) are against the middle."""
        slopes = solution[4 + len(self.spread) :]
        rise = _rises(self.true(solution), edges) @ (slopes if len(slopes) else np.ones(1))
        return np.exp(np.minimum(solution[0] + rise, 50.0))

    def residuals(self, solution: np.ndarray, edges: np.ndarray, limited: bool) -> np.ndarray:
        """Return residuals of the values and of the factors, (N + P,), 1 where they are as expected."""
        value = np.minimum(self.curve(solution, edges), np.exp(solution[1]) if limited else np.inf)
        factors = solution[4 : 4 + len(self.spread)]
        return np.concatenate([(value - self.value) / self.scale, factors / self.spread])

    def fit(self, start: np.ndarray, edges: np.ndarray) -> OptimizeResult:
        """Return the solution with the least robust loss from a start.

        Values at a limit do not rise. Where they do, the curve flattens, and has no limit.
        """
        high = np.full(len(start), np.inf)
        low, high[1] = -high, np.log(1.05 * self.value.max())  # a limit above all values has no slope
        low[2:4], high[2:4] = 0.0, (_LAGS - 1, 1.0)
        low[4 + len(self.spread) :] = 0.01  # a curve rises
        for limited in (True, False):
            result = least_squares(
                self.residuals,
                np.clip(start, low, high),
                bounds=(low, high),
                loss="soft_l1",
                args=(edges, limited),
                x_scale="jac",
                max_nfev=_MOST,
            )
            if not limited:
                result.x[1] = np.inf
            shown, limit = self.curve(result.x, edges), float(np.exp(result.x[1]))
            above = self.loading & (shown > 1.02 * limit + 2 * self.noise)
            if above.sum() < _FEWEST or self._is_flat(self.value[above], shown[above], limit):
                break
        return result

    def _is_flat(self, value: np.ndarray, shown: np.ndarray, limit: float) -> bool:
        """Return whether values do not rise although they would without the limit, ``shown``."""
        upper = shown > np.median(shown)
        margin = max(_RISE * limit, 5 * self.noise / np.sqrt(max(min(upper.sum(), (~upper).sum()), 1)))
        return not upper.any() or bool(np.median(value[upper]) - np.median(value[~upper]) < margin)

    def seen(self, solution: np.ndarray) -> np.ndarray:
        """Return logarithms of the true readings whose value is above the noise and below the limit, (M,)."""
        above, limit = self.value > 5 * self.noise, np.exp(solution[1])
        return self.true(solution)[self.loading & above & (self.value < 0.97 * limit)]

    def loss(self, result: OptimizeResult) -> float:
        """Return the mean robust loss of frames while the force rises, about 0.8 where all is as expected."""
        squares = result.fun[: len(self.value)][self.loading] ** 2
        return float(np.mean(2 * (np.sqrt(1 + squares) - 1)))


def fit_channel(loads: Loads, each: np.ndarray, change: np.ndarray, noise: float) -> Channel | None:
    """Fit the model of a channel; None if no press of its sensor has enough frames that leave the noise.

    A curve is the simplest one that leaves little, or no less than half of what a better one leaves.

    Args:
        loads: the session and the presses to use.
        each: true readings of the sensor per N of every press, (P,).
        change: values above the rest, (T,), rising with force, in the session's unit.
        noise: standard deviation of a frame at rest.
    """
    prepared = _prepare(loads, each, change, noise)
    if prepared is None:
        return None
    model, start, middle = prepared
    count, edges = len(start), np.array([-np.inf, np.inf])
    best = model.fit(start, edges)
    if model.loss(best) > _GOOD:
        power = model.fit(np.append(best.x, 1.0), edges)
        best = power if model.loss(power) < _BETTER * model.loss(best) else best
        if model.loss(best) > _GOOD:
            seen = model.seen(best.x)
            knots = np.linspace(seen.min(initial=0.0), seen.max(initial=0.0), _KNOTS)
            knots[[0, -1]] = -np.inf, np.inf
            table = model.fit(np.r_[power.x[:count], np.full(len(knots) - 1, power.x[count])], knots)
            if model.loss(table) < _BETTER * model.loss(best):
                best, edges = table, knots
    return _describe(loads, model, best, edges, middle)


def _prepare(
    loads: Loads, each: np.ndarray, change: np.ndarray, noise: float
) -> tuple[_Model, np.ndarray, float] | None:
    """Return the frames of a channel, a first solution, the logarithm of its middle."""
    used = np.unique(loads.owner[loads.owner >= 0])
    if not len(used) or each[used].max() <= 0:
        return None
    used = used[each[used] >= _REACHED * each[used].max()]
    rows = np.isin(loads.owner, used) & np.isfinite(change)
    press, value = np.searchsorted(used, loads.owner[rows]), change[rows]
    loading, force = loads.bench.loading[rows], loads.bench.applied[0][rows]
    true = each[used][press] * force
    if loading.sum() < _FEWEST:
        return None
    # A response that flattens amplifies noise at rest, which then says nothing of that under load.
    noise = min(noise, MAD / np.sqrt(2) * float(np.median(np.abs(np.diff(value[loading])))))
    level = float(np.median(value[loading & (true >= 0.9 * true.max())]))
    seen = loading & (value > 5 * noise)
    low = seen & (value < 0.8 * level)
    seen = low if low.sum() >= _FEWEST else seen
    if seen.sum() < _FEWEST:
        return None
    middle, ratio = (float(np.median(np.log(part))) for part in (true[seen], value[seen] / true[seen]))
    felt = CubicSpline(np.arange(_LAGS), loads.lagged[..., rows])
    scale, spread = np.hypot(noise, _MODEL * value), _FACTOR * each[used].max() / each[used]
    model = _Model(felt, np.log(each[used][press]) - middle, press, value, scale, spread, loading, noise)
    # The limit begins below the largest values, where frames move it either way.
    start = np.r_[ratio + middle, np.log(0.95 * value.max()), 1.0, 0.01, np.zeros(len(used))]
    return model, start, middle


def _describe(
    loads: Loads,
    model: _Model,
    best: OptimizeResult,
    edges: np.ndarray,
    middle: float,
) -> Channel:
    """Return what a solution means, and how well it is determined."""
    count, limit, solution = len(model.spread), float(np.exp(best.x[1])), best.x
    shown = model.curve(solution, edges)
    own = np.delete(best.jac[: len(model.value)], np.arange(4, 4 + count), axis=1)
    errors = np.sqrt(np.abs(np.diag(np.linalg.pinv(own.T @ own))))
    force, gap = model.felt(solution[2])
    falling = ~model.loading & (shown < 0.9 * limit) & (gap > 0.05 * force.max())
    bend = solution[3] if solution[3] > 2 * errors[3] else 0.0
    seen = model.seen(solution)
    return Channel(
        solution[4 + count :] if len(solution) > 4 + count else np.ones(1),
        edges + middle,
        (middle, float(solution[0])),
        (float(seen.min(initial=0.0)) + middle, float(seen.max(initial=0.0)) + middle),
        float(errors[0]) if (shown < 0.95 * limit)[model.loading].sum() >= _BELOW else np.inf,
        limit if (shown > 1.02 * limit + 2 * model.noise)[model.loading].sum() >= _FEWEST else np.nan,
        float(np.interp(solution[2], np.arange(_LAGS), loads.lags)) * (solution[2] >= 1),
        float(bend) if falling.sum() >= _FEWEST else np.nan,
    )
