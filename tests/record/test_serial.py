"""A skin at a port gives the touches that were played, or says why it cannot."""

from itertools import count, islice

import numpy as np
import pytest
import torch

from skin import Grid, InputError
from skin.record.serial import Serial
from skin.wire.emulator import Emulator, emulated_gestures
from tests.made_up import PERFECT, SHEET, naive_skin

LAYOUT, COUNT = Grid(2, 3), 6


def skin(**settings):
    return naive_skin(layout=LAYOUT, **settings)


def serial(emulator, layout=LAYOUT, **settings):
    port = emulator and emulator.port.address
    return Serial(body=SHEET, layout=layout, port=port, gestures=COUNT, timeout=30.0, **settings)


def test_it_reads_what_was_played(emulate):
    # Nothing but the converter's own rounding is between what is drawn and what is read.
    device = skin(**(PERFECT | {"clip": 100.0}))
    touches = serial(emulate(device, bits=None)).touches("test")
    played = list(islice(emulated_gestures(device), COUNT))
    assert touches.labels.int().tolist() == [list(one.labels.values()) for one in played]
    expected = torch.from_numpy(np.stack([one.force for one in played])).float()
    assert torch.allclose(touches.readings, expected, atol=1e-4, rtol=1e-5)
    assert touches.valid.all()
    assert touches.rate == 10.0


def test_counts_offsets_and_lost_frames_change_little(emulate, monkeypatch):
    device, sent, send = skin(gain_spread=0.0, offset=0.5, noise=0.0, clip=10.0), count(), Emulator._send
    damage = lambda self, data: send(self, data[1:] if next(sent) % 97 == 50 else data)  # noqa: E731
    monkeypatch.setattr(Emulator, "_send", damage)
    touches = serial(emulate(device), scale=20 / 512).touches("test")
    played = {(*one.labels.values(),): one.force for one in islice(emulated_gestures(device), COUNT + 1)}
    for labels, readings, valid in zip(touches.labels.int(), touches.readings, touches.valid, strict=True):
        expected = np.clip(played[*labels.tolist()], -10, 10)
        wrong = np.abs(readings.numpy() - expected)[valid.numpy()]
        # Half a count each for baseline and value; most intervals lose no frame.
        assert np.median(wrong) <= 20 / 512


@pytest.mark.parametrize(
    ("played", "settings", "reason"),
    [
        ({}, {"layout": Grid(2, 2), "scale": 1.0}, "sends 6 values per frame, the layout has 4"),
        ({"rate": 5.0, "idle": 30.0}, {"scale": 1.0}, r"sends 5 frames a second, the model needs 10"),
        ({}, {}, r"sends adc.*device\.scale"),
    ],
)
def test_a_device_that_does_not_match_is_refused(emulate, played, settings, reason):
    with pytest.raises(InputError, match=reason):
        serial(emulate(skin(noise=0.5), **played), **settings).touches("test")


@pytest.mark.parametrize("split", ["train", "validation", "holdout", "test"])
def test_only_a_test_split_of_a_port(split):
    with pytest.raises(InputError, match=r"device\.port=" if split == "test" else "skin record"):
        serial(None).touches(split)
