"""Footprints are integrated whole and fine enough, whichever way a sensor faces."""

import numpy as np
import pytest

from skin.body.base import Sensors
from skin.mechanics.simulator.solid import quadrature

LINES = (np.linspace(0, 0.16, 17), np.linspace(0, 0.12, 13), np.array([0, 0.0025, 0.005, 0.010, 0.015]))
SIDE = 0.006
WAYS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0.6, 0.8, 0), (0.6, 0, 0.8), (0.3, -0.2, 0.933)]


def sampled(way, place=(0.071, 0.052, 0.0075)):
    normal = np.array(way, dtype=float)
    normal /= np.linalg.norm(normal)
    return quadrature(Sensors(np.array([place]), (SIDE, SIDE), normal), LINES), normal


@pytest.mark.parametrize("way", WAYS)
def test_points_lie_across_the_normal_and_their_areas_sum_to_the_footprint(way):
    (points, areas, owner), normal = sampled(way)
    assert areas.sum() == pytest.approx(SIDE**2, rel=1e-12)
    assert abs((points - [0.071, 0.052, 0.0075]) @ normal).max() < 1e-12
    assert areas @ points / areas.sum() == pytest.approx([0.071, 0.052, 0.0075], rel=1e-9)
    assert not owner.any()


@pytest.mark.parametrize("way", [(0, 0, 1), (1, 0, 0), (0, 1, 0)])
def test_what_has_a_kink_at_every_face_of_the_mesh_is_integrated_exactly(way):
    """As the stress of elements has, along the surface and down."""
    (points, areas, _), _ = sampled(way)
    random = [np.random.default_rng(axis).random(len(line)) for axis, line in enumerate(LINES)]
    across = [axis for axis in range(3) if not way[axis]]
    values = np.prod([np.interp(points[:, axis], LINES[axis], random[axis]) for axis in across], axis=0)
    exact = 1.0
    for axis in across:
        fine = (0.071, 0.052, 0.0075)[axis] + SIDE * ((np.arange(60000) + 0.5) / 60000 - 0.5)
        exact *= SIDE * np.interp(fine, LINES[axis], random[axis]).mean()
    assert areas @ values == pytest.approx(exact, rel=1e-7)


def test_what_passes_the_surface_is_cut_off():
    (points, areas, _), _ = sampled((1, 0, 0), (0.08, 0.06, 0.001))
    assert points[:, 2].min() >= 0
    assert areas.sum() == pytest.approx(SIDE * 0.004, rel=1e-9)
