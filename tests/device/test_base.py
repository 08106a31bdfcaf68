"""The contract of every device."""

from pathlib import Path

import pytest
import torch

from skin.core.files import CONF
from skin.device.base import AbstractDevice, split_groups
from skin.device.files import write_recording
from skin.device.simulated import Simulated, check_label_leakage
from skin.errors import InputError
from skin.evaluation.alarm import threshold_gestures
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.report import measure_margins, touch_sets
from skin.evaluation.settings import Evaluation
from skin.evaluation.streams import evaluate_windows
from skin.record.serial import open_source
from skin.runs.build import build_device

POINT = OperatingPoint(0.5, 0.02)
SMALL = ["data.gestures=50", "device.test_gestures=20", "simulator=naive"]
EVERYWHERE = ("recording", "simulated")  # others need what is not everywhere: a corpus, a port


@pytest.fixture(scope="module", params=EVERYWHERE)
def device(request, configured, tmp_path_factory) -> AbstractDevice:
    simulated = build_device(configured(*SMALL))
    if request.param == "simulated":
        return simulated
    path = write_recording(simulated.recording(), tmp_path_factory.mktemp("recording") / "x.parquet")
    return build_device(configured("device=recording", f"device.path={path}"))


def test_other_devices_have_tests_of_their_own():
    others = {path.stem for path in (CONF / "device").glob("*.yaml")} - set(EVERYWHERE)
    assert others == {"mujoco", "serial", "skins"}
    rooms = [Path(__file__).parents[1] / room for room in ("device", "record", "robot")]
    assert all(any((room / f"test_{name}.py").is_file() for room in rooms) for name in others)


def test_splits_have_one_form_and_are_80_10_10_by_gesture(device):
    splits = {split: device.touches(split) for split in ("train", "validation", "holdout", "test")}
    for touches in splits.values():
        assert touches.readings.shape == (len(touches), 30, 25)
        assert touches.readings.dtype == touches.labels.dtype == torch.float32
        assert torch.isfinite(touches.readings).all()
        assert touches.labels.shape == (len(touches), len(device.task))
        assert (touches.positions.shape, touches.rate) == ((25, 3), 10.0)
    parts = [splits.pop(split).readings for split in ("train", "validation", "holdout")]
    assert [len(part) for part in parts] == [40, 5, 5]
    assert len(torch.cat(parts).flatten(1).unique(dim=0)) == 50
    assert torch.equal(parts[0], device.touches("train", epoch=3).readings)
    assert device.size == (0.16, 0.16)
    assert device.simulation is (device if isinstance(device, Simulated) else None)
    assert len(device.recording("holdout", complete=False)) == 5


def test_a_blank_has_labelled_touches_of_the_same_shape(device):
    blank = device.blank()
    assert (blank.task, blank.size) == (device.task, device.size)
    touches, own = blank.touches("train"), device.touches("train")
    assert touches.readings.shape[1:] == own.readings.shape[1:]
    assert touches.labels.shape[1:] == own.labels.shape[1:]
    assert torch.equal(touches.positions, own.positions)


def test_a_device_of_ones_own_needs_touches_alone(made_up_device, capsys):
    settings = Evaluation(devices=2, layouts=2, false_alarm_rate=0.02)
    assert list(touch_sets(made_up_device, settings)) == ["holdout"]
    gestures = threshold_gestures(made_up_device, settings)
    assert torch.equal(gestures.readings, made_up_device.touches("validation").readings)
    check_label_leakage(made_up_device)
    assert not capsys.readouterr().err
    assert made_up_device.blank() is made_up_device
    assert torch.equal(made_up_device.all_touches().readings, made_up_device.touches("test").readings)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda device: device.simulated("this is simulated"), "^this is simulated: leave out device="),
        (lambda device: device.recording(), "only simulated or recorded touches"),
        (open_source, "can be watched: give device=serial"),
        (lambda device: measure_margins(None, device, 20, POINT), "has none: .* add device=simulated"),
        (lambda device: evaluate_windows(None, device, None, POINT), "has none: .* add device=simulated"),
    ],
)
def test_what_it_does_not_know_is_refused_in_a_sentence(made_up_device, ask, said):
    with pytest.raises(InputError, match=said):
        ask(made_up_device)


@pytest.mark.parametrize(("count", "validation"), [(2, 0), (6, 1), (40, 4)])
def test_no_group_is_in_two_splits(count, validation):
    """With few groups, the validation is a part of the touches of those to train on."""
    groups = torch.arange(20 * count) % count
    rows = split_groups(groups, seed=0)
    assert sorted(torch.cat(list(rows.values())).tolist()) == list(range(20 * count))
    parts = {name: set(groups[part].tolist()) for name, part in rows.items()}
    assert not parts["holdout"] & (parts["train"] | parts["validation"])
    assert len(parts["holdout"]) == max(1, count // 10)
    if validation:
        assert not parts["train"] & parts["validation"]
        assert len(parts["validation"]) == validation
    assert set(groups[split_groups(groups, 0, [1])["holdout"]].tolist()) == {1}
    assert any(not torch.equal(part, split_groups(groups, seed=1)[name]) for name, part in rows.items())
