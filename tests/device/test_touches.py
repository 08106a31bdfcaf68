"""Touches and recordings hold together or are refused."""

from dataclasses import replace

import pytest
import torch

from skin.device.touches import Recording, Touches
from skin.touch.labels import TOUCH


def touches(count: int = 4, moving: bool = False) -> Touches:
    positions = torch.rand(count, 6, 3, 3) if moving else torch.rand(3, 3)
    readings = torch.arange(count * 18.0).view(count, 6, 3)
    return Touches(readings, readings > 2, positions, torch.eye(4)[:count], 10.0)


def recording(count: int = 4) -> Recording:
    extra = {"force": torch.rand(count, 6), "displacement": torch.rand(count, 6, 3, 2)}
    return Recording(
        touches(count), TOUCH, (0.1, 0.1), (0.01, 0.01), **extra, parameters={"speed": torch.rand(count)}
    )


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("index", [slice(1, 3), torch.tensor([3, 0])])
def test_selected_touches(moving, index):
    every = touches(moving=moving)
    some = every[index]
    assert len(some) == 2
    assert torch.equal(some.readings, every.readings[index])
    assert torch.equal(some.labels, every.labels[index])
    assert torch.equal(some.positions, every.positions[index] if moving else every.positions)


@pytest.mark.parametrize(
    ("made", "wrong"),
    [
        (touches, {"valid": torch.ones(4, 6, 2, dtype=torch.bool)}),
        (touches, {"valid": torch.ones(4, 6, 3)}),
        (touches, {"positions": torch.zeros(2, 3)}),
        (touches, {"labels": torch.zeros(3, 4)}),
        (touches, {"contacts": torch.zeros(4, 6, 3, 4)}),
        (touches, {"contacts": torch.zeros(4, 5, 3, 5)}),
        (recording, {"touches": touches(moving=True)}),
        (recording, {"force": torch.zeros(4, 5)}),
        (recording, {"displacement": torch.zeros(4, 6, 3)}),
        (recording, {"parameters": {"speed": torch.zeros(3)}}),
    ],
)
def test_touches_and_recordings_that_disagree_are_refused(made, wrong):
    with pytest.raises(ValueError, match=r"must"):
        replace(made(), **wrong)
