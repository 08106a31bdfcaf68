"""Skins that relax, against the equations of their motion; hysteresis, lag and steps against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from skin.body.base import Sensors, Sheet
from skin.body.layout import Grid
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.relaxation import Relaxing, apply_hysteresis, first_order_lag, quantize
from skin.mechanics.simulator.fem import PlatesAndBeams, Structure

RATE = 10.0
SENSORS = Sensors(np.array([[0.05, 0.04, 0.005], [0.09, 0.07, 0.005], [0.13, 0.05, 0.005]]), (0.02, 0.02))
SLOW, FAST = {"time": 0.6, "strength": 1.0}, {"time": 0.15, "strength": 0.5}
CASES = {"skin": (None, SLOW), "muscle": (SLOW, None), "both alike": (SLOW, SLOW), "both": (SLOW, FAST)}
CASES |= {"strong": ({"time": 0.5, "strength": 4.0}, FAST), "weak": (None, {"time": 0.5, "strength": 0.15})}


def sheet(muscle: dict | None, skin: dict | None) -> Sheet:
    lower = {"name": "Dragon Skin 10 Medium", "poisson": 0.45, "relaxation": muscle}
    upper = {"name": "EcoFlex 00-30", "poisson": 0.45, "relaxation": skin}
    layers = [{"material": lower, "thickness": 0.010}, {"material": upper, "thickness": 0.005}]
    return Sheet([0.16, 0.12], [5, 4], layers)


def movie(frames: int = 40) -> torch.Tensor:
    """Return pressure (1, T, H, W), Pa, of a touch that slides, rests and leaves."""
    row, column = torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij")
    pressure = torch.zeros(1, frames, 4, 5)
    for frame in range(2, 25):
        way = min(frame, 14) / 14 * 4
        pressure[0, frame] = 5e4 * torch.exp(-((column - way) ** 2 + (row - 1.5) ** 2))
    return pressure


def play(simulator, pressure: torch.Tensor):
    index = torch.arange(pressure.shape[1])[None]
    return simulator.play(pressure[0], index, torch.ones(1, pressure.shape[1]), displacement=True)


def stepped(body: Sheet, pressure: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return D_s, D_t and the force carried below, (T, S), by integrating the Maxwell elements exactly.

    Each material k has dashpots whose strain follows a field v_k: sum_k E_k K_k (u + g_k (u - v_k)) = f and
    v_k' = (u - v_k) / tau_k. Under a load that is held this is linear with constant coefficients.
    """
    elastic = (replace(one, material=replace(one.material, relaxation=None)) for one in body.layers)
    still = replace(body, layers=tuple(elastic))
    structure = Structure(still, "vertical")
    whole = structure.stiffness().toarray()
    parts, rows = [], []
    for number, layer in enumerate(still.layers):
        double = replace(layer, material=replace(layer.material, young=2 * layer.material.young))
        layers = tuple(double if n == number else one for n, one in enumerate(still.layers))
        other = Structure(replace(still, layers=layers), "vertical")
        parts.append(other.stiffness().toarray() - whole)
        levels = other.levels(SENSORS)
        rows.append((other.carried(SENSORS, levels) - structure.carried(SENSORS, levels)).toarray())
    branches = [layer.material.relaxation for layer in body.layers]
    strength = [one.strength if one else 0.0 for one in branches]
    time = [one.time if one else 1.0 for one in branches]
    size, count = len(whole), len(parts)
    stiff = sum((1 + g) * part for g, part in zip(strength, parts, strict=True))
    back = np.linalg.solve(stiff, np.hstack([g * part for g, part in zip(strength, parts, strict=True)]))
    load = np.linalg.solve(stiff, structure.load().toarray())
    rate = np.vstack([np.hstack([back[:, : count * size]])] * count) - np.eye(count * size)
    rate /= np.repeat(time, size)[:, None]
    step = expm(rate / RATE)
    v, found = np.zeros(count * size), []
    top = np.full_like(levels, count - 1)
    for frame in pressure[0].flatten(1).double().numpy():
        u = load @ frame
        steady = -np.linalg.solve(rate, np.tile(u, count) / np.repeat(time, size))
        v = steady + step @ (v - steady)
        u = u + back @ v
        branches = zip(rows, strength, v.reshape(count, size), strict=True)
        carried = sum(row @ (u + g * (u - one)) for row, g, one in branches)
        deflections = (structure.deflection(SENSORS, at) @ u for at in (levels, top))
        found.append([*deflections, carried])
    return tuple(np.array(found).transpose(1, 0, 2))


@pytest.mark.parametrize("case", CASES)
def test_it_follows_the_equations_of_motion(case):
    """Measured: 3e-5 of the largest value at worst, where the modulus falls to a fifth."""
    body, pressure = sheet(*CASES[case]), movie()
    sensor, surface, carried = stepped(body, pressure)
    below = Relaxing(lambda *given: PlatesAndBeams(*given, "interface"), body, SENSORS, RATE)
    answer = play(below, pressure)
    ours = [answer.displacement[0, ..., 0], answer.displacement[0, ..., 1], answer.readings[0]]
    for exact, found in zip((sensor, surface, carried), ours, strict=True):
        assert np.abs(found.numpy() - exact).max() < 1e-4 * np.abs(exact).max()
    # It would tell: neither the relaxed nor the instantaneous skin does so.
    for model in (below.models[0], below.models[-1]):
        moved = play(model, pressure).displacement[0, ..., 1].numpy()
        assert np.abs(moved - surface).max() > 0.02 * np.abs(surface).max()


def test_pressure_that_has_always_been_there_meets_the_relaxed_skin():
    relaxing = Relaxing(PlatesAndBeams, sheet(SLOW, FAST), SENSORS, RATE)
    plain = PlatesAndBeams(sheet(None, None), SENSORS)
    assert torch.equal(relaxing(movie()[0, 10]).readings, plain(movie()[0, 10]).readings)
    assert torch.equal(relaxing.strain(movie()[0]), plain.strain(movie()[0]))


def device(body: Sheet, **changes) -> Simulated:
    touch = {"shapes": ["disc"], "small_area": [0.2, 0.3]}
    settings = {"simulator": PlatesAndBeams, "gestures": 16, "test_gestures": 8, "layout": Grid(2, 2)}
    return Simulated(body=body, touch=touch, offset=0.0, noise=0.0, **(settings | changes))


def test_a_device_relaxes_only_where_a_material_does():
    still = device(sheet(None, None))
    assert isinstance(still.model, PlatesAndBeams)
    slow, fast = device(sheet(SLOW, FAST)), device(sheet(SLOW, FAST), rate=1000.0)
    assert torch.equal(slow.touches("test").labels, still.touches("test").labels)
    readings = [one.touches("test").readings for one in (still, slow, fast)]
    for one, other in ((0, 1), (1, 2)):
        assert (readings[one] - readings[other]).abs().max() > 0.01 * readings[one].abs().max()
    with pytest.raises(InputError, match=r"a skin that relaxes .* got data\.stream=true"):
        device(sheet(SLOW, None), stream=True)


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
    ones = torch.ones(1, 200, 1).double()
    slow, fast = (first_order_lag(ones[:, : len(t)], constant, t)[0, :, 0] for t in (coarse, fine))
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
