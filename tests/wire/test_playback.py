"""Recordings and the simulator behind the same interface."""

from time import monotonic

import numpy as np
import pytest

from skin.device.files import write_recording
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.runs.build import build_device
from skin.wire.reader import SkinDisconnected
from skin.wire.skin import Source, open_skin


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "device.dead=1"))


@pytest.fixture(scope="module")
def recording(device, tmp_path_factory):
    return write_recording(
        device.replace(gestures=12).recording(), tmp_path_factory.mktemp("skin") / "touches.parquet"
    )


def test_a_recording_is_played_to_its_end(device, recording):
    touches = device.replace(gestures=12).recording().touches
    with open_skin(str(recording), device.sensors, realtime=False, queue=7) as skin:
        frames = list(skin)
        assert (skin.stats.frames, skin.stats.dropped, skin.stats.rate_hz) == (360, 0, pytest.approx(10))
        with pytest.raises(SkinDisconnected, match="recording has ended"):
            skin.read(1)
    played = np.stack([frame.values for frame in frames]).reshape(12, 30, 25)
    assert played == pytest.approx(touches.readings.numpy())
    assert np.stack([frame.valid for frame in frames]).sum() == 360 * 24
    assert [frame.after for frame in frames[28:32]] == ["", "", "cut", ""]
    assert frames[-1].segment == 11


def test_a_recording_takes_as_long_as_it_took(recording):
    with open_skin(str(recording)) as skin:
        start = monotonic()
        frames = skin.read(6)
    assert monotonic() - start > 0.4
    assert frames[5].t_host - frames[0].t_host == pytest.approx(0.5)


def test_a_recording_of_another_skin_is_refused(recording):
    with pytest.raises(InputError, match="has 25 sensors, the layout has 16"):
        open_skin(str(recording), range(16))


def test_the_simulator_is_played(device):
    strip = device.simulate_stream(6000).whole.touches.readings[0].numpy()
    with open_skin("simulated", device.sensors, device=device, realtime=False) as skin:
        frames = skin.read(6001, timeout=60)
    assert np.stack([frame.values for frame in frames[:6000]]) == pytest.approx(strip)
    assert (frames[5999].after, frames[6000].after, frames[6000].segment) == ("", "cut", 1)


def test_values_in_newtons_stay_what_they_are():
    values, valid = np.array([0.5, -1.0, 7.0]), np.array([True, True, False])
    source = Source.in_newtons("recording", None, 3)
    source.tare.add(Frame(0, 0.0, 0.0, values, valid))
    said, known = source.tare.conversion(values, valid)
    assert said.tolist() == [0.5, -1.0, 0.0]
    assert known.tolist() == valid.tolist()
