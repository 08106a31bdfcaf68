"""What numbers mean, and when the skin was untouched."""

import numpy as np
import pytest

from skin.device.calibration import Calibration
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.wire.channels import unit_conversion
from skin.wire.protocol import Header
from skin.wire.reader import Port
from skin.wire.skin import SerialSource
from skin.wire.tare import SkinTouched, Tare, take_baseline

REST = np.array([512.0, 300.0, 40.0])
RATE = 10.0  # Hz, of the model
FAST = 100.0  # Hz, of the device
PRESS = np.concatenate([np.zeros(50), 80 * np.sin(np.linspace(0, 3 * np.pi, 370)) ** 2, np.zeros(2580)])
RNG = np.random.default_rng(3)
VALID = np.ones((100, 6), dtype=bool)


def frames(values, start=0.0, rate=100.0):
    times = start + np.arange(len(values)) / rate
    return [Frame(None, t, t, row, np.ones(3, bool)) for t, row in zip(times, values, strict=True)]


def noisy(count, seed=0):
    return REST + np.random.default_rng(seed).integers(-1, 2, (count, 3))


def watched(scale=None, tare=1.0, known=None, header=None):
    conversion = lambda baseline, told: unit_conversion(3, baseline, scale, known, told)  # noqa: E731
    return Tare(conversion, tare, RATE, lambda: header)


def fed(*streams, **settings):
    """Return what has taken a baseline from streams of frames."""
    watch = watched(**settings)
    for stream in streams:
        list(map(watch.add, stream))
    return watch


def test_force_is_counted_from_the_first_quiet_second():
    watch = watched(scale=0.01)
    touched = noisy(150)
    touched[:, 1] += np.linspace(0, 400, 150)
    assert all(watch.add(one) is None for one in frames(touched))
    assert "touched: channel 1" in watch.status
    quiet = [watch.add(one) for one in frames(noisy(300), start=1.5)]
    first = next(number for number, one in enumerate(quiet) if one is not None)
    assert 90 <= first <= 180
    assert watch.status == ""
    pressed = watch.add(frames([REST + 200])[0])
    np.testing.assert_allclose(pressed.newtons, 2.0, atol=0.021)


