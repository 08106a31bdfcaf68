"""The naive skin: the pressure of one cell times the footprint's area."""

import numpy as np
import pytest
import torch

from skin.body.base import Sensors, Sheet
from skin.mechanics.simulator.naive import Naive

BODY = Sheet([0.04, 0.03], [4, 3], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize(
    ("x", "y", "row", "column"),
    [(0.005, 0.005, 0, 0), (0.021, 0.019, 1, 2), (0.0, 0.029, 2, 0), (0.04, 0.03, 2, 3)],
)
def test_a_sensor_reads_the_cell_that_holds_it(x, y, row, column):
    naive = Naive(BODY, Sensors(np.array([[x, y, 0.0]]), (0.002, 0.002)))
    one_hot = torch.zeros(BODY.shape, requires_grad=True)
    naive(one_hot).readings.sum().backward()
    assert one_hot.grad.nonzero().tolist() == [[row, column]]


def test_reading_is_pressure_times_area():
    """10 kPa on 10 mm x 10 mm is 1 N; half of it at the edge."""
    naive = Naive(BODY, Sensors(np.array([[0.015, 0.015, 0.0], [0.0, 0.015, 0.0]]), (0.01, 0.01)))
    response = naive(torch.full(BODY.shape, 1e4))
    torch.testing.assert_close(response.readings, torch.tensor([1.0, 0.5]))
    assert response.displacement is None
