"""Find steady loads in a session without a gauge: a weight put down and lifted again."""

from dataclasses import dataclass

import numpy as np

from skin.calibration.bench import BenchSession
from skin.calibration.wiring import MAD, find_medians, find_quantum

_BLOCK = 0.2  # s, whose median is one value
_REST = 5  # blocks without a load before the first one
_LOADED = 6.0  # standard deviations of a block: no noise of 100 channels and ten minutes reaches it
_STEPS = 2.0  # steps of the converter, likewise
_LIFTED = 0.15  # of the largest change of a load: below, it is lifted, and the skin recovers
_SETTLE = 2  # blocks after a load is lifted that are not used
_AFTER = 4  # blocks after it for the rest; fewer before the next load
_SHORTEST = 1.0  # s of a load: less is a touch
_STEADY = 0.4, 0.9  # part of a load that is used: a hand no longer guides it, and has not come back
_UNSTEADY = 0.2  # of the largest change: a load that changes more was touched or slid


@dataclass(frozen=True)
class Placements:
    """Steady loads of a session.

    Attributes:
        change: (P, S), against the rest before and after the load, in the session's unit.
        begin, end: (P,), s.
        idle: (T,), bool: frames without a load.
        noise: (S,), standard deviation of ``change``.
        unsteady: number of loads that were left out because they changed.
        reached: (S,), bool: the channel leaves its noise in at least one load.
    """

    change: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    idle: np.ndarray
    noise: np.ndarray
    unsteady: int
    reached: np.ndarray


def find_placements(session: BenchSession) -> Placements:
    """Return the loads of a session, in order of time.

    A load begins where a channel leaves its noise, and ends where all have lost most of their change. The
    first second must be without a load. There may be no load, or one that still lies at the end.
    """
    time, raw = session.time, session.raw
    block = np.floor((time - time[0]) / _BLOCK).astype(int)
    _, first = np.unique(block, return_index=True)
    parts = np.split(np.arange(len(time)), first[1:])
    values = _fill(np.array([find_medians(raw[part]) for part in parts]))
    steps = np.array([find_quantum(column[np.isfinite(column)]) for column in raw.T])
    noise = MAD / np.sqrt(2) * np.median(np.abs(np.diff(values, axis=0)), axis=0)
    noise = np.maximum(noise, steps / np.sqrt(12))
    spans, rests = _find_loads(values, np.maximum(_LOADED * noise, _STEPS * steps))
    starts = time[first]
    idle = np.ones(len(time), dtype=bool)
    rows, times, unsteady = [], [], 0
    for (begin, end), (before, after) in zip(spans, rests, strict=True):
        margin = slice(first[max(begin - 1, 0)], first[end + _SETTLE] if end + _SETTLE < len(first) else None)
        idle[margin] = False
        if starts[end - 1] - starts[begin] < _SHORTEST:
            continue
        low, high = (begin + round(fraction * (end - begin)) for fraction in _STEADY)
        steady = values[low : max(high, low + 3)] - (before + after) / 2
        change = np.median(steady, axis=0)
        if (np.ptp(steady, axis=0) > _UNSTEADY * np.abs(change).max() + _LOADED * noise).any():
            unsteady += 1
            continue
        rows.append(change)
        times.append((starts[begin], starts[end - 1]))
    moments = np.array(times).reshape(-1, 2)
    change = np.array(rows).reshape(-1, len(noise))
    few = noise * np.sqrt(1 / 5 + 1 / (2 * _AFTER))
    reached = (np.abs(change) > np.maximum(_LOADED * few, _STEPS * steps)).any(axis=0)
    return Placements(change, moments[:, 0], moments[:, 1], idle, few, unsteady, reached)


def _fill(values: np.ndarray) -> np.ndarray:
    """Return values with those before them where they are missing; 0 for a channel without any."""
    filled = values.copy()
    for channel in filled.T:
        present = np.isfinite(channel)
        if present.any():
            channel[~present] = np.interp(np.flatnonzero(~present), np.flatnonzero(present), channel[present])
        else:
            channel[:] = 0.0
    return filled


def _find_loads(
    values: np.ndarray, limits: np.ndarray
) -> tuple[list[tuple[int, int]], list[tuple[np.ndarray, np.ndarray]]]:
    """Return first and last block of every load, and the rests (S,) before and after it."""
    spans, rests = list[tuple[int, int]](), list[tuple[np.ndarray, np.ndarray]]()
    count = len(values)
    number = min(_REST, count)
    rest = np.median(values[:number], axis=0)
    while number < count:
        if not (np.abs(values[number] - rest) > limits).any():
            rest = rest + 0.2 * (values[number] - rest)
            number += 1
            continue
        begin, peak = number, np.zeros(len(limits))
        while number < count:
            change = np.abs(values[number] - rest)
            peak = np.maximum(peak, change)
            if not (change > np.maximum(limits, _LIFTED * peak.max())).any():
                break
            number += 1
        after = rest
        if number < count:
            quiet = values[number + _SETTLE : number + _SETTLE + _AFTER]
            calm = quiet[(np.abs(quiet - rest) <= np.maximum(limits, _LIFTED * peak.max())).all(axis=1)]
            after = np.median(calm, axis=0) if len(calm) else rest
        spans.append((begin, number))
        rests.append((rest, after))
        rest, number = after, number + _SETTLE
    return spans, rests