def test_the_baseline_is_that_of_maxima_over_the_intervals_of_the_model():
    watch, rows = watched(scale=1.0), noisy(400)
    shown = [one.newtons for row in frames(rows) if (one := watch.add(row)) is not None]
    highest = np.stack(shown)[: len(shown) // 10 * 10].reshape(-1, 10, 3).max(axis=1)
    assert np.median(highest, axis=0).tolist() == [0, 0, 0]


@pytest.mark.parametrize("late", [0.0, 0.5, 5.0])
def test_a_device_may_declare_its_unit_a_little_late(late):
    headers = []
    convert = lambda baseline, header: unit_conversion(3, baseline, None, None, header)  # noqa: E731
    watch = Tare(convert, 0.0, RATE, lambda: headers[0] if headers else None)
    assert all(watch.add(frame) is None for frame in frames(noisy(round(100 * late))))
    assert not late or watch.status == "waiting for the header of the device"
    headers.append(Header(unit="N"))
    newtons = watch.add(frames(REST[None], start=late)[0]).newtons
    np.testing.assert_allclose(newtons, REST)


def test_counts_without_a_scale_are_refused():
    with pytest.raises(InputError, match=r"sends adc, .* device\.scale="):
        watched(header=Header(unit="adc", bits=10)).add(frames(noisy(1))[0])
    with pytest.raises(InputError, match=r"values of no unit, .* device\.scale="):
        fed(frames(noisy(700)))


def test_a_calibration_gives_scale_gains_and_broken_sensors():
    gains = {"gain": [0.5, 1.0, 1.0], "offset": [0.1, 0.2, 0.0]}
    known = Calibration(gains, {"dead": [2]}, scale=0.02, zero=512)
    raw = np.array([612.0, 612.0, 0.0])
    one = watched(tare=0, known=known).add(frames([raw])[0])
    np.testing.assert_allclose(one.newtons[:2], known.corrected(raw)[:2])
    assert one.usable.tolist() == [True, True, False]


class Played:
    """Hands out frames made before, as a skin does: ``force`` (F,) on the first of two channels."""

    def __init__(self, force, rate=FAST, segments=None):
        noise = np.random.default_rng(0).normal(scale=0.1, size=(len(force), 2))
        values = 500 + noise + np.column_stack([force, np.zeros(len(force))])
        times = np.arange(len(force)) / rate
        segments = np.zeros(len(force)) if segments is None else segments
        rows = zip(times, values, segments.astype(int).tolist(), strict=True)
        self.frames = [Frame(n, t, t, row, np.ones(2, bool), some) for n, (t, row, some) in enumerate(rows)]
        self.taken, self.header = 0, Header()

    def read(self, count):
        self.taken += count
        return self.frames[self.taken - count : self.taken]


def settled(force, seconds, **how):
    """Return the frames that settling took, the baseline, and what was said."""
    said, source = [], SerialSource(Port(scale=1.0, tare=seconds), 2, RATE)
    frames, conversion = source.warm_up(Played(force, **how), said.append)
    return frames, conversion.zero, said[1:]


@pytest.mark.parametrize(
    ("force", "seconds", "rest", "end", "said"),
    [
        (np.zeros(1000), 2.0, 500, 2.1, []),
        (PRESS, 2.0, 500, 6.4, ["the skin is touched: let go"]),
    ],
)
def test_an_untouched_skin_gives_its_baseline_and_every_frame_until_then(force, seconds, rest, end, said):
    frames, baseline, words = settled(force, seconds)
    assert baseline == pytest.approx([rest, rest], abs=0.3)
    assert [frame.seq for frame in frames] == list(range(len(frames)))
    assert end - 0.3 <= frames[-1].t <= end
    assert words == said


@pytest.mark.parametrize(
    ("force", "seconds", "rate", "said"),
    [
        (80 * np.sin(np.arange(9000) / 40), 2.0, FAST, "touched"),  # it does not wait for ever
        (np.zeros(150), 0.5, FAST, "10 frames, got 5"),
        (np.zeros(100), 2.0, 4.0, "rate"),
    ],
)
def test_what_gives_no_baseline_is_refused(force, seconds, rate, said):
    with pytest.raises(InputError, match=said):
        settled(force, seconds, rate=rate)


def test_a_device_that_starts_anew_is_listened_to_anew():
    frames, *_ = settled(np.zeros(1000), 1.0, segments=np.arange(1000) // 120)
    assert frames[0].segment == 0
    frames, *_ = settled(np.zeros(1000), 1.0, segments=np.arange(1000) > 70)
    assert {frame.segment for frame in frames} == {1}


def later(stream, seconds=2):
    return [one._replace(t=one.t + seconds, t_host=one.t_host + seconds) for one in stream]


def limited(values, channels, limit=1023.0):
    rows = []
    for frame in frames(values):
        full = np.isin(np.arange(3), channels)
        rows.append(frame._replace(values=np.where(full, limit, frame.values), saturated=full))
    return rows


def test_a_channel_at_its_limit_has_no_baseline_and_keeps_an_old_one():
    watch = fed(limited(noisy(150), [1]), scale=0.01)
    assert watch.conversion.broken.tolist() == [False, True, False]
    assert watch.warning == "channel 1 at the limit or without a value: no baseline"
    watch = fed(frames(noisy(150)), scale=0.01)
    assert watch.warning == ""
    before = watch.conversion.zero
    watch.restart()
    list(map(watch.add, later(limited(noisy(150, 1), [1]))))
    after = watch.conversion
    assert (watch.count, after.broken.any(), after.zero[1]) == (2, False, before[1])
    watch = fed(limited(noisy(400), [0, 1, 2]), scale=0.01)
    assert watch.conversion is None
    assert watch.status == "no baseline: all channels at the limit or without a value"


def test_the_noise_of_the_untouched_skin_is_known():
    assert "this device shows no noise" in fed(frames(np.tile(REST, (150, 1))), scale=0.01).warning
    noise = np.random.default_rng(0).normal(scale=5.0, size=(400, 3))
    watch = fed(frames(REST + noise), scale=0.01)
    np.testing.assert_allclose(watch.conversion.noise, 0.05, rtol=0.3)
    assert (watch.conversion.changing > 0.9).all()


def test_a_device_that_restarts_often_gets_a_baseline():
    """Its clock begins again every 0.6 s; the baseline needs a second."""
    stream = (one._replace(t=n % 60 / 100, segment=n // 60) for n, one in enumerate(frames(noisy(300))))
    assert fed(stream, scale=0.01).conversion is not None


def test_a_new_baseline_waits_for_the_end_of_a_touch_unless_it_is_forced():
    tare, touched = fed(frames(noisy(150)), scale=0.01), frames(noisy(150) + 100)
    tare.restart()
    for one in later(touched):
        tare.add(one, touched=True)
    assert (tare.count, tare.status) == (1, "the new baseline waits: something touches the skin")
    tare.restart(force=True)
    for one in later(touched, 4):
        tare.add(one, touched=True)
    assert tare.count == 2
    np.testing.assert_allclose(tare.conversion.zero, REST + 100, atol=1.5)


def test_few_frames_are_waited_for():
    """Frames of a bridge without a clock come in bursts: only some intervals have any."""
    times = np.repeat(0.5 + 0.5 * np.arange(6), 25)
    stream = (one._replace(t=t, t_host=t) for t, one in zip(times, frames(noisy(150)), strict=True))
    watch = fed(stream, scale=1.0, tare=2.0)
    assert watch.status == "taking the baseline: waiting for more frames"


def idle(sigma=0.6):
    return np.round(np.linspace(400, 600, 6) + sigma * RNG.standard_normal((100, 6)))


@pytest.mark.parametrize("sigma", [0.0, 0.2, 1.0, 5.0])
def test_noise_is_no_touch(sigma):
    for _ in range(200):
        found = take_baseline(idle(sigma), VALID, np.linspace(400, 600, 6))
        assert found == pytest.approx(np.linspace(400, 600, 6), abs=max(sigma, 1e-9))


@pytest.mark.parametrize(
    "touch",
    [
        *(60.0 * (np.arange(100) >= first) for first in (10, 50, 90)),
        np.linspace(0, 30, 100),
        30 * np.sin(np.arange(100) * 2 * np.pi / 12),  # strokes all the time
    ],
)
def test_a_touch_that_comes_is_refused_and_named(touch):
    values = idle()
    values[:, 4] += touch
    with pytest.raises(SkinTouched, match="channel 4 moved"):
        take_baseline(values, VALID)


def test_a_hand_that_rests_is_seen_against_the_old_baseline():
    values, before = idle(), np.linspace(400, 600, 6)
    values[:, 1] += 40
    take_baseline(values, VALID)
    with pytest.raises(InputError, match="channel 1 differs from"):
        take_baseline(values, VALID, before)
    take_baseline(values, VALID, before, force=True)


def test_a_channel_that_means_nothing_is_not_asked():
    values, valid = idle(), VALID.copy()
    values[50:, 3] = 1023
    valid[:, 3] = False
    asked = np.arange(6) != 3
    assert take_baseline(values, valid)[asked] == pytest.approx(np.linspace(400, 600, 6)[asked], abs=0.5)
