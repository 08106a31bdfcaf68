"""A force gauge that drifts during a session is refused, where the session shows it."""

from dataclasses import replace

import numpy as np
import pytest

from skin.calibration.bench import BenchData
from skin.calibration.fit import check_gauge
from skin.calibration.known_loads import emulate_session
from skin.errors import InputError
from tests.calibration.test_fit import PROTOCOL, SLOW, device, session_of


def drifted(bench: BenchData, gain: float = 0.0, zero: float = 0.0) -> BenchData:
    """Return a session whose gauge changes linearly, by shares of its sensitivity and of the peak."""
    gauge = bench.gauge
    time = (gauge.time - gauge.time[0]) / np.ptp(gauge.time)
    force = gauge.force * (1 + gain * time) + zero * gauge.force.max() * time
    return BenchData(bench.session, replace(gauge, force=force), bench.each)


@pytest.mark.parametrize("hidden", [{}, SLOW, {"exponent": 0.5}, {"position_error": 0.002}])
def test_a_steady_gauge_is_accepted(hidden):
    check_gauge(session_of(device(**hidden)))


@pytest.mark.parametrize("hidden", [{}, SLOW])
@pytest.mark.parametrize(
    ("drift", "named"),
    [
        ({"gain": 0.3}, r"sensitivity .* \+[23]\d%"),
        ({"gain": -0.3}, "sensitivity .* -3"),
        ({"zero": 0.3}, "zero"),
    ],
)
def test_a_gauge_that_drifts_by_30_percent_is_refused(hidden, drift, named):
    with pytest.raises(InputError, match=f"{named}.*record again"):
        check_gauge(drifted(session_of(device(**hidden)), **drift))


def test_where_each_sensor_is_pressed_once_only_the_zero_can_be_seen():
    skin, randomness = device(), np.random.default_rng(0)
    rows = PROTOCOL.gauge(PROTOCOL.positions(skin, randomness)[:6])
    session = emulate_session(skin, rows, PROTOCOL, randomness)
    bench = replace(session_of(skin), session=session, gauge=rows, each=session_of(skin).each[:6])
    check_gauge(drifted(bench, gain=0.3))
    with pytest.raises(InputError, match="the zero of the gauge"):
        check_gauge(drifted(bench, zero=0.3))
