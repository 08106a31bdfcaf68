"""Windows of streams against dense movies, frame by frame."""

import pytest
import torch

from skin.body.layout import Scattered
from skin.body.sheet import Sheet
from skin.device.files import read_recording, write_recording
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.naive import Naive
from skin.touch.gestures import GestureSettings
from skin.touch.labels import TOUCH_OR_NOT
from tests.touch.movie_labels import movie_labels

BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
PERFECT = {"gain_spread": 0.0, "offset": 0.0, "noise": 0.0, "clip": 1e9}


def device(**changes) -> Simulated:
    settings = {"simulator": Naive, "gestures": 200, "test_gestures": 150, "layout": Scattered(seed=0)}
    return Simulated(body=BODY, stream=True, **(settings | changes))


@pytest.fixture(scope="module")
def dense():
    """A strip of a perfect device with touches close together, and its dense movie (F, H, W)."""
    strip = device(**PERFECT, touch=GestureSettings(ongoing=0.5)).simulate_stream(500, gap=[1, 25])
    movie = strip.timeline.movie
    pressure, onset = movie.pressure(), movie.parameters["onset"].long()
    stream = torch.zeros(500, *BODY.shape)
    owner = torch.full((500,), -1)
    for number, (begin, end) in enumerate(zip(strip.timeline.begin, strip.timeline.end, strict=True)):
        for frame in range(begin, min(end, 500)):
            stream[frame] = pressure[number, onset[number] + frame - begin]
            owner[frame] = number
    return strip, stream, owner


def test_a_window_reads_what_the_simulator_answers_to_its_frames(dense):
    strip, stream, _ = dense
    starts = torch.tensor([0, 7, 111, 470])
    windows = strip.cut(starts, 30)
    sensors = device().sensors
    for start, readings, force in zip(starts, windows.touches.readings, windows.force, strict=True):
        frames = stream[start : start + 30]
        torch.testing.assert_close(readings, Naive(BODY, sensors)(frames).readings, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(force, frames.sum((1, 2)) * BODY.cell[0] * BODY.cell[1])


@pytest.mark.parametrize("window", [5, 30, 60])
def test_labels_and_shares_are_those_of_the_dense_movie(dense, window):
    """Every window's gesture found by counting its frames; the whole gesture's labels from its own movie."""
    strip, stream, owner = dense
    movie = strip.timeline.movie
    footprints = torch.from_numpy(BODY.footprints(device().sensors)).float()
    whole = movie_labels(movie.pressure(), footprints, BODY.cell)
    starts = torch.arange(500 - window + 1)
    windows = strip.cut(starts, window)
    touched = stream.flatten(1).amax(1) > 0
    seen_parts = 0
    known = windows.touches.labels, windows.parameters["share"]
    for start, labels, fraction in zip(starts, *known, strict=True):
        shown = owner[start : start + window]
        if not touched[start : start + window].any():
            assert labels.tolist() == [0] * 5
            assert fraction == 0
            continue
        frames = torch.bincount(shown[shown >= 0])
        maximum = int(frames.argmax())
        assert labels.tolist() == [*whole[maximum].tolist(), 1]
        duration = int((movie.pressure()[maximum].flatten(1).amax(1) > 0).sum())
        assert fraction.item() == pytest.approx(int(frames[maximum]) / duration)
        seen_parts += fraction < 1
    assert seen_parts > 20


@pytest.fixture(scope="module")
def plain() -> Simulated:
    return device()


def test_splits_have_their_sizes_and_streams_of_their_own(plain):
    sizes = {"train": 160, "validation": 20, "holdout": 20, "test": 150}
    peaks = {}
    for split, size in sizes.items():
        recording = plain.recording(split)
        assert len(recording) == size
        peaks[split] = set(recording.parameters["peak"].tolist()) - {0.0}
    for one in sizes:
        for other in sizes:
            assert one == other or not peaks[one] & peaks[other]
    assert len(plain.recording()) == 200


def test_everything_comes_from_the_seeds(plain):
    other, elsewhere = device(data_seed=1), device(seed=1)
    assert torch.equal(plain.touches("test").readings, other.touches("test").readings)
    assert not torch.equal(plain.touches("train").readings, other.touches("train").readings)
    assert torch.equal(plain.touches("test").labels, elsewhere.touches("test").labels)
    assert not torch.equal(plain.touches("test").readings, elsewhere.touches("test").readings)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gap": [0, 0.5]}, r"touch.gap=.* must be greater than 0: as in touch.gap=\[1.0,6.0\]"),
        ({"gap": [0.9, 0.5]}, r"touch.gap=.* must be a range \[minimum, maximum\]: as in touch.gap="),
        ({"gap": [0.04, 0.5]}, r"touch.gap=\[0.04, 0.5\] s gives 0 to 5 frames .* at least 1 \(0.1 s\)"),
        ({"stride": [0.01, 0.02]}, r"touch.stride=.* s gives 0 frames at touch.rate=10 Hz"),
    ],
)
def test_ranges_have_a_frame(wrong, message):
    with pytest.raises(InputError, match=message):
        GestureSettings.of(wrong)


def test_a_file_keeps_windows_and_their_gate(plain, tmp_path):
    stored = read_recording(write_recording(plain.recording("holdout"), tmp_path / "windows.parquet"))
    assert stored.task == TOUCH_OR_NOT
    assert torch.equal(stored.touches.labels, plain.touches("holdout").labels)
    torch.testing.assert_close(stored.parameters, plain.recording("holdout").parameters, rtol=0, atol=0)
