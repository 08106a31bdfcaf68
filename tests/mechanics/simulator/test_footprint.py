"""Footprints are sampled whole, whichever way a sensor faces; what passes the body is said to be lost."""

import numpy as np
import pytest

from skin.body.base import Sensors, Sheet
from skin.mechanics.geometry import sample
from skin.mechanics.simulator.solid import Solid

EXTENT = (0.16, 0.12, 0.015)
SIDE = 0.006
WAYS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0.6, 0.8, 0), (0.6, 0, 0.8), (0.3, -0.2, 0.933)]


def sampled(way, position=(0.071, 0.052, 0.0075)):
    normal = np.array(way, dtype=float)
    normal /= np.linalg.norm(normal)
    points, inside = sample(Sensors(np.array([position]), (SIDE, SIDE), normal), EXTENT)
    return points[0], inside[0], normal


@pytest.mark.parametrize("way", WAYS)
def test_points_lie_across_the_normal_about_the_sensor(way):
    points, inside, normal = sampled(way)
    away = points - [0.071, 0.052, 0.0075]
    assert inside.all()
    assert np.abs(away @ normal).max() < 1e-12
    assert away.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-15)
    assert (away**2).sum(axis=1).mean() == pytest.approx(SIDE**2 / 6, rel=0.01)


def test_a_cut_footprint_is_said_with_its_share():
    """Leaning by 45 degrees 0.5 mm above the base, 3.5 mm of 10 mm reach into the base: with 0.5 mm, 43 %."""
    body = Sheet([0.08, 0.08], [8, 8], [{"material": "EcoFlex 00-30", "thickness": 0.012}])
    positions = np.array([[0.03, 0.03, 0.0115], [0.05, 0.05, 0.006], [0.0, 0.04, 0.006]])
    lean = np.array([[0, 0.6, 0.8], [0, 0.6, 0.8], [0, 0, 1.0]])
    with pytest.warns(UserWarning, match=r"of 1 tilted sensors.*sensor 1 loses 4[0-4] % of its footprint"):
        Solid(body, Sensors(positions, (0.01, 0.01), lean), divisions=1)
