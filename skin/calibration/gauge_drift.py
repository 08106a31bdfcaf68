"""Find in a bench session whether its force gauge drifts."""

import numpy as np
import pandas as pd
from scipy.stats import theilslopes

from skin.calibration.bench import BenchData
from skin.calibration.wiring import collect_responses
from skin.errors import InputError

_BELOW = 0.8  # of the channel's largest response: above, it may be at its limit
_REACHED = 0.5  # of the sensor's strongest press: weaker ones depend on where it lies
_FEWEST = 2  # steps below the limit that determine a line: what the protocol asks for
_LIMITS = {"sensitivity": 0.2, "zero": 0.1}
"""Largest changes. Sensors misplaced by 2 mm look like a sensitivity that changes by 12 %, as the protocol
presses them first where the response should be highest."""
_SENSORS = 3  # that were pressed again: fewer may all be misplaced alike


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
        if abs(change := _fit_change(time, group, values)) > _LIMITS[what]:
            raise InputError(
                f"the {what} of the gauge, against the sensors, changes by {change:+.0%} during the session: "
                "let it warm up, zero it between presses, and record again"
            )


def _fit_lines(bench: BenchData) -> np.ndarray:
    """Return rows of time (fraction of presses before), sensor, log slope, and intercept over the peak."""
    responses, rows = collect_responses(bench), []
    strength, largest = bench.each.max(axis=0), np.abs(responses.measured).max(axis=0)
    for press, each in enumerate(bench.each):
        steps = responses.press == press
        force = responses.force[steps]
        for sensor in np.flatnonzero(responses.responding & (each >= _REACHED * strength)):
            reading = np.abs(responses.measured[steps, sensor])
            linear = reading < _BELOW * largest[sensor]
            if linear.sum() >= _FEWEST and np.ptp(reading[linear]) > 0:
                slope, zero = np.polyfit(reading[linear], force[linear], 1)
                sensitivity = np.log(abs(slope) * each[sensor])
                rows.append((press / len(bench.each), sensor, sensitivity, zero / force.max()))
    return np.array(rows).reshape(-1, 4)


def _fit_change(time: np.ndarray, group: np.ndarray, values: np.ndarray) -> float:
    """Return how values change from time 0 to 1 within groups; 0 if its interval of 95 % contains 0.

    By the slopes between pairs (Theil and Sen), so that some misplaced sensors do not bend the line.
    """
    frame = pd.DataFrame({"time": time, "values": values})
    # Rounded, because a slope between two times that differ in the last digit is none.
    within = (frame - frame.groupby(group).transform("mean")).round(6)
    moved = within[within["time"] != 0]
    if len(moved) - len(np.unique(group)) < _SENSORS:
        return 0.0
    change, _, low, high = theilslopes(moved["values"], moved["time"])
    return float(change) if low * high > 0 else 0.0
