"""A simulated device: seeds, splits, what each setting changes, and whether a shape tells a label."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from skin import Grid, InputError, PlatesAndBeams, Sheet
from skin.body.base import GEOMETRY
from skin.body.layout import Scattered
from skin.core.rng import Stream, generator
from skin.device.imperfection import ImperfectionSettings
from skin.device.simulated import Simulated, accuracy_from_shape, check_label_leakage
from skin.device.touches import concatenate
from skin.mechanics.simulator.naive import Naive
from skin.runs.build import build_device
from skin.touch.movie import balanced
from tests.made_up import PERFECT, naive_skin
from tests.touch.movie_labels import movie_labels

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]
BODY = Sheet([0.16, 0.16], [32, 32], LAYERS)


def device(**changes) -> Simulated:
    settings = {"body": BODY, "layout": Scattered(seed=0), "gestures": 60, "test_gestures": 32}
    return naive_skin(**(settings | changes))


@pytest.fixture(scope="module")
def plain() -> Simulated:
    return device()


def test_the_number_of_threads_does_not_matter(plain, monkeypatch):
    monkeypatch.setattr("skin.device.simulated._BATCH", 16)
    threads = torch.get_num_threads()
    try:
        readings = []
        for count in (1, 3):
            torch.set_num_threads(count)
            readings.append(device().touches("train").readings)
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*readings)


@pytest.mark.parametrize("stream", [False, True])
def test_parts_are_the_budget(monkeypatch, stream):
    monkeypatch.setattr("skin.device.simulated._BATCH", 4)
    monkeypatch.setattr("skin.device.base._PART", 3)
    one = device(stream=stream)
    whole, parts = one.recording(complete=False), one.parts()
    assert [part.count for part in parts] == ([12] * 5 if not stream else [12, 12, 12, 12, 10, 2])
    made = [part.make() for part in parts]
    assert [len(part) for part in made] == [part.count for part in parts]
    assert all(part.metadata["summary"]["gestures"] <= len(part) for part in made)
    joined = concatenate(made)
    assert torch.equal(joined.touches.readings, whole.touches.readings)
    assert torch.equal(joined.touches.labels, whole.touches.labels)
    assert torch.equal(joined.parameters["peak"], whole.parameters["peak"])
    assert one.parts("train") is None


def test_everything_comes_from_the_seeds_and_those_of_training_never_change_the_test(plain):
    for split in ("train", "validation", "holdout", "test"):
        one, again = plain.touches(split), device().touches(split)
        assert torch.equal(one.readings, again.readings)
        assert torch.equal(one.labels, again.labels)
    other = device(data_seed=1)
    assert torch.equal(plain.touches("test").readings, other.touches("test").readings)
    assert not torch.equal(plain.touches("train").readings, other.touches("train").readings)
    test = {peak.item() for peak in plain.recording("test").parameters["peak"]}
    for seed in range(5):
        budget = device(data_seed=seed).recording().parameters["peak"]
        assert not test & {peak.item() for peak in budget}


@pytest.mark.parametrize("changes", [{"seed": 3}, {"rate": 100.0}])
def test_another_device_feels_the_same_gestures(plain, changes):
    other = plain.replace(**changes)
    mine, theirs = plain.recording("test"), other.recording("test")
    assert (other.window, other.model_rate, theirs.touches.rate) == (30, 10.0, 10.0)
    assert torch.equal(mine.touches.labels, theirs.touches.labels)
    assert torch.equal(mine.force, theirs.force)
    apart = theirs.touches.readings - mine.touches.readings
    idle = (mine.force == 0)[..., None].expand_as(apart)
    assert "rate" in changes or apart[idle].std() == pytest.approx(np.sqrt(2) * np.hypot(0.1, 0.05), rel=0.3)
    assert apart.any()


def test_fresh_gestures_differ_by_epoch_in_train_alone():
    fresh = device(fresh=True)
    first, second = fresh.touches("train", 0), fresh.touches("train", 1)
    assert len(first) == len(second) == 48
    assert not torch.equal(first.readings, second.readings)
    assert torch.equal(first.readings, device(fresh=True).touches("train", 0).readings)
    for split in ("validation", "holdout", "test"):
        assert torch.equal(fresh.touches(split, 0).readings, device().touches(split, 5).readings)


def test_a_recording_holds_the_touches_of_its_split(plain):
    recording, touches = plain.recording("holdout"), plain.touches("holdout")
    assert torch.equal(recording.touches.readings, touches.readings)
    assert recording.force.shape == (len(touches), 30)
    assert recording.displacement is None
    assert device(simulator=PlatesAndBeams).recording("holdout").displacement.shape == (6, 30, 25, 2)
    codes = plain.recording().touches.labels.numpy() @ [1, 2, 4, 8]
    assert np.ptp(np.bincount(codes.astype(int), minlength=16)) <= 1  # labels are balanced


@pytest.mark.parametrize("simulator", [Naive, PlatesAndBeams])
def test_a_perfect_device_reads_what_the_simulator_answers_frame_by_frame(simulator):
    """Dense movies through the simulator give the readings that distinct frames and profiles gave."""
    perfect = device(simulator=simulator, **PERFECT)
    wanted = balanced(32, generator(Stream.TEST, 0))
    movie = perfect.sampler.sample(32, generator(Stream.TEST, 1), wanted)
    dense = simulator(BODY, perfect.sensors)(movie.pressure()).readings
    torch.testing.assert_close(perfect.touches("test").readings, dense, rtol=1e-4, atol=1e-5)
    weights = torch.from_numpy(BODY.footprints(perfect.sensors)).float()
    assert torch.equal(perfect.touches("test").labels, movie_labels(movie.pressure(), weights, BODY.cell))


def test_position_error_moves_the_sensors_and_not_what_is_reported(plain):
    moved = device(position_error=0.005, **PERFECT)
    assert torch.equal(moved.touches("test").positions, plain.touches("test").positions)
    assert not torch.equal(moved.touches("test").readings, device(**PERFECT).touches("test").readings)
    true = device(position_error=0.05).true_sensors.positions
    assert (true >= 0).all()
    assert (true[:, :2] <= BODY.size).all()


def test_the_summary_counts(plain):
    recording = plain.recording("test")
    summary, known = recording.metadata["summary"], recording.parameters
    assert summary["gestures"] == 32
    assert summary["acceptance"] == pytest.approx(32 / known["draws"].sum().item())
    assert summary["force"]["largest"] == pytest.approx(recording.force.max().item())
    assert summary["strain_over_30_percent"] == pytest.approx((known["peak"] > 51e3).float().mean().item())
    true = device(**(PERFECT | {"gain_spread": 0.05})).touches("test").readings
    assert summary["clipped"] == pytest.approx((true.amax((1, 2)) > 10).float().mean().item())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gestures": 9}, r"device.gestures=9 must be greater than or equal to 10"),
        ({"rate": 9.0}, r"sends 9 frames a second, the model needs 10: raise device.rate, or lower"),
        ({"seed": -1}, r"from 0 up"),
        ({"touch": {"shapes": ["potato"]}}, r"no shape potato"),
        ({"touch": {"shear": 0.5}}, r"got simulator=naive: set simulator=solid, or touch.shear=0"),
        ({"direction": True, "stream": True}, r"leave out data.stream=true"),
        ({"direction": True, "touch": {"ongoing": 0.4}}, r"and touch.ongoing"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        device(**changes)


@pytest.mark.parametrize("changes", [{}, {"stream": True}, {"randomise": True, "stream": True}])
def test_a_perfect_device_has_nearly_the_frames_of_the_model_at_any_rate(changes):
    """At three readings in an interval, one is within a sixth of it from the middle, which is a frame."""
    found = [device(**PERFECT, rate=rate, **changes).recording("test") for rate in (10.0, 30.0)]
    slow, fast = (one.touches.readings for one in found)
    assert (fast >= 2 / 3 * slow - 1e-6).all(), "from the middle to the edge the force falls to 0 at most"
    assert (fast[found[0].force == 0] == 0).all(), "no touch becomes longer"
    if not changes:  # a window of a stream may begin or end between two frames
        assert (fast.amax((1, 2)) <= slow.amax((1, 2))).all(), "a safe touch stays safe"
        assert (fast.amax((1, 2)) < slow.amax((1, 2))).any(), "and a short one reads low"


@pytest.mark.parametrize("tare", [False, True])
def test_the_idle_readings_of_a_fast_device_are_known(tare):
    """The maximum of ten readings lies above their mean, and a tare subtracts that."""
    fast = device(rate=100.0, tare=tare, test_gestures=200)
    found = fast.recording("test")
    idle = found.touches.readings[found.force == 0]
    assert idle.mean(0).numpy() == pytest.approx(fast.idle.numpy(), abs=5 * 0.05 / np.sqrt(len(idle)))
    assert (fast.idle.abs() < 0.05).all() == tare


def test_the_direction_of_sliding_is_a_label_that_changes_nothing_else(plain):
    sliding = device(direction=True)
    for split in ("train", "test"):
        one, other = plain.touches(split), sliding.touches(split)
        assert torch.equal(one.readings, other.readings)
        assert torch.equal(one.labels, other.labels[:, :4])
        assert sliding.task.counts(other.labels)[:, -1].any()
    known = sliding.recording("test")
    assert known.task.names[-2:] == ("slide_x", "slide_y")
    slides = known.touches.labels[:, -2:]
    net = torch.stack([known.parameters["net_x"], known.parameters["net_y"]], dim=1)
    some = (slides != 0).any(dim=1)
    torch.testing.assert_close(slides[some], torch.nn.functional.normalize(net[some], dim=1))


def test_every_imperfection_may_be_set_where_its_default_stands(configured):
    device = configured("simulator=naive").device
    defaults = {entry.name: entry.default for entry in fields(ImperfectionSettings)}
    assert {name: device[name] for name in defaults} == defaults
    names = {entry.name for entry in fields(Simulated)}
    assert {name for name in device if not name.startswith("_")} == names - {"body", "layout"}


def test_touches_between_the_sensors_count_if_asked_to():
    """Of small dangerous touches, some press no sensor; over sensors, all do."""
    few = {"layout": Grid(2, 2), "test_gestures": 320, **PERFECT}
    shapes = {"shapes": ["disc"], "small_area": (0.005, 0.02)}
    everywhere = device(touch=shapes | {"over_sensors": False}, **few).recording("test")
    over = device(touch=shapes, **few).recording("test")
    for recording, some in ((everywhere, True), (over, False)):
        dangerous = recording.touches.labels[:, 3] > 0.5
        felt = recording.touches.readings.amax(dim=(1, 2))
        assert dangerous.sum() == 160
        assert bool((felt[dangerous] == 0).any()) == some
        pressure = recording.parameters["pressure"]
        assert (pressure[dangerous] > 90.5e3).all()
        assert (pressure[~dangerous] <= 90.5e3).all()
    assert everywhere.parameters["draws"].mean() < over.parameters["draws"].mean()


def test_the_true_footprints_differ_and_the_reported_ones_do_not():
    """All sensors of a skin have the same factor; positions stay what they were."""
    exact, wrong = (device(footprint_error=error) for error in (0.0, 0.1))
    assert exact.true_sensors.footprint == exact.sensors.footprint == wrong.sensors.footprint
    assert (wrong.true_sensors.positions == exact.true_sensors.positions).all()
    factors = []
    for seed in range(20):
        true = wrong.replace(seed=seed).true_sensors.footprint
        across, down = (side / known for side, known in zip(true, wrong.sensors.footprint, strict=True))
        assert across == pytest.approx(down)
        factors.append(across)
    assert 0.05 < np.log(factors).std() < 0.15
    fractions = [skin.geometry[:, GEOMETRY.index("share")] for skin in (exact, wrong)]
    torch.testing.assert_close(*fractions)


def test_the_accuracy_is_the_overlap_of_two_distributions():
    """Shares 0.7 / 0.3 against 0.4 / 0.6: the best guess is right in (0.7 + 0.6) / 2."""
    shape = np.repeat([0, 1, 0, 1], [700, 300, 400, 600])
    assert accuracy_from_shape(shape, np.arange(2000) < 1000)[0] == pytest.approx(0.65)
    shape = np.arange(400) % 4
    assert accuracy_from_shape(shape, shape < 2) == (1.0, 0.0)
    accuracy, error = accuracy_from_shape(shape, np.random.default_rng(0).random(400) < 0.5)
    assert accuracy < 0.5 + 2 * error
    assert 0.02 < error < 0.03


def test_a_shape_that_tells_a_label_is_warned_of(configured):
    device = build_device(configured("simulator=naive", "data.gestures=160", "layout=grid"))
    check_label_leakage(device)
    recording = device.recording(None, complete=False)
    bars = recording.parameters | {"shape": recording.touches.labels[:, 0] * 3}
    with pytest.warns(RuntimeWarning, match=r"the shape alone predicts big \(100%\).*touch.leak=0.6"):
        check_label_leakage(device, replace(recording, parameters=bars))
