"""Hysteresis, lag and steps against closed forms."""

import numpy as np
import torch

from skin.mechanics.relaxation import apply_hysteresis, first_order_lag, quantize


def test_a_step_is_answered_by_an_exponential():
    time = torch.arange(200).double() / 100
    step = (time >= 0.5).double()[None, :, None].expand(1, -1, 2)
    said = first_order_lag(step, torch.tensor([0.08, 0.0], dtype=torch.float64), time)[0]
    # Held from one frame to the next, the force has acted for one frame when it is first read.
    acted = (time - 0.49).clamp(min=0)
    torch.testing.assert_close(said[:, 0], 1 - torch.exp(-acted / 0.08), rtol=1e-9, atol=1e-12)
    assert torch.equal(said[:, 1], step[0, :, 1])


def test_a_lag_does_not_depend_on_the_rate():
    constant = torch.tensor([0.1])
    fine, coarse = (torch.arange(rate).double() / rate for rate in (200, 50))
    slow, fast = (
        first_order_lag(torch.ones(1, len(t), 1).double(), constant, t)[0, :, 0] for t in (coarse, fine)
    )
    torch.testing.assert_close(slow, fast[3::4])


def test_hysteresis_is_the_mean_gap_as_a_share_of_the_peak():
    up = torch.linspace(0, 7, 2001).double()
    way = torch.cat([up, up.flip(0)])[None, :, None]
    said = apply_hysteresis(way, torch.tensor([0.05]))[0, :, 0]
    loading, back = said[:2001], said[2001:].flip(0)
    assert torch.equal(loading, up)
    assert np.isclose(float((back - loading).mean()), 0.05 * 7, rtol=1e-3)
    assert back[0] == 0
    assert back[-1] == 7


def test_steps_are_whole_where_there_are_steps():
    readings = torch.linspace(-1, 1, 41)[:, None].expand(-1, 2)
    said = quantize(readings, torch.tensor([0.25, 0.0]))
    assert set(said[:, 0].tolist()) == {quarter / 4 for quarter in range(-4, 5)}
    assert torch.equal(said[:, 1], readings[:, 1])
