"""Touches on many skins: what a batch holds, and that test skins are others."""

import pytest
import torch

from skin.body.base import GEOMETRY
from skin.core.rng import generator
from skin.device import skins
from skin.errors import InputError
from skin.runs.build import build_device

SMALL = (
    "device=skins", "device.count=2", "device.test_skins=1", "device.skins.length=[0.08,0.1]",
    "device.skins.aspect=[1,1.2]", "device.skins.cell=0.01", "device.skins.sensors=[4,9]",
    "device.skins.divisions=1", "data.gestures=100", "device.test_gestures=32", "device.fresh=true",
)  # fmt: skip


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured(*SMALL))


def test_touches_of_skins_with_few_sensors_are_filled_up(device):
    touches = device.touches("train", 1)
    counts = [len(skin.sensors) for skin in device.training_skins]
    assert touches.readings.shape == (80, 30, max(counts))
    assert touches.positions.shape == (80, max(counts), 3)
    assert touches.geometry.shape == (80, max(counts), len(GEOMETRY))
    working = touches.valid.any(dim=1).sum(dim=1)
    assert set(working.tolist()) <= {count - dead for count in counts for dead in range(count // 4 + 1)}
    assert torch.equal(touches.geometry[..., :2], touches.positions[..., :2])
    assert touches.labels.mean(0).tolist() == pytest.approx([0.5] * 4, abs=0.05)


def test_an_epoch_is_new_and_repeatable_and_validation_stays(device):
    first, second = device.touches("train", 1), device.touches("train", 2)
    assert torch.equal(first.readings, device.touches("train", 1).readings)
    assert not torch.equal(first.readings, second.readings)
    assert device.touches("validation", 1) is device.touches("validation", 2)
    sizes = {skin.body.size for skin in device.training_skins}
    assert not sizes & {skin.body.size for skin in device.unseen_skins}
    assert len(device.touches("test")) == 32


def test_training_skins_may_have_other_touches(configured):
    changes = "+device.training_touch.second=0.5", "+device.training_touch.press=[0.4,2.8]"
    wider = build_device(configured(*SMALL, *changes))
    assert {skin.sampler.settings.second for skin in wider.training_skins} == {0.5}
    assert {skin.sampler.settings.frames.press for skin in wider.training_skins} == {(4, 28)}
    for skin in (*wider.unseen_skins, wider.reference):
        assert (skin.sampler.settings.second, skin.sampler.settings.frames.press) == (0.0, (4, 20))
    with pytest.raises(InputError, match=r"touch\.window"):
        build_device(configured(*SMALL, "+device.training_touch.window=4.0"))


def test_no_stream_defines_a_skin_and_orders_an_epoch(configured, monkeypatch):
    """With skin_seed=0 and data_seed=0, one stream used to do both for skin e and epoch e."""
    fresh, used = build_device(configured(*SMALL)), []

    def noted(stream, *key):
        used.append((stream, *key))
        return generator(stream, *key)

    monkeypatch.setattr(skins, "generator", noted)
    assert fresh.training_skins
    assert fresh.unseen_skins
    defining = set(used)
    used.clear()
    for epoch in range(fresh.count):
        fresh.touches("train", epoch)
    for split in ("validation", "holdout", "test"):
        fresh.touches(split)
    assert len(defining) == fresh.count + fresh.test_skins
    assert used
    assert not defining & set(used)


def test_a_blank_device_prepares_no_skin(configured):
    fresh = build_device(configured(*SMALL))
    blank = fresh.blank()
    assert blank.touches("train").readings.shape == (1, 30, 25)
    assert "training_skins" not in vars(fresh)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("device.skins.sensors=[9,4]", "must be a range"),
        ("device.skins.layouts=[square]", "device.skins.layouts"),
        ("device.count=0", "device.count=0"),
        (
            "device.skins={plates: 0.6, naive: 0.5}",
            "naive + device.skins.interface must be at most 1, got 1.1",
        ),
    ],
)
def test_refuses(configured, override, words):
    with pytest.raises(InputError) as caught:
        build_device(configured(*SMALL, override))
    assert words in str(caught.value)
