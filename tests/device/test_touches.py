"""Touches and recordings hold together or are refused; contacts of fingertips travel with them."""

from dataclasses import replace

import pytest
import torch

from skin import read_recording
from skin.device.files import describe_recording, read_description, write_recording
from skin.device.touches import Recording, Touches, concatenate, join_contacts
from skin.learning.data import Augmentation
from skin.touch.labels import TOUCH
from tests.made_up import PERFECT, naive_skin


def touches(count: int = 4, moving: bool = False) -> Touches:
    positions = torch.rand(count, 6, 3, 3) if moving else torch.rand(3, 3)
    readings = torch.arange(count * 18.0).view(count, 6, 3)
    return Touches(readings, readings > 2, positions, torch.eye(4)[:count], 10.0)


def recording(count: int = 4) -> Recording:
    extra = {"force": torch.rand(count, 6), "displacement": torch.rand(count, 6, 3, 2)}
    extra |= {"parameters": {"speed": torch.rand(count)}}
    return Recording(touches(count), TOUCH, (0.1, 0.1), (0.01, 0.01), **extra)


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
        (touches, {"contacts": torch.zeros(4, 5, 3, 5)}),
        (recording, {"touches": touches(moving=True)}),
        (recording, {"force": torch.zeros(4, 5)}),
        (recording, {"parameters": {"speed": torch.zeros(3)}}),
    ],
)
def test_touches_and_recordings_that_disagree_are_refused(made, wrong):
    with pytest.raises(ValueError, match=r"must"):
        replace(made(), **wrong)


TIPS = {"radius": [0.004, 0.012]}


def device(**changes):
    return naive_skin(**({"touch": TIPS, "gestures": 40, "test_gestures": 16} | changes))


def same(one, other) -> bool:
    return torch.equal(one.nan_to_num(-1), other.nan_to_num(-1))


@pytest.fixture(scope="module")
def fingertips():
    return device().recording()


def test_a_file_gives_them_back_to_the_last_bit(fingertips, tmp_path):
    path = write_recording(fingertips, tmp_path / "x.parquet")
    for complete in (True, False):
        assert same(read_recording(path, complete).touches.contacts, fingertips.touches.contacts)


def test_a_file_of_gestures_has_no_trace_of_them(tmp_path):
    """So that versions without contacts and this one read each other's files."""
    gestures = device(touch=None).recording()
    assert gestures.touches.contacts is None
    assert "contacts" not in describe_recording(gestures)
    path = write_recording(gestures, tmp_path / "x.parquet")
    assert "contacts" not in read_description(path)
    assert read_recording(path).touches.contacts is None


def test_contacts_press_sensors_that_are_near():
    """The naive skin reads pressure under a sensor, so a sensor that reads has a contact over it."""
    touches = device(**PERFECT).touches("test")
    positions = touches.contacts[:, :, None, :, :2] - touches.positions[None, None, :, None, :2]
    gap = (positions.norm(dim=-1) - touches.contacts[:, :, None, :, 2]).nan_to_num(1.0).amin(3)
    cell = 0.16 / 32
    assert (touches.readings > 1e-3).any()
    assert gap[touches.readings > 1e-3].max() < 2 * cell
    assert (touches.readings[gap < -2 * cell] > 0).all()


def test_windows_of_streams_have_those_that_they_show():
    touches = device(stream=True).touches("test")
    shown = ~touches.contacts[..., 0].isnan().all(2)
    assert not shown[touches.labels[:, -1] == 0].any()
    assert shown[touches.labels[:, -1] == 1].any(1).all()
    source = device(stream=True, **PERFECT)
    whole = source.simulate_stream(600).whole
    assert torch.equal(~whole.touches.contacts[..., 0].isnan().all(2), whole.force > 0)


def test_joined_recordings_have_them_where_all_do(fingertips):
    other = device(touch=TIPS | {"contacts": [1, 1]}, data_seed=1).recording()
    contacts = concatenate([fingertips, other]).touches.contacts
    assert contacts.shape == (80, 30, 3, 5)
    assert contacts[40:, :, 1:].isnan().all()
    assert same(contacts[40:, :, :1], other.touches.contacts)
    assert join_contacts([contacts, None]) is None


def test_a_shifted_touch_has_shifted_contacts():
    touches = device(**PERFECT, touch=TIPS | {"over_sensors": False}).touches("train")
    moved = Augmentation(shift=True, reverse=True)(touches, torch.Generator().manual_seed(0))
    assert not same(moved.contacts, touches.contacts)
    pressed = moved.readings.sum(2) > 1e-3
    assert not moved.contacts[..., 0].isnan().all(2)[pressed].any()
    assert same(*(each.contacts[..., 3].flatten(1).nan_to_num(0).sort(1).values for each in (moved, touches)))
