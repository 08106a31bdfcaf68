"""Find in a bench session whether its force gauge drifts."""

import numpy as np
import pandas as pd
from scipy.stats import theilslopes

from skin.errors import InputError
from skin.hardware.bench import BenchData
from skin.hardware.wiring import collect_responses

_BELOW = 0.8  # of the channel's largest response: above, it may be at its limit
_REACHED = 0.5  # of the sensor's strongest press: weaker ones depend on where it lies
_FEWEST = 2  # steps below the limit that determine a line: what the protocol asks for
_LIMITS = {"sensitivity": 0.2, "zero": 0.1}
"""Largest changes. Sensors misplaced by 2 mm look like a sensitivity that changes by 12 %, as the protocol
presses them first where the response should be highest."""
_SENSORS = 3  # that were pressed again: fewer may all be misplaced alike
_SURE = 0.95  # probability of the interval of a change: misplaced sensors cause one, too


def check_gauge(bench: BenchData) -> None:
    """Raise InputError if sensitivity or zero of the gauge change during a session.

    Each press gives a line of the gauge's force over the reading of a sensor, whose intercept is the zero of
    the gauge. Its slope, compared with that of other presses on the sensor, shows the sensitivity.

    Args:
        bench: the session.

    Raises:
        InputError: the sensitivity changes by more than 20 %, or the zero by 10 % of the peak force.
    """
    time, sensor, slope, zero = _fit_lines(bench).T
    # Sensors have gains of their own, but the gauge has one zero.
    for what, group, values in (("sensitivity", sensor, slope), ("zero", 0 * sensor, zero)):
        change, low, high = _fit_change(time, group, values)
        if abs(change) > _LIMITS[what] and low * high > 0:
            raise InputError(
                f"the {what} of the gauge, against the sensors, changes by {change:+.0%} during the session: "
                "let it warm up, zero it between presses, and record again"
            )


def _fit_lines(bench: BenchData) -> np.ndarray:
    """Return rows of time (as a fraction of the session), sensor, log slope, and intercept over the peak."""
    responses, rows = collect_responses(bench), []
    strength, largest = bench.each.max(axis=0), np.abs(responses.measured).max(axis=0)
    times = bench.gauge.time[bench.gauge.first]
    for press, each in enumerate(bench.each):
        steps = responses.press == press
        force = responses.force[steps]
        for sensor in np.flatnonzero(responses.responding & (each >= _REACHED * strength)):
            reading = np.abs(responses.measured[steps, sensor])
            linear = reading < _BELOW * largest[sensor]
            if linear.sum() >= _FEWEST and np.ptp(reading[linear]) > 0:
                slope, zero = np.polyfit(reading[linear], force[linear], 1)
                moment = (times[press] - times[0]) / np.ptp(times)
                rows.append((moment, sensor, np.log(abs(slope) * each[sensor]), zero / force.max()))
    return np.array(rows).reshape(-1, 4)


def _fit_change(time: np.ndarray, group: np.ndarray, values: np.ndarray) -> tuple[float, float, float]:
    """Return how values change from time 0 to 1 within groups, and its interval of 95 %; 0 if unknown.

    By the slopes between pairs (Theil and Sen), so that some misplaced sensors do not bend the line.
    """
    frame = pd.DataFrame({"time": time, "values": values})
    within = frame - frame.groupby(group).transform("mean")
    moved = within[within["time"].abs() > 1e-6]
    if len(moved) - len(np.unique(group)) < _SENSORS:
        return 0.0, 0.0, 0.0
    change, _, low, high = theilslopes(moved["values"], moved["time"], _SURE)
    return float(change), float(low), float(high)
