"""What every representation must do."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.errors import InputError

CONF = Path(__file__).parents[3] / "conf"
# sites needs the geometry of sensors (test_representation.py)
OPTIONS = sorted(path for path in (CONF / "representation").glob("*.yaml") if path.stem != "sites")
VARIANTS = [
    (path, extra)
    for path in OPTIONS
    for extra in (
        {},
        *(
            {
                "interp": [{"method": "nearest"}, {"method": "cubic"}],
                "graph": [{"edges": "delaunay"}, {"weight": "stiffness"}],
            }
        ).get(path.stem, []),
    )
]


@pytest.fixture(params=VARIANTS, ids=lambda v: "-".join([v[0].stem, *v[1].values()]))
def make(request):
    path, extra = request.param
    around = {"body": OmegaConf.load(CONF / "body" / "sheet.yaml"), "option": OmegaConf.load(path)}
    option = OmegaConf.to_container(OmegaConf.create(around), resolve=True)["option"]
    return lambda *args, **changes: instantiate(option, **extra)(*args, **changes)


@pytest.fixture
def given(made_up_device):
    touches = made_up_device.touches("train")[:5]
    return touches.positions, made_up_device.size, touches.readings, touches.valid


@pytest.mark.parametrize("mask", [False, True])
def test_shapes_follow_the_kind(make, given, mask):
    positions, size, readings, valid = given
    representation = make(positions, size, mask=mask)
    x, adjacency, summary = representation(readings, valid)
    channels = 2 if mask else 1
    views = 1 if summary is None else 2
    wanted = {"image": (channels, 64, 64), "graph": (12, channels), "readings": (12 * (views + mask),)}
    assert x.shape == (5, 10, *wanted[representation.kind])
    assert x.dtype == torch.float32
    assert (adjacency is None) == (representation.kind != "graph")
    if adjacency is not None:
        assert adjacency.shape == (12, 12)


def test_an_invalid_reading_says_nothing(make, given):
    positions, size, readings, valid = given
    representation = make(positions, size)
    valid = valid.clone()
    valid[:, 3:5, 7] = False
    bad, zero = readings.clone(), readings.clone()
    bad[:, 3:5, 7], zero[:, 3:5, 7] = float("nan"), 0
    shown = representation(bad, valid).x
    assert torch.equal(shown, representation(zero, valid).x)
    if not representation.windowed:
        assert torch.equal(shown, representation(zero, torch.ones_like(valid)).x)


def test_scale_divides_the_readings(make, given):
    positions, size, readings, valid = given
    one, other = (make(positions, size, scale=scale) for scale in (10.0, 5.0))
    first = slice(12) if one.windowed else slice(None)  # its second view has a unit of its own
    shown = other(readings / 2, valid).x[..., first]
    torch.testing.assert_close(shown, one(readings, valid).x[..., first])


def test_touches_do_not_see_each_other(make, given):
    positions, size, readings, valid = given
    representation = make(positions, size)
    together = representation(readings, valid).x
    torch.testing.assert_close(representation(readings[2:3], valid[2:3]).x, together[2:3])
    part = representation(readings[:, 4:6], valid[:, 4:6]).x
    assert torch.allclose(part, together[:, 4:6], rtol=1e-4, atol=1e-5) == (not representation.windowed)


def test_gradients_reach_every_reading(make, given):
    positions, size, readings, valid = given
    readings = readings.clone().requires_grad_()
    make(positions, size)(readings, valid).x.square().sum().backward()
    assert (readings.grad != 0).all()


def test_one_sensor_is_enough_where_no_triangle_is_needed(make, given, request):
    _, size, readings, valid = given
    one = torch.tensor([[0.08, 0.06, 0.005]])
    if any(name in request.node.name for name in ("[interp]", "cubic", "delaunay")):
        with pytest.raises(InputError, match="at least three sensors"):
            make(one, size)
    else:
        assert torch.isfinite(make(one, size)(readings[..., :1], valid[..., :1]).x).all()
