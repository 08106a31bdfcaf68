"""PySensors chooses sites in its own environment."""

import numpy as np
import pytest

from experiments import peers
from experiments.peers.placement import ask

pytestmark = pytest.mark.skipif(not peers.python().is_file(), reason="no .venv-peers: make peers builds it")


@pytest.fixture
def arrays():
    """Readings of smooth bumps on a raster of 10 mm."""
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    places = 0.01 * np.column_stack([x.ravel(), y.ravel()])
    centres = np.random.default_rng(0).uniform(0, (0.08, 0.05), (400, 2))
    squares = ((centres[:, None] - places) ** 2).sum(axis=-1)
    return {"readings": 5 + np.exp(-squares / (2 * 0.015**2)), "places": places}


def nearest(places, sites):
    apart = np.linalg.norm(places[sites, None] - places[sites], axis=-1)
    return apart[np.triu_indices(len(sites), 1)].min()


def test_qr_chooses_the_pivots_of_the_modes(arrays):
    """The first site is the largest row of the leading modes, each next one the largest remainder."""
    found = ask(arrays, count=5, distance=0.0)
    centred = arrays["readings"] - arrays["readings"].mean(axis=0)
    modes = np.linalg.svd(centred, full_matrices=False)[2][:5]
    expected = []
    for _ in range(5):
        site = int(np.argmax((modes**2).sum(axis=0)))
        axis = modes[:, site] / np.linalg.norm(modes[:, site])
        modes = modes - np.outer(axis, axis @ modes)
        expected.append(site)
    assert found["pysensors_qr"]["sites"] == found["pysensors_gqr"]["sites"] == expected
    assert all(one["cpu_seconds"] > 0 for one in found.values())


def test_gqr_keeps_the_distance(arrays):
    """Sensors may be exactly as far apart as the distance."""
    found = ask(arrays, count=6, distance=0.03)
    assert nearest(arrays["places"], found["pysensors_qr"]["sites"]) < 0.03 - 1e-3
    assert nearest(arrays["places"], found["pysensors_gqr"]["sites"]) == pytest.approx(0.03)
    assert len(set(found["pysensors_gqr"]["sites"])) == 6


def test_an_error_is_passed_on(arrays):
    with pytest.raises(RuntimeError, match="ValueError"):
        ask(arrays, count=-1, distance=0.01)
