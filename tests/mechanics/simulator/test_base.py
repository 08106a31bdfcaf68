"""The contract of every simulator, and the naive one: the pressure of a cell times the footprint's area."""

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.body.base import Sensors, Sheet
from skin.body.layout import Scattered
from skin.core.files import CONF
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator, Response
from skin.mechanics.simulator.naive import Naive

BODY = instantiate(OmegaConf.load(CONF / "body" / "sheet.yaml"), size=[0.16, 0.12], cells=[9, 7])
SENSORS = Scattered(2, 3, seed=3).sensors(BODY)
OPTIONS = [
    pytest.param((path, extra), id="-".join([path.stem, *map(str, extra.values())]))
    for path in sorted((CONF / "simulator").glob("*.yaml"))
    for extra in ([{}, {"reading": "interface"}, {"constraint": "free"}] if path.stem == "fem" else [{}])
]


@pytest.fixture(params=OPTIONS)
def simulator(request, tmp_path, monkeypatch) -> AbstractSimulator:
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))
    path, extra = request.param
    return instantiate(OmegaConf.load(path), **extra)(BODY, SENSORS)


def pressure(*lead: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 1e5 * torch.rand(*lead, *BODY.shape, generator=generator)


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
def test_shapes_and_types(simulator, lead):
    response = simulator.press(simulator.loads(pressure(*lead)), displacement=True)
    assert isinstance(response, Response)
    assert response.readings.shape == (*lead, len(SENSORS))
    assert response.readings.dtype == torch.float32
    if response.displacement is not None:
        assert response.displacement.shape == (*lead, len(SENSORS), 2)


def test_frames_do_not_see_each_other(simulator):
    frames = pressure(5)
    together = simulator(frames).readings
    alone = torch.stack([simulator(frame).readings for frame in frames])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("factor", [0.0, 0.3, 7.0])
def test_positively_homogeneous(simulator, factor):
    loads = simulator.loads(pressure(5))
    once, more = (simulator.press(each, displacement=True) for each in (loads, factor * loads))
    torch.testing.assert_close(more.readings, factor * once.readings, rtol=1e-5, atol=1e-5)
    if once.displacement is not None:
        rounded = 2e-6 * float(more.displacement.abs().max())  # single precision
        torch.testing.assert_close(more.displacement, factor * once.displacement, rtol=1e-5, atol=rounded)


def test_nothing_reads_nothing_and_its_gradient_is_finite(simulator):
    """Equation 10 is 0 / 0 there: neither the value nor the gradient may be NaN."""
    frame = torch.zeros(BODY.shape, requires_grad=True)
    readings = simulator(frame).readings
    assert (readings == 0).all()
    readings.sum().backward()
    assert torch.isfinite(frame.grad).all()


def test_gradient_is_that_of_finite_differences(simulator):
    frame = (pressure().double() / 1e5).requires_grad_()
    simulator = simulator.double()
    assert torch.autograd.gradcheck(lambda p: simulator(p * 1e5).readings, frame, eps=1e-4, atol=1e-5)


@pytest.mark.parametrize("shape", [(7,), (9, 7), (2, 7, 8)])
def test_frames_of_another_sheet_are_refused(simulator, shape):
    with pytest.raises(ValueError, match=r"pressure must be \(\.\.\., H, W\) with H, W = \(7, 9\)"):
        simulator(torch.zeros(shape))


def test_its_state_is_all_in_its_buffers(simulator):
    """A simulator that is moved or copied answers the same: nothing hides outside the module's state."""
    state = {name: value.clone() for name, value in simulator.state_dict().items()}
    before = simulator(pressure()).readings
    for buffer in simulator.buffers():
        buffer.zero_()
    simulator.load_state_dict(state)
    np.testing.assert_array_equal(simulator(pressure()).readings, before)


def test_drag_is_felt_or_refused_by_name(simulator):
    frames, shear = pressure(3), torch.tensor([[0.5, 0.0], [0.0, 0.5], [0.0, 0.0]])
    if not simulator.feels_shear:
        with pytest.raises(InputError, match=r"friction needs a simulator .* set simulator=solid"):
            simulator(frames, shear)
        return
    plain, sheared, twice = simulator(frames), simulator(frames, shear), simulator(2 * frames, shear)
    assert not torch.allclose(plain.readings[:2], sheared.readings[:2], rtol=1e-3)
    torch.testing.assert_close(plain.readings[2], sheared.readings[2], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(twice.readings, 2 * sheared.readings, rtol=1e-4, atol=1e-5)


TINY = Sheet([0.04, 0.03], [4, 3], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize(
    ("x", "y", "row", "column"),
    [(0.005, 0.005, 0, 0), (0.021, 0.019, 1, 2), (0.0, 0.029, 2, 0), (0.04, 0.03, 2, 3)],
)
def test_a_sensor_reads_the_cell_that_holds_it(x, y, row, column):
    naive = Naive(TINY, Sensors(np.array([[x, y, 0.0]]), (0.002, 0.002)))
    one_hot = torch.zeros(TINY.shape, requires_grad=True)
    naive(one_hot).readings.sum().backward()
    assert one_hot.grad.nonzero().tolist() == [[row, column]]


def test_reading_is_pressure_times_area():
    """10 kPa on 10 mm x 10 mm is 1 N; half of it at the edge."""
    naive = Naive(TINY, Sensors(np.array([[0.015, 0.015, 0.0], [0.0, 0.015, 0.0]]), (0.01, 0.01)))
    response = naive(torch.full(TINY.shape, 1e4))
    torch.testing.assert_close(response.readings, torch.tensor([1.0, 0.5]))
    assert response.displacement is None
